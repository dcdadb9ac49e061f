"""AnyViewBench: its layout read and written, its grid and means, and what does not fit, refused in one line."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import msgspec
import numpy as np
import pytest
import torch
from driving_plane import PlaneClips
from fake_model import FakeModel
from made_records import note, record
from tiny_scenes4d import driving_pose, write_driving, write_kubric
from tiny_world import smaller
from typer.testing import CliRunner

from gcd_model.geometry import Intrinsics, relative_pose, sphere_poses
from gcd_train.cli.main import app
from gcd_train.data.anyview import CameraVideo, Episode, EpisodeExport, write_episode
from gcd_train.data.dataset4d import Dataset4D
from gcd_train.data.files import MANIFEST, Matrix, SceneManifest
from gcd_train.data.kubric4d import Kubric4D
from gcd_train.errors import DataError, RecipeError, TrainError
from gcd_train.evaluation.anyview import benchmark_table, grid_size, published_table
from gcd_train.evaluation.hexplane import HexPlane
from gcd_train.evaluation.methods import EvaluateOptions, baselines, run_note
from gcd_train.evaluation.metrics import Lpips
from gcd_train.evaluation.opening import ClipOptions, open_clips
from gcd_train.evaluation.per_scene import Shown
from gcd_train.evaluation.predictors import pixel_rays, through_lens
from gcd_train.evaluation.runs import gather, on_the_same_goals
from gcd_train.evaluation.store import Run
from gcd_train.evaluation.synthesized import SynthesizedViews
from gcd_train.pictures import write_mp4

FRAMES, HEIGHT, WIDTH = 6, 12, 144
GRID = (48, 576)


def filmed(
    *, azimuth_deg: float = 0.0, level: int | None = None, black: Sequence[int] = (), frames: int = FRAMES
) -> CameraVideo:
    """A camera that goes round, with a lens that is not centred. level: grey; None: soft colours."""
    path = torch.tensor([[azimuth_deg + 3.0 * t, 10.0, 15.0] for t in range(frames)], dtype=torch.float64)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    soft = np.stack([8 * rows, columns, rows + columns], -1).astype(np.uint8)
    pictures = [soft + np.uint8(t) if level is None else np.full_like(soft, level) for t in range(frames)]
    for t in black:
        pictures[t] = np.zeros_like(soft)
    lens = Intrinsics(fx=50.0, fy=52.0, cx=73.0, cy=7.0, width=WIDTH, height=HEIGHT)
    return CameraVideo(pictures=pictures, lenses=[lens] * frames, poses=sphere_poses(path).numpy())


def episode(folder: Path, target: CameraVideo | None = None, source: CameraVideo | None = None) -> Path:
    folder.mkdir(parents=True)
    target = filmed(azimuth_deg=90.0) if target is None else target
    write_episode(
        folder, {"cam0": target, "cam1": filmed(frames=len(target.pictures)) if source is None else source}, 10.0
    )
    return folder


def benchmark(root: Path, groups: dict[str, list[str]]) -> Path:
    root.mkdir(exist_ok=True)
    (root / "splits.json").write_text(json.dumps({"groups": groups, "version": 1}))
    return root


def run(*line: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(each) for each in line], env={"COLUMNS": "200"})
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output


# --- the layout ------------------------------------------------------------------------------------------------------


def as_videos(folder: Path) -> None:
    """The other form of an episode: a video and one npz for each camera."""
    for camera in ("cam0", "cam1"):
        frames = sorted((folder / "rgb" / camera).iterdir())
        write_mp4([cv2.imread(str(path))[..., ::-1] for path in frames], 10.0, folder / "rgb" / f"{camera}.mp4")
        each = [np.load(path) for path in sorted((folder / "lowdim" / camera).iterdir())]
        np.savez(folder / "lowdim" / f"{camera}.npz", **{k: np.stack([one[k] for one in each]) for k in each[0]})
        for path in (*frames, *(folder / "lowdim" / camera).iterdir()):
            path.unlink()
        (folder / "rgb" / camera).rmdir()
        (folder / "lowdim" / camera).rmdir()


@pytest.mark.parametrize(("other", "levels"), [(False, 4), (True, 40)])
def test_what_is_written_is_read_again(tmp_path: Path, other: bool, levels: int) -> None:
    made = filmed(azimuth_deg=90.0)
    folder = episode(tmp_path / "e", made)
    if other:
        as_videos(folder)
    opened = Episode.open(folder)
    assert opened is not None
    assert (opened.frames, opened.fps, opened.height, opened.width) == (FRAMES, 10.0, HEIGHT, WIDTH)
    found = opened.read("cam0", 4)
    assert np.abs(found.poses - made.poses[:4]).max() < 1e-6
    assert found.lenses == list(made.lenses[:4])
    apart = np.abs(np.stack(found.pictures).astype(int) - np.stack(made.pictures[:4]))
    assert apart.max() <= levels  # of JPEG, of a video


def read(folder: Path, camera: str, frames: int = FRAMES) -> CameraVideo:
    opened = Episode.open(folder)
    assert opened is not None
    return opened.read(camera, frames)


def told(**changes: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / "metadata.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return change


def stored(**changes: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / "lowdim" / "cam0" / "0000000002.npz"
        np.savez(path, **{**dict(np.load(path)), **changes})

    return change


def without(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


POSE, LENS = np.eye(4), np.array([[50.0, 0, 73], [0, 52, 7], [0, 0, 1]])


@pytest.mark.parametrize(
    "damage",
    [
        told(cameras=["cam1", "cam02"]),
        told(num_frames=FRAMES + 1),
        told(resolution=[WIDTH, HEIGHT]),
        told(framerate=0),
        without("rgb/cam0/0000000003.jpg"),
        without("lowdim/cam1/0000000003.npz"),
        stored(extrinsics=2 * POSE),
        stored(extrinsics=POSE[:3]),
        stored(extrinsics=np.array([{"a": 1}], object)),  # a pickle
        stored(intrinsics=LENS * np.nan),
        stored(intrinsics=LENS + np.array([[0, 9, 0], [0, 0, 0], [0, 0, 0]])),
        lambda folder: (folder / "rgb/cam0").rename(folder / "rgb/cam2"),
    ],
)
def test_an_episode_that_contradicts_itself_is_named(tmp_path: Path, damage: Callable[[Path], None]) -> None:
    folder = episode(tmp_path / "e")
    damage(folder)
    with pytest.raises(DataError, match=str(folder)):
        read(folder, "cam0")


# --- the protocol ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("native", "grid"),
    [((1080, 1920), (304, 576)), ((480, 640), (432, 576)), ((1920, 1080), (576, 304)), ((384, 576), (384, 576))],
)
def test_the_grid_is_that_of_two_stages_with_ties_rounded_down(native: tuple[int, int], grid: tuple[int, int]) -> None:
    assert grid_size(*native) == grid


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two groups of one and two splits of grey episodes, of other lengths, one without pixels; and predictions."""
    root = benchmark(tmp_path_factory.mktemp("bench"), {"far": ["far_a"], "near": ["near_a", "near_b", "near_c"]})
    for name, frames in {"far_a/e0": 6, "near_a/e0": 9, "near_a/e1": 6, "near_b/e0": 6}.items():
        episode(root / name, filmed(level=100, black=(1,) if name == "near_b/e0" else (), frames=frames))
    hidden = episode(root / "near_c" / "e0")
    (hidden / "rgb").rename(root / "away")
    (hidden / "fetch_manifest.json").write_text("{}")
    for key, level in PREDICTED.items():
        place = root / "mine" / key / "frames"
        place.mkdir(parents=True)
        for t in range(9 if key == "near_a.e0" else 5):
            cv2.imwrite(
                str(place / f"{t:04d}.png"),
                np.full((*GRID, 3), 255 if key == "near_b.e0" and t == 1 else level, np.uint8),
            )
    return root


