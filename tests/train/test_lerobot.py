"""LeRobot data sets: what the tabletop world exports is read back, and what is wrong with a set is named."""

import json
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
import torch
from fake_model import FakeModel, traits_of
from headless import needs_egl
from tiny_scenes4d import edit_json
from tiny_world import ran, tiny_recipe

from gcd_model import RenderOptions, SourceFeatures, Trajectory, View
from gcd_model.config import ModelConfig
from gcd_model.live.config import LiveConfig
from gcd_model.weights.card import FAMILIES
from gcd_train.data import lerobot_augment
from gcd_train.data.files import FileFault
from gcd_train.data.lerobot import CAMERA_FILE, CameraCalibration, LeRobotPairs, read_set
from gcd_train.data.lerobot_augment import Augmentation, AugmentOptions
from gcd_train.data.lerobot_export import LeRobotWriter, TabletopExport, export_tabletop
from gcd_train.data.open import RunData, open_data
from gcd_train.data.sample import Sample
from gcd_train.data.videos import nearest_pictures
from gcd_train.errors import DataError, RecipeError, RunError
from gcd_train.recipe_data import DataRecipe

pq = pytest.importorskip("pyarrow.parquet", reason="needs the extra `lerobot`: pip install 'gcd-node[lerobot]'")
av = pytest.importorskip("av", reason="needs the extra `lerobot`: pip install 'gcd-node[lerobot]'")
pa = pytest.importorskip("pyarrow", reason="needs the extra `lerobot`: pip install 'gcd-node[lerobot]'")

WIDTH, HEIGHT, FPS, ROWS = 64, 48, 20, 20
LEFT, RIGHT, HAND = (f"observation.images.{name}" for name in ("left", "right", "hand"))
POSE = "observation.hand_pose"


def _pose(x: float, turn: float = 0.3) -> np.ndarray:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    pose[:3, 3] = x, 0.25, 1.5
    return pose


def _calibrations() -> dict[str, CameraCalibration]:
    numbers = {"width": WIDTH, "height": HEIGHT, "fx": 60.0, "fy": 60.0, "cx": 32.0, "cy": 24.0}
    rows = {LEFT: _pose(0.1), RIGHT: _pose(0.7, -0.4)}
    standing = {
        name: CameraCalibration(**numbers, base_from_camera=tuple(map(tuple, pose.tolist())))
        for name, pose in rows.items()
    }
    return {**standing, HAND: CameraCalibration(**numbers, pose_feature=POSE)}


def _picture(episode: int, row: int, camera: int) -> np.ndarray:
    """Smooth, so that the codec keeps it, and different in each row, so that a wrong one is noticed."""
    ramp = np.linspace(0, 120, WIDTH)[None, :, None] + np.zeros((HEIGHT, 1, 3))
    return (ramp + np.array([6 * row, 40 * episode, 40 * camera])).astype(np.uint8)


def _pictures(episode: int, rows: int) -> Iterator[Mapping[str, np.ndarray]]:
    for row in range(rows):
        yield {name: _picture(episode, row, camera) for camera, name in enumerate((LEFT, RIGHT, HAND))}


def _episode(number: int) -> tuple[dict[str, np.ndarray], str]:
    """Features and task."""
    poses = np.stack([_pose(0.05 * row + number) for row in range(ROWS)])
    state = np.arange(ROWS * 2).reshape(ROWS, 2) / 10
    return {"observation.state": state, "action": state + 0.1, POSE: poses.reshape(ROWS, 16)}, f"task {number % 2}"