PREDICTED = {"far_a.e0": 90, "near_a.e0": 110, "near_a.e1": 130, "near_b.e0": 60}


def db(level: int) -> float:
    return float(-20 * np.log10(abs(level - 100) / 255))


def test_means_go_by_episode_split_and_group_without_black_targets(root: Path, tmp_path: Path) -> None:
    line = ("evaluate", "--data", root, "--protocol", "anyviewbench", "--out", tmp_path / "out", "--views", "none")
    code, said = run(*line, "--methods", "copy_source", "--predictions", f"mine={root / 'mine'}")
    assert code == 0, said
    assert "near_c" in said
    assert "1 of 1 episodes have no pixels" in said
    found = Run.read(tmp_path / "out")
    assert {each.key: each.frames for each in found.records} == dict(zip(PREDICTED, (5, 9, 5, 5), strict=True))
    black = next(each for each in found.records if (each.method, each.key) == ("mine", "near_b.e0"))
    assert [value is None for value in (black.regions["all"].psnr_db or ())[0]] == [False, True, False, False, False]
    table = benchmark_table(gather([found])[0])
    got = {row.label: row.cells[0].figure.value for row in table.rows if row.method == "mine"}
    near_a = (db(110) + db(130)) / 2
    near = (near_a + db(60)) / 2
    wanted = {"far": db(90), "near: near_a": near_a, "near": near, "mean over groups": (db(90) + near) / 2}
    assert {label: got[label] for label in wanted} == pytest.approx(wanted)
    assert ("5, 9 frames" in table.notes[0], "or beyond --limit: near_c (1 of 1)." in table.notes[1]) == (True, True)
    run(*line[:5], "--out", tmp_path / "first", "--methods", "copy_source", "--limit", "1")
    assert "near_a (1 of 2), near_c (1 of 1)." in benchmark_table(gather([Run.read(tmp_path / "first")])[0]).notes[1]
    report = (tmp_path / "out" / "report.md").read_text()
    assert ("Published, not measured here" in report, "11.57" in report) == (True, True)
    assert "flicker" in (tmp_path / "out" / "tables" / "regions.csv").read_text()
    assert "11.57" not in (tmp_path / "out" / "tables" / "anyviewbench.csv").read_text()
    assert "0 measured, 4 there already" in run(*line, "--methods", "copy_source")[1]  # goes on where it stopped
    code, said = run(*line, "--methods", "copy_source", "--frames", "5")
    assert (code, "data_identity" in said) == (73, True)