def _write(folder: Path, *numbers: int) -> Path:
    with LeRobotWriter(folder, _calibrations(), robot="test", fps=FPS, names={}) as writer:
        for number in numbers:
            writer.add(*_episode(number), _pictures(number, ROWS))
    return folder


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes 0 and 1 in the first files, 2 in files of its own, as LeRobot goes on after so many bytes."""
    folder, other = (tmp_path_factory.mktemp("lerobot") / name for name in ("set", "other"))
    _write(folder, 0, 1)
    _write(other, 2)
    first, second = "chunk-000/file-000", "chunk-000/file-001"
    rows = pq.read_table(other / f"meta/episodes/{first}.parquet").to_pylist()
    rows = [row | {"episode_index": 2} | {key: 1 for key in row if key.endswith("file_index")} for row in rows]
    pq.write_table(pa.Table.from_pylist(rows), folder / f"meta/episodes/{second}.parquet")
    data = pq.read_table(other / f"data/{first}.parquet")
    number = pa.array(np.full(ROWS, 2))
    data = data.set_column(data.column_names.index("episode_index"), "episode_index", number)
    pq.write_table(data, folder / f"data/{second}.parquet")
    for name in (LEFT, RIGHT, HAND):
        shutil.copy(other / f"videos/{name}/{first}.mp4", folder / f"videos/{name}/{second}.mp4")
    return folder


@pytest.fixture
def copied(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "set"))


def _only(folder: Path, first: str, second: str, **changes: Any) -> LeRobotPairs:
    return LeRobotPairs(folder, frames=6, size=(WIDTH, HEIGHT), cameras=(first, second), **changes)


def _all(folder: Path, seed: int) -> LeRobotPairs:
    return LeRobotPairs(folder, seed, frames=6, size=(WIDTH, HEIGHT), repeats=10)


def test_pictures_come_back_within_the_error_of_the_codec_and_from_the_right_rows(made: Path) -> None:
    pairs = _only(made, LEFT, RIGHT)
    for index in range(6):
        sample = pairs.sample(index)
        episode = int(sample.scene.removeprefix("episode_"))
        swapped = sample.source_from_target[0, 0, 1] < 0
        for camera, pictures in ((int(swapped), sample.source), (int(not swapped), sample.target)):
            wanted = np.stack([_picture(episode, row, camera) for row in sample.frame_numbers]).astype(int)
            assert np.abs(pictures - wanted).mean() < 3.0
    assert pairs.skips.total == 0


def test_an_episode_that_is_learned_from_is_never_measured_on(made: Path, copied: Path, tmp_path: Path) -> None:
    data = DataRecipe(kind="lerobot", held_out=1)
    recipe = tiny_recipe(data=data, unet=msgspec.structs.replace(tiny_recipe().unet, fps=FPS))
    config = ModelConfig(frames=6, height=HEIGHT, width=WIDTH)

    def opened(valid: Path | None) -> RunData:
        return open_data(recipe, config, FAMILIES["driving"], made, valid)

    assert len(opened(None).valid) == 1
    for same in (made, copied):
        with pytest.raises(DataError, match="episode_000000, episode_000001, episode_000002"):
            opened(same)
    other = _write(tmp_path / "other", 0)
    assert (len(opened(other).clips), len(opened(other).valid)) == (3 * data.repeats, 1)


def test_the_pose_of_a_moving_camera_is_that_of_its_row(made: Path) -> None:
    pairs = _only(made, LEFT, HAND)
    for index in range(4):
        sample = pairs.sample(index)
        number = int(sample.scene.removeprefix("episode_"))
        hands = np.stack([_pose(0.05 * row + number) for row in sample.frame_numbers])
        assert _apart(sample, np.linalg.inv(_pose(0.1)) @ hands) < 1e-6  # rows are float32
    standing = _only(made, LEFT, RIGHT).sample(0)
    assert _apart(standing, np.linalg.inv(_pose(0.1)) @ _pose(0.7, -0.4)) < 1e-12


def _apart(sample: Sample, between: np.ndarray) -> float:
    """From these poses, or from their inverses where the cameras are the other way round."""
    return min(float(np.abs(sample.source_from_target - way).max()) for way in (between, np.linalg.inv(between)))


def test_a_lower_rate_takes_the_rows_nearest_in_time(made: Path) -> None:
    sample = _only(made, LEFT, RIGHT, fps=10.0).sample(0)
    assert set(np.diff(sample.frame_numbers)) == {2}
    assert sample.fps == 10.0
    with pytest.raises(DataError, match="30 frames per second were wanted"):
        _only(made, LEFT, RIGHT, fps=30.0)


def test_the_layout_is_that_of_version_three(tmp_path: Path) -> None:
    made = _write(tmp_path, 0, 1)
    info = json.loads((made / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert [info["total_episodes"], info["total_frames"], info["total_tasks"]] == [2, 40, 2]
    files = {str(path.relative_to(made)) for path in made.rglob("*") if path.is_file()}
    assert files == {
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
        CAMERA_FILE,
        *(f"{room}/chunk-000/file-000.parquet" for room in ("data", "meta/episodes")),
        *(f"videos/{name}/chunk-000/file-000.mp4" for name in (LEFT, RIGHT, HAND)),
    }
    rows = pq.read_table(made / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["dataset_from_index"] for row in rows] == [0, 20]
    assert [row[f"videos/{LEFT}/from_timestamp"] for row in rows] == [0.0, 1.0]
    data = pq.read_table(made / "data/chunk-000/file-000.parquet")
    assert data["index"].to_pylist() == list(range(40))
    assert set(data.column_names) | {LEFT, RIGHT, HAND} == set(info["features"])
    tasks = pq.read_table(made / "meta/tasks.parquet")
    assert tasks.to_pydict() == {"task_index": [0, 1], "task": ["task 0", "task 1"]}
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_a_set_of_version_two_is_read_alike(made: Path, tmp_path: Path) -> None:
    old = _as_version_two(made, tmp_path / "old")
    new_pairs, old_pairs = _all(made, 1), _all(old, 1)
    assert len(old_pairs) == 10
    np.testing.assert_array_equal(new_pairs.sample(0).source_from_target, old_pairs.sample(0).source_from_target)
    np.testing.assert_array_equal(new_pairs.sample(0).target, old_pairs.sample(0).target)


def _as_version_two(made: Path, folder: Path) -> Path:
    """The first episode alone, in the layout with one file an episode."""
    info = json.loads((made / "meta/info.json").read_text())
    info["codebase_version"] = "v2.1"
    info["data_path"] = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    info["video_path"] = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
    (folder / "meta").mkdir(parents=True)
    (folder / "data/chunk-000").mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps(info))
    (folder / "meta/episodes.jsonl").write_text('{"episode_index": 0, "tasks": ["task 0"], "length": 20}\n')
    shutil.copy(made / CAMERA_FILE, folder / CAMERA_FILE)
    table = pq.read_table(made / "data/chunk-000/file-000.parquet").slice(0, ROWS)
    pq.write_table(table, folder / "data/chunk-000/episode_000000.parquet")
    for name in (LEFT, RIGHT, HAND):
        (folder / "videos/chunk-000" / name).mkdir(parents=True)
        shutil.copy(
            made / f"videos/{name}/chunk-000/file-000.mp4", folder / f"videos/chunk-000/{name}/episode_000000.mp4"
        )
    return folder


# what can be wrong


def test_a_set_without_calibration_is_told_which_file_to_write(copied: Path) -> None:
    (copied / CAMERA_FILE).unlink()
    with pytest.raises(DataError, match=r"meta/cameras\.json is missing.*--calibration FILE.*base_from_camera"):
        LeRobotPairs(copied)


def test_a_calibration_can_be_given_as_a_file(copied: Path, tmp_path: Path) -> None:
    (copied / CAMERA_FILE).rename(tmp_path / "mine.json")
    pairs = LeRobotPairs(copied, frames=2, calibration=tmp_path / "mine.json")
    assert pairs.sample(0).source.shape == (2, 256, 384, 3)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"base_from_camera": None}, "either base_from_camera or pose_feature"),
        ({"base_from_camera": (np.eye(4) * 2).tolist()}, "last row|rigid"),
        ({"base_from_camera": [[1, 2], [3, 4]]}, r"must be \[\.\.\., 4, 4\]"),
        ({"fx": -3.0}, "focal lengths must be positive"),
        ({"focal": 3.0}, "focal"),
    ],
)
def test_a_wrong_calibration_is_named(copied: Path, change: dict[str, Any], said: str) -> None:
    edit_json(copied / CAMERA_FILE, lambda told: told["cameras"][LEFT].update(change))
    with pytest.raises(FileFault, match=said) as caught:
        LeRobotPairs(copied)
    assert caught.value.path == copied / CAMERA_FILE


@pytest.mark.parametrize("package", ["av", "pyarrow"])
def test_a_missing_package_is_said_at_once_with_its_extra(
    made: Path, monkeypatch: pytest.MonkeyPatch, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(DataError, match=rf"gcd-node\[lerobot\].*{package} is missing"):
        LeRobotPairs(made)


def test_a_damaged_list_of_episodes_is_an_error_that_names_it(copied: Path) -> None:
    path = copied / "meta/episodes/chunk-000/file-001.parquet"
    path.write_bytes(b"PAR1 and nothing more")
    with pytest.raises(FileFault, match="is damaged") as caught:
        LeRobotPairs(copied)
    assert caught.value.path == path


def _encode(path: Path, rows: int, rate: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=rate)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        for _ in range(rows):
            frame = av.VideoFrame.from_ndarray(np.zeros((size[1], size[0], 3), np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _edit_times(path: Path, change: Callable[[np.ndarray], None]) -> None:
    table = pq.read_table(path)
    times = table["timestamp"].to_numpy().copy()
    change(times)
    place = table.column_names.index("timestamp")
    pq.write_table(table.set_column(place, "timestamp", pa.array(times)), path)


def _swapped(times: np.ndarray) -> None:
    for first in (4, 24):
        times[[first, first + 1]] = times[[first + 1, first]]


def _widened(times: np.ndarray) -> None:
    for first in (0, 20):
        times[first + 1 : first + 20] += 5.0 * np.arange(1, 20)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:300])


ROWS_FILE, FILM = "data/chunk-000/file-000.parquet", f"videos/{LEFT}/chunk-000/file-000.mp4"
SPOILT: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "damaged rows": (ROWS_FILE, _cut, "is damaged"),
    "missing rows": (ROWS_FILE, Path.unlink, "is missing"),
    "rows that meta does not know": (
        ROWS_FILE,
        lambda path: pq.write_table(pq.read_table(path).slice(1, 30), path),
        "meta says 20",
    ),
    "times out of order": (ROWS_FILE, lambda path: _edit_times(path, _swapped), "out of order at row 5"),
    "a gap": (ROWS_FILE, lambda path: _edit_times(path, _widened), "a gap in its timestamps"),
    "a missing video": (FILM, Path.unlink, "is missing"),
    "a damaged video": (FILM, _cut, "is damaged"),
    "a short video": (FILM, lambda path: _encode(path, 3, FPS), "it ends at"),
    "another rate": (FILM, lambda path: _encode(path, 20, FPS // 2), "the nearest is at"),
    "another size": (FILM, lambda path: _encode(path, 40, FPS, (32, 32)), "is 32 x 32, its calibration says 64 x 48"),
}


@pytest.mark.parametrize("name", SPOILT)
def test_what_cannot_be_read_is_skipped_and_named(name: str, copied: Path) -> None:
    file, spoil, said = SPOILT[name]
    spoil(copied / file)
    pairs = _only(copied, LEFT, RIGHT)
    assert pairs.episodes[0].name == "episode_000000"
    sample = pairs.sample(0)  # of the first episode; of the others the last is whole
    assert sample.scene == "episode_000002"
    assert pairs.skips.total == len(sample.skipped) > 0
    skipped = str(sample.skipped[0])
    assert str(copied / file) in skipped
    assert said in skipped


def test_an_episode_shorter_than_the_window_is_left_out_and_a_set_of_such_is_an_error(made: Path) -> None:
    pairs = LeRobotPairs(made, frames=40)
    with pytest.raises(DataError, match=r"101 samples in a row.*40 frames at 20 a second take 1\.95 s"):
        pairs.sample(0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"data_path": "../../{chunk_index}/{file_index}"}, "leads out of the data set"),
        ({"fps": None}, r"info\.json"),
        ({"codebase_version": "v1.6"}, r"says version v1\.6"),
    ],
)
def test_a_wrong_description_is_named(copied: Path, change: dict[str, object], said: str) -> None:
    edit_json(copied / "meta/info.json", lambda info: info.update(change))
    with pytest.raises(DataError, match=said):
        LeRobotPairs(copied)


# novel views

PATTERN = np.arange(64)[None].repeat(64, 0) % 3  # visibility, at the network's size


class SeeingModel(FakeModel):
    """Shows the source itself, and says what was seen by a pattern."""

    def render(
        self, features: SourceFeatures, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        frames = len(features.latents)
        seen = torch.from_numpy(PATTERN.astype(np.uint8)).expand(frames, *PATTERN.shape)
        return [replace(view, visibility=seen) for view in super().render(features, trajectories, options)]


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeModel:
    """In place of the live model, frame by frame."""
    model = SeeingModel(traits_of(LiveConfig(frames=1), "live"))
    monkeypatch.setattr(lerobot_augment, "_model", lambda *_: model)
    return model


def _augment(source: Path, out: Path, **options: Any) -> Augmentation:
    usual = {"camera": "left", "view": ["same=0,0,0"], "source_radius": 1.0}
    return Augmentation.of(source, out, AugmentOptions(**usual | options))


def _made_of(work: Augmentation) -> Path:
    work.claim()
    assert [work(episode) for episode in work.episodes] == [episode.length for episode in work.episodes]
    work.finish()
    return work.out


def _film(folder: Path, feature: str, episode: int) -> np.ndarray:
    """u8 [T, H, W, 3]."""
    places = {each.number: each for each in read_set(folder)[1]}
    path, begin = places[episode].videos[feature]
    return np.stack(nearest_pictures(path, [begin + row / FPS for row in range(ROWS)], 1e-4, av))


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
def test_a_set_gets_a_view_of_every_frame_and_everything_else_stays(
    made: Path, tmp_path: Path, version: str, fake: FakeModel
) -> None:
    source = made if version == "v3.0" else _as_version_two(made, tmp_path / "old")
    pose = tmp_path / "poses.json"
    pose.write_text(json.dumps({"moved": _pose(0.1, 0.02).tolist()}))
    out = _made_of(_augment(source, tmp_path / "out", poses=pose))
    assert sorted(path.name for path in tmp_path.iterdir() if "out" in path.name) == ["out"]
    changed = {"info.json", "stats.json", "cameras.json"}
    for path in (each for each in source.rglob("*") if each.is_file() and each.name not in changed):
        if path.parent.parent.name != "episodes":
            assert (out / path.relative_to(source)).read_bytes() == path.read_bytes()
    for path in source.glob("meta/episodes/*/*"):
        before = pq.read_table(path)
        assert pq.read_table(out / path.relative_to(source)).select(before.column_names).equals(before)
    for number in (episode.number for episode in read_set(source)[1]):
        view, filmed = (_film(out, name, number).astype(int) for name in (f"{LEFT}_same", LEFT))
        assert np.abs(view - filmed).mean(axis=(1, 2, 3)).max() < 3.0  # rows are 6 levels apart
        seen = _film(out, f"{LEFT}_same_visibility", number)
        levels = np.array([0, 128, 255], np.uint8)[PATTERN]
        exact = cv2.resize(levels, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
        np.testing.assert_array_equal(seen, np.broadcast_to(exact[None, ..., None], seen.shape))
    assert [len(each.video) for each in fake.clips] == [1] * ROWS * len(read_set(source)[1])
    assert all(each.odometry is not None for each in fake.clips)  # the calibration says that the camera stands still
    features = json.loads((out / "meta/info.json").read_text())["features"]
    assert {name for name, each in features.items() if each.get("info", {}).get("synthetic")} == {
        f"{LEFT}_{name}{kind}" for name in ("same", "moved") for kind in ("", "_visibility")
    }
    with pytest.raises(DataError, match="was made by a model"):
        _augment(out, tmp_path / "again", camera=f"{LEFT}_moved", view=None, poses=pose)
    assert f"`{LEFT}_moved`" in (out / "README.md").read_text()
    assert set(_only(out, LEFT, RIGHT).cameras) == set(LeRobotPairs(out).cameras) - {HAND}  # none by itself
    sample = _only(out, LEFT, f"{LEFT}_moved").sample(0)
    assert _apart(sample, _pose(0.1, 0.02)) < 1e-9


@pytest.mark.usefixtures("fake")
def test_episodes_that_are_done_stay_and_the_set_appears_when_all_are(made: Path, tmp_path: Path) -> None:
    work = _augment(made, tmp_path / "out")
    work.claim()
    work(work.episodes[0])
    poses = tmp_path / "poses.json"
    poses.write_text(json.dumps({"same": np.eye(4).tolist()}))
    _augment(made, tmp_path / "out", view=None, poses=poses).claim()  # the same view by another option
    poses.write_text(json.dumps({"same": _pose(0.1, 0.02).tolist()}))
    for other in ({"view": None, "poses": poses}, {"view": ["same=1"]}, {"hfov_deg": 50.0}):
        with pytest.raises(RunError, match="made otherwise"):
            _augment(made, tmp_path / "out", **other).claim()
    assert not work.out.exists()
    assert [work(episode) for episode in work.episodes] == [0, ROWS, ROWS]
    work.finish()
    assert len(_film(work.out, f"{LEFT}_same", 2)) == ROWS
    assert not work.parts.exists()


def test_a_model_of_clips_views_every_frame_once(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Six frames at a time of twenty: the last clip overlaps the one before."""
    model = FakeModel(traits_of(ModelConfig(frames=6, height=64, width=64, camera="spherical"), "kubric90"))
    monkeypatch.setattr(lerobot_augment, "_model", lambda *_: model)
    out = _made_of(_augment(made, tmp_path / "out", source_radius=None))
    for number in range(3):
        view, filmed = (_film(out, name, number).astype(int) for name in (f"{LEFT}_same", LEFT))
        assert np.abs(view - filmed).mean(axis=(1, 2, 3)).max() < 3.0
    assert not _film(out, f"{LEFT}_same_visibility", 0).any()  # it does not tell
    model.traits = replace(model.traits, config=msgspec.structs.replace(model.traits.config, frames=ROWS + 1))
    with pytest.raises(DataError, match="has 20 frames, fake works on 21"):
        _augment(made, tmp_path / "other", source_radius=None)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"camera": "top"}, DataError),
        ({"view": []}, RecipeError),
        ({"view": ["same"]}, RecipeError),
        ({"view": ["../up=1"]}, RecipeError),
        ({"view": ["up=0,1", "up=0,2"]}, RecipeError),
        ({"source_radius": None}, RecipeError),
        ({"poses": Path("missing.json")}, FileFault),
        ({"calibration": Path("missing.json")}, DataError),
    ],
)
@pytest.mark.usefixtures("fake")
def test_a_view_that_cannot_be_is_refused_before_anything_is_made(
    options: dict[str, Any], error: type[Exception], made: Path, tmp_path: Path
) -> None:
    with pytest.raises(error):
        _augment(made, tmp_path / "out", **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("fake")
def test_a_set_without_a_lens_asks_for_the_field_of_view_and_none_is_written_over(copied: Path, tmp_path: Path) -> None:
    (copied / CAMERA_FILE).unlink()
    with pytest.raises(DataError, match="--hfov-deg"):
        _augment(copied, tmp_path / "out")
    assert _augment(copied, tmp_path / "out", hfov_deg=60.0).cameras == {}
    with pytest.raises(RunError, match="is there already"):
        _augment(copied, copied, hfov_deg=60.0)
    with pytest.raises(RunError, match="lies in"):  # a copy of itself has no end
        _augment(copied, copied / "videos" / "out", hfov_deg=60.0)
    with pytest.raises(DataError, match="no LeRobot data set"):
        _augment(tmp_path, tmp_path / "out")


@pytest.mark.usefixtures("fake")
def test_statistics_count_frames_and_weigh_as_those_of_lerobot(made: Path, tmp_path: Path) -> None:
    """It joins sets by `count`; of pictures that is how many were looked at, not their pixels."""
    out = _made_of(_augment(made, tmp_path / "out"))
    stats = json.loads((out / "meta/stats.json").read_text())
    assert stats["observation.state"]["count"] == [2 * ROWS]  # of the two episodes that were written with it
    assert stats[LEFT]["count"] == [2 * -(-ROWS // 8)]
    assert stats[f"{LEFT}_same"]["count"] == [3 * ROWS]
    mean = _film(out, f"{LEFT}_same", 1).mean(axis=(0, 1, 2)) / 255
    rows = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    if f"stats/{LEFT}_same/mean" in rows[1]:
        np.testing.assert_allclose(np.ravel(rows[1][f"stats/{LEFT}_same/mean"]), mean, atol=0.02)


@pytest.mark.usefixtures("fake")
def test_a_view_goes_where_its_angles_say(made: Path, tmp_path: Path) -> None:
    """Right, up and farther, as seen by the camera: x right, y down, z ahead."""
    paths = _augment(made, tmp_path / "out", view=["right=10", "up=0,10", "back=0,0,0.5"]).paths
    x, y, z = (paths[name].source_from_target[-1, :3, 3] for name in ("right", "up", "back"))
    assert x[0] > 0.1
    assert y[1] < -0.1
    np.testing.assert_allclose(z, [0.0, 0.0, -0.5], atol=1e-9)


@pytest.mark.slow
def test_the_live_model_augments_by_the_command(copied: Path, tmp_path: Path) -> None:
    """Frames of its view agree with the camera's where it stands in the same place."""
    line = ["augment", "lerobot", copied, "--out", tmp_path / "out", "--camera", "left", "--view", "same=0"]
    code, said = ran(*line, "--source-radius", "1.0", "--workers", "2")
    assert code == 0, said
    for number in range(3):
        view, filmed = (_film(tmp_path / "out", name, number).astype(int) for name in (f"{LEFT}_same", LEFT))
        assert np.abs(view - filmed).mean() < 4.0
    assert (_film(tmp_path / "out", f"{LEFT}_same_visibility", 0) == 255).mean() > 0.9
    assert ran(*line)[0] == RunError.exit_code


# the tabletop world


@needs_egl
def test_a_tabletop_episode_is_exported_and_read_back(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="needs the extra `scenes`: pip install 'gcd-node[scenes]'")
    out = tmp_path / "robot"
    export = TabletopExport(
        episodes=1, first_seed=3, frames=20, cameras="view0,wrist", width=64, height=48, oversample=1
    )
    assert list(export_tabletop(out, export)) == [1]
    assert [path.name for path in tmp_path.iterdir()] == ["robot"]
    sample = LeRobotPairs(out, size=(64, 48)).sample(0)
    assert sample.source.shape == (14, 48, 64, 3)
    assert sample.source.std() > 10
    assert np.ptp(sample.source_from_target[:, :3, 3], axis=0).max() > 0.01  # the hand moves
    told = json.loads((out / CAMERA_FILE).read_text())["cameras"]["observation.images.view0"]
    base_from_camera = np.asarray(told["base_from_camera"])
    np.testing.assert_allclose(base_from_camera[:3, 3], [0.36 + 1.5 * np.sqrt(0.5), 0.0, 0.22 + 1.5 * np.sqrt(0.5)])
    with pytest.raises(RunError, match="is there already"):
        list(export_tabletop(out, export))


def test_the_command_says_what_it_read(made: Path) -> None:
    code, said = ran("lerobot", made, "--samples", "2", "--frames", "4")
    assert code == 0, said
    assert "3 episodes at 20 frames per second" in said
    assert said.count("m apart") == 2