def test_a_mean_is_unknown_unless_all_its_episodes_were_measured(root: Path) -> None:
    told = note(
        kind="anyview",
        protocol="anyviewbench",
        data_identity="its own",
        groups={"a": {"a1": ("a1.e",)}, "b": {"b1": ("b1.e", "b1.f")}},
    )
    both = [
        record("model", "a1.e"),
        record("model", "b1.e"),
        *(record("copy", key) for key in ("a1.e", "b1.e", "b1.f")),
    ]
    of = gather([Run(folder=root, note=told, records=tuple(both))])[0]
    found = {(row.method, row.label): str(row.cells[0]) for row in benchmark_table(of).rows}
    assert found["model", "mean over groups"] == found["model", "b: b1"] == "-"  # of b1 one of two
    assert found["copy", "mean over groups"] == found["model", "a"] == "20.00"
    assert {row.method for row in published_table().rows}.isdisjoint({"model", "copy"})
    other = Run(folder=root, note=note(), records=(record("other", "a1.e"),))
    assert on_the_same_goals(gather([Run(folder=root, note=told, records=tuple(both)), other])) == ((), ())


def test_both_cameras_may_move(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = [filmed(azimuth_deg=each) for each in (90.0, 0.0)]
    episode(benchmark(tmp_path, {"g": ["s"]}) / "s" / "deep" / "e", *made)
    clips, _ = open_clips(ClipOptions(data=[tmp_path], protocol="anyviewbench", frames=4))
    assert clips.keys == ("s.deep-e",)
    seen = clips.clip("s.deep-e").seen
    cameras = seen.cameras
    poses = [torch.from_numpy(each.poses[:4]) for each in made]
    torch.testing.assert_close(cameras.source_from_target, torch.linalg.inv(poses[1]) @ poses[0])
    torch.testing.assert_close(cameras.ground_from_source, poses[1])
    assert (cameras.source.fx, cameras.source.cy) == (50 * 4, 7 * 4)

    def learn(self: HexPlane, pictures: Sequence[Shown], *rest: object) -> None:
        given = torch.stack([camera.world_from_camera for _, camera in pictures])
        raise DataError(f"learns from {(given - poses[1]).abs().max():.3f}")

    monkeypatch.setattr(HexPlane, "learn", learn)
    with pytest.raises(DataError, match=r"learns from 0\.000"):
        HexPlane().predict(seen)


@pytest.mark.parametrize(("fx", "zooms"), [(60.0, True), (50.0 + 1e-5, False)])
def test_a_lens_that_zooms_is_refused_by_what_takes_one(tmp_path: Path, fx: float, zooms: bool) -> None:
    still = filmed(azimuth_deg=90.0)
    target = replace(still, lenses=[*still.lenses[:-1], replace(still.lenses[0], fx=fx)])
    episode(benchmark(tmp_path, {"g": ["s"]}) / "s" / "e", target)
    clips, _ = open_clips(ClipOptions(data=[tmp_path], protocol="anyviewbench", frames=FRAMES))
    clip = clips.clip("s.e")
    assert clip.seen.cameras.zooms == zooms
    if zooms:
        with pytest.raises(DataError, match="zooms"):
            HexPlane().predict(clip.seen)


def test_a_folder_without_splits_is_one_split_seen_by_the_cameras_that_are_chosen(tmp_path: Path) -> None:
    made = {f"cam{number:02d}": filmed(azimuth_deg=40.0 * number) for number in range(3)}
    folder = tmp_path / "kubric5d" / "scn00001"
    folder.mkdir(parents=True)
    write_episode(folder, made, 24.0)
    options = ClipOptions(data=[folder.parent], protocol="anyviewbench", camera=["cam02", "cam00"])
    clips, _ = open_clips(options)
    assert clips.keys == ("kubric5d.scn00001",)
    cameras = clips.clip(clips.keys[0]).seen.cameras
    poses = [torch.from_numpy(made[name].poses[:5]) for name in ("cam02", "cam00")]
    torch.testing.assert_close(cameras.source_from_target, relative_pose(*poses))
    other, _ = open_clips(replace(options, camera=["cam01", "cam00"]))
    assert other.identity != clips.identity
    for camera, error in ((["cam02"], RecipeError), (["cam02", "cam03"], DataError), (None, DataError)):
        with pytest.raises(error):
            open_clips(replace(options, camera=camera))


def test_linked_episodes_are_found_and_belong_to_the_last_folder_that_is_a_split(tmp_path: Path) -> None:
    episode(tmp_path / "store" / "e")
    root = benchmark(tmp_path / "bench", {"g": ["s", "t"]})
    (root / "s" / "t").mkdir(parents=True)
    (root / "s" / "t" / "linked").symlink_to(tmp_path / "store" / "e")
    options = ClipOptions(data=[root], protocol="anyviewbench")
    clips, _ = open_clips(options)
    assert clips.keys == ("t.linked",)
    benchmark(root, {"g": ["s"], "h": ["t"]})
    assert open_clips(options)[0].identity != clips.identity


@pytest.mark.parametrize("names", [("s/a/b-c", "s/a-b/c"), ("s/1/2/3/4/5/e",), ("s/bare",)])
def test_episodes_of_one_name_too_deep_or_bare_are_not_left_out(tmp_path: Path, names: tuple[str, ...]) -> None:
    benchmark(tmp_path, {"g": ["s"]})
    for name in ("s/e", *names):
        episode(tmp_path / name)
    (tmp_path / "s/bare/metadata.json").unlink(missing_ok=True)
    with pytest.raises(DataError):
        open_clips(ClipOptions(data=[tmp_path], protocol="anyviewbench"))


def test_another_lens_in_the_same_place_shows_the_same_directions() -> None:
    wide = Intrinsics.from_hfov(90.0, 96, 64)
    narrow = Intrinsics(fx=100.0, fy=80.0, cx=30.0, cy=20.0, width=60, height=40)

    def picture(lens: Intrinsics) -> torch.Tensor:
        rays = pixel_rays(lens)
        return (0.5 + 0.3 * rays[..., :2].sin()).float().permute(2, 0, 1)[[0, 1, 0]][None]

    assert (through_lens(picture(wide), wide, narrow) - picture(narrow)).abs().max() < 1e-2
    back = through_lens(picture(narrow), narrow, wide)
    seen = back.amax(dim=1) > 0
    assert 0.05 < float(seen.float().mean()) < 0.5
    assert ((back - picture(wide)).abs().amax(dim=1) * seen).max() < 2e-2


def test_a_live_model_is_told_lens_and_motion_at_its_own_size_and_drawn_at_the_grid(root: Path) -> None:
    model = FakeModel(
        SimpleNamespace(name="live", live=True, splat="none", classes=(), family=None, config=smaller(4, 64, 96))
    )
    clips, _ = open_clips(ClipOptions(data=[root], protocol="anyviewbench", split="far"), model.traits)
    assert (clips.keys, clips.frames) == (("far_a.e0",), 4)
    clip = clips.clip("far_a.e0")
    made = SynthesizedViews.of(lambda: model, clips).predict(clip.seen)
    assert made.video.shape == (4, 3, *GRID)  # pyright: ignore
    (given,) = model.clips
    assert given.video.shape == (4, 3, 64, 96)
    assert given.lens == clip.seen.cameras.source.resized(96, 64)
    assert given.odometry is clip.seen.cameras.ground_from_source


@pytest.mark.parametrize(
    ("line", "code", "said"),
    [
        (["--methods", "ground_homography"], 78, "wants depth or the ground"),
        (["--methods", "reproject_semd"], 78, "reproject_semd makes classes alone"),
        (["--methods", "hexplane_4"], 78, "hexplane_4 wants 4 cameras"),
        (["--frames", "7"], 66, "has 6 frames"),
        (["--split", "other"], 78, "has no split or group 'other'"),
        (["--trajectories", "2"], 78, "leave out all other choices"),
        (["--frame-start", "0"], 78, "leave out all other choices"),
        (["--protocol", "paper"], 66, "give --protocol anyviewbench"),
        (["--predictions", "x=mine/far_a.e0", "--no-baselines"], 70, "holds no frames for clip far_a.e0"),
    ],
)
def test_what_does_not_fit_the_benchmark_is_one_line(
    root: Path, tmp_path: Path, line: list[str], code: int, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(root)
    usual = [] if "--protocol" in line else ["--protocol", "anyviewbench"]
    got, output = run("evaluate", "--data", root, *usual, *line, "--out", tmp_path / "out")
    assert (got, said in " ".join(output.split())) == (code, True), output


def test_its_lpips_is_that_of_vgg_and_its_noise_one(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Lpips, "open", lambda folder: SimpleNamespace(network="alex", identity="alex-0"))
    options = EvaluateOptions(data=[root], protocol="anyviewbench", lpips=root, svd="random:svd")
    clips, _ = open_clips(options)
    with pytest.raises(DataError, match="VGG16"):
        run_note(clips, (), options, "")
    assert [method.shared_noise for method in baselines(["vanilla_svd"], clips, options)] == [True]  # pyright: ignore


def test_a_model_without_free_poses_or_of_another_length_is_refused(root: Path) -> None:
    options, config = ClipOptions(data=[root], protocol="anyviewbench", frames=5), smaller(4, 64, 96)
    for live, said in ((False, "cameras are anywhere"), (True, "makes clips of 4 frames")):
        with pytest.raises(TrainError, match=said):
            open_clips(options, SimpleNamespace(name="a", live=live, config=config))  # pyright: ignore


def test_folders_that_are_no_benchmark_are_one_line(tmp_path: Path) -> None:
    options = ClipOptions(data=[tmp_path], protocol="anyviewbench")
    for groups in ({}, {"a": ["s"], "b": ["s"]}, {"a": ["s"]}):
        with pytest.raises(DataError):
            open_clips(replace(options, data=[benchmark(tmp_path, groups)]))
    episode(tmp_path / "t" / "e")
    with pytest.raises(DataError, match="in no folder of a split"):
        open_clips(options)
    (tmp_path / "splits.json").unlink()
    with pytest.raises(DataError, match=r"splits\.json"):
        open_clips(options)
    with pytest.raises(RecipeError, match="--frames"):
        open_clips(replace(options, protocol="paper", frames=5))


# --- our scenes ------------------------------------------------------------------------------------------------------


def test_scenes_of_both_layouts_become_episodes_that_are_measured(tmp_path: Path) -> None:
    write_kubric(tmp_path / "kubric", 7, views=2, frames=5)
    write_driving(tmp_path / "driving", 5, frames=5)
    out = tmp_path / "out"
    code, said = run("export", "anyview", tmp_path / "kubric", out, "--view", "view1:view9")
    assert (code, (out / "splits.json").exists()) == (66, False), said
    assert run("export", "anyview", tmp_path / "kubric", tmp_path / "kubric" / "in")[0] == 78
    for source, views in (("kubric", ["view1:view0", "view0:view1"]), ("driving", ["yaw-0:camera0"])):
        code, said = run("export", "anyview", tmp_path / source, out, *(word for v in views for word in ("--view", v)))
        assert code == 0, said
    groups = json.loads((out / "splits.json").read_text())["groups"]
    assert groups == {
        "kubric4d": ["kubric4d-view1-view0", "kubric4d-view0-view1"],
        "parallel_domain4d": ["parallel_domain4d-yaw-0-camera0"],
    }
    written = out / "kubric4d-view1-view0" / "scn00007"
    scene: Dataset4D = Kubric4D(tmp_path / "kubric", cameras=("view0", "view1"))
    for camera, name in (("cam0", "view0"), ("cam1", "view1")):
        found, true = read(written, camera, 5), [scene.view("scn00007", name, time) for time in range(5)]
        assert np.abs(found.poses - np.stack([each.world_from_camera for each in true])).max() < 1e-6
        assert found.lenses[0] == true[0].lens
        apart = np.stack(found.pictures).astype(int) - np.stack([each.rgb for each in true])
        assert np.abs(apart).mean() < 1  # JPEG
    clips, notes = open_clips(ClipOptions(data=[out], protocol="anyviewbench"))
    assert (len(clips.keys), notes) == (3, ())
    assert clips.clip("parallel_domain4d-yaw-0-camera0.scene_000005").target.shape == (5, *grid_size(36, 48), 3)


def test_cameras_on_our_vehicles_move_with_them(tmp_path: Path) -> None:
    way = np.tile(np.eye(4), (3, 1, 1))
    way[:, 0, 3] = [0.0, 1.5, 4.0]
    manifest = SceneManifest(
        layout="parallel_domain4d",
        world="driving",
        seed=5,
        version="0",
        edition=1,
        compact=False,
        frames=3,
        fps=10.0,
        width=48,
        height=36,
        oversample=1,
        hfov_deg=85.0,
        files={},
        cameras=("yaw-0", "camera0"),
        world_from_vehicle=msgspec.convert(way.tolist(), tuple[Matrix, ...]),
    )
    (write_driving(tmp_path / "in", 5, frames=3) / MANIFEST).write_bytes(msgspec.json.encode(manifest))
    work = EpisodeExport.of(tmp_path / "in", tmp_path / "out", ["yaw-0:camera0"])
    assert [work(item) for item in work.items] == [True]
    assert work.finish() == ("driving-yaw-0-camera0",)
    found = read(tmp_path / "out" / "driving-yaw-0-camera0" / "scene_000005", "cam0", 3)
    assert np.abs(found.poses - way @ driving_pose("camera0")).max() < 1e-6


def test_pairs_become_episodes_with_both_cameras(tmp_path: Path) -> None:
    PlaneClips.make(2, frames=5).write(tmp_path / "pairs")
    work = EpisodeExport.of(tmp_path / "pairs", tmp_path / "out")
    assert [work(item) for item in (*work.items, work.items[0])] == [True, True, False]
    assert work.finish() == ("driving-pairs",)
    written = tmp_path / "out" / work.items[1].partition("/")[2]
    picture = written / "rgb" / "cam1" / "0000000000.jpg"
    stored = picture.read_bytes()
    cv2.imwrite(str(picture), 255 - cv2.imread(str(picture)))
    with pytest.raises(RecipeError, match="another scene"):
        work(work.items[1])
    picture.write_bytes(stored)
    source, target = (read(written, camera, 5) for camera in ("cam1", "cam0"))
    way = relative_pose(*(torch.from_numpy(each.poses) for each in (source, target)))
    torch.testing.assert_close(way, work.data.trajectory(1).source_from_target)  # pyright: ignore
    with pytest.raises(RecipeError, match="leave out --view"):
        EpisodeExport.of(tmp_path / "pairs", tmp_path / "out", ["a:b"])
