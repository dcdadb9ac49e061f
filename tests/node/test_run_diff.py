"""Two runs compared: what counts as the same, how far apart they are, and what is said and shown of it."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from fakes import FakeSource, painting_traits, traits
from runs import FRAMES, WINDOWS, LevelModel, copied, made_run, nan_model

from gcd_model import View
from gcd_node.cli.main import run_app
from gcd_node.errors import DamagedRunError, UsageError
from gcd_node.frame import Frame
from gcd_node.image_io import write_video
from gcd_node.replay.compare import Tolerance, ViewComparison, compare, report_text, to_plain
from gcd_node.replay.run import MANIFEST, RunFolder, SizeEntry, encode_manifest, open_run, pixel_digest

pytestmark = pytest.mark.timeout(60)
EXACT = Tolerance()


@pytest.fixture(scope="module")
def golden(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return made_run(tmp_path_factory.mktemp("golden") / "run")


def lowered(folder: Path, lower: Mapping[tuple[int, int], int]) -> RunFolder:
    return made_run(folder, LevelModel(traits(), lower))


def classed(folder: Path, columns: Mapping[int, int]) -> RunFolder:
    return made_run(folder, LevelModel(painting_traits(), classes=columns), FakeSource(42, fps=10.0))


def restated(run: RunFolder, folder: Path, **changes: object) -> RunFolder:
    """A copy of a run whose manifest says something else."""
    copied(run, folder)
    (folder / MANIFEST).write_bytes(encode_manifest(msgspec.structs.replace(run.manifest, **changes)))
    return open_run(folder)


# How far apart.


def test_a_run_is_identical_to_its_repetition(golden: RunFolder, tmp_path: Path) -> None:
    comparison = compare(golden, made_run(tmp_path / "run"))
    assert (comparison.facts, comparison.failures()) == ({}, ())
    assert report_text(comparison, EXACT) == "identical: all 3 views"


def test_psnr_is_that_of_the_definition(golden: RunFolder, tmp_path: Path) -> None:
    other = lowered(tmp_path / "run", {(0, frame): 10 for frame in range(FRAMES)})
    distance = compare(golden, other).views[0].distance
    assert distance is not None
    assert distance.psnr_db == pytest.approx(20 * math.log10(255 / 10))
    assert distance.worst_psnr_db == pytest.approx(distance.psnr_db)
    assert distance.largest == 10
    assert compare(other, golden).views == compare(golden, other).views


def test_one_bad_frame_is_not_hidden_by_thirteen_good_ones(golden: RunFolder, tmp_path: Path) -> None:
    comparison = compare(golden, lowered(tmp_path / "run", {(1, 9): 10}))
    view = comparison.views[1]
    assert view.distance is not None
    frame_db = 20 * math.log10(25.5)
    assert view.distance.worst_frame == 9
    assert view.distance.worst_psnr_db == pytest.approx(frame_db)
    assert view.distance.psnr_db == pytest.approx(frame_db + 10 * math.log10(FRAMES))
    assert view.within(Tolerance(min_psnr_db=frame_db - 0.01))
    assert not view.within(Tolerance(min_psnr_db=frame_db + 0.01))
    assert comparison.failures() == (view,)


def test_class_pixels_have_a_bound_of_their_own(tmp_path: Path) -> None:
    comparison = compare(classed(tmp_path / "a", {}), classed(tmp_path / "b", {1: 48}))
    view = comparison.views[1]
    assert view.distance is not None
    share = 48 / 96 / FRAMES  # half of the columns, in one frame
    assert view.distance.shares == {"cls": pytest.approx(share)}
    assert view.distance.largest == 0
    assert not view.within(Tolerance(min_psnr_db=10.0))
    assert not view.within(Tolerance(max_class_share=0.9 * share))
    assert view.within(Tolerance(max_class_share=1.1 * share))


class MovedMaps(LevelModel):
    """Its inverse depth is so many times the usual one, and `columns` of its visibility are painted instead."""

    def __init__(self, factor: float, columns: int) -> None:
        super().__init__(traits(), holds=("visibility", "inverse_depth"))
        self._factor, self._columns = factor, columns

    def render(self, *asked: Any) -> list[View]:
        views = super().render(*asked)
        for view in views:
            assert view.visibility is not None
            assert view.inverse_depth is not None
            view.inverse_depth.mul_(self._factor)
            view.visibility[..., : self._columns] = 0
        return views


def test_depth_and_visibility_count_like_class_pixels(tmp_path: Path) -> None:
    usual = made_run(tmp_path / "usual", MovedMaps(1.0, 0))
    near = compare(usual, made_run(tmp_path / "near", MovedMaps(1.005, 0))).views[0]
    assert not near.within(EXACT)
    assert near.within(Tolerance(max_class_share=0.001))
    far = compare(usual, made_run(tmp_path / "far", MovedMaps(1.05, 24))).views[0]
    assert far.distance is not None
    assert far.distance.shares["depth"] == pytest.approx(6 / 7, abs=0.01)  # the others have none
    assert far.distance.shares["vis"] == pytest.approx(24 / 96 * 2 / 3, abs=0.01)
    assert not far.within(Tolerance(max_class_share=0.8))
    assert "of the depth" in str(far)
    assert compare(usual, made_run(tmp_path / "plain")).views[0].facts == ("visibility", "depth")


# What always fails.


def test_a_window_that_only_one_run_has_fails_and_shifts_none_of_the_others(golden: RunFolder, tmp_path: Path) -> None:
    longer = made_run(tmp_path / "longer", source=FakeSource(4 * FRAMES))
    comparison = compare(golden, longer)
    missing = ViewComparison(window_id=3, view_id="main", only_in="B")
    assert comparison.failures(Tolerance(min_psnr_db=1.0)) == (missing,) == comparison.failures()
    assert compare(longer, golden).views[-1].only_in == "A"
    holed = compare(golden, made_run(tmp_path / "holed", nan_model({1})))
    assert [(view.window_id, view.only_in) for view in holed.views] == [(0, None), (1, "A"), (2, None)]
    assert [view.within(EXACT) for view in holed.views] == [True, False, True]
    facts = {"total windows", "total nan_windows", "trouble MODEL_NAN in window 1"}
    assert set(holed.facts) == facts


@pytest.mark.parametrize(
    ("field", "value"),
    [("stamps", tuple((9, i) for i in range(FRAMES))), ("seqs", tuple(range(1, FRAMES + 1))), ("epoch", 4), ("ood", 0)],
)
def test_other_moments_and_flags_fail_even_if_the_pixels_agree(
    field: str, value: object, golden: RunFolder, tmp_path: Path
) -> None:
    first, *others = golden.manifest.windows
    view = msgspec.structs.replace(first.views["main"], ood=("fps",))
    changes = {"views": {"main": view}} if field == "ood" else {field: value}
    changed = msgspec.structs.replace(first, **changes)
    comparison = compare(golden, restated(golden, tmp_path / "run", windows=(changed, *others)))
    assert comparison.views[0].facts == (field,)
    assert not comparison.views[0].within(Tolerance(min_psnr_db=1.0))


@pytest.mark.parametrize("honest", [True, False])
def test_pictures_of_another_size_cannot_be_near_and_a_lie_about_it_is_damage(
    honest: bool, golden: RunFolder, tmp_path: Path
) -> None:
    black = np.zeros((FRAMES, 16, 24, 3), np.uint8)
    size = SizeEntry(frames=FRAMES, height=16, width=24) if honest else golden.manifest.size
    windows = []
    for window in golden.manifest.windows:
        view = msgspec.structs.replace(window.views["main"], sha256={"win": pixel_digest(black)})
        windows.append(msgspec.structs.replace(window, views={"main": view}))
    resized = restated(golden, tmp_path / "run", windows=tuple(windows), size=size)
    (resized.path / "main.mkv").unlink()
    write_video(resized.path / "main.mkv", [*black] * WINDOWS, 10.0)
    if honest:
        comparison = compare(golden, resized)
        assert comparison.views[0].facts == ("size",)
        assert len(comparison.failures(Tolerance(min_psnr_db=1.0))) == WINDOWS
    else:
        with pytest.raises(DamagedRunError):
            compare(golden, resized)


@pytest.mark.parametrize("bounds", [{"min_psnr_db": 0.0}, {"min_psnr_db": math.nan}, {"max_class_share": 1.5}])
def test_bounds_that_make_no_sense_are_refused(bounds: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        Tolerance(**bounds)


# What is said.


def test_what_the_runs_were_made_from_is_named_first(golden: RunFolder, tmp_path: Path) -> None:
    other = made_run(tmp_path / "run", changes=["model.steps=3", "source.resize=area", "life.nice=3"])
    made_from = other.manifest.made_from | {"weights sha256_12": "f" * 12, "version torch": "\x1b]0;mine\x07"}
    comparison = compare(golden, restated(other, tmp_path / "restated", made_from=made_from))
    assert [(name, *values) for name, values in comparison.facts.items()] == [
        ("config source.resize", "released", "area"),
        ("config model.steps", "1", "3"),
        ("weights sha256_12", "0" * 12, "f" * 12),
        ("version torch", golden.manifest.made_from["version torch"], "\\x1b]0;mine\\x07"),  # commands no terminal
    ]
    text = report_text(comparison, EXACT)
    assert text.index("model.steps: 1, 3") < text.index("first divergence: window 0, view main")


class Brighter(FakeSource):
    def frames(self) -> Any:
        for frame in super().frames():
            yield Frame(image=frame.image + 1, stamp_ns=frame.stamp_ns, seq=frame.seq)


def test_the_first_divergence_says_whether_input_and_seed_were_the_same(golden: RunFolder, tmp_path: Path) -> None:
    def last_but_failures(run: RunFolder) -> str:
        return report_text(compare(golden, run), Tolerance(min_psnr_db=1.0)).splitlines()[-1]

    same = last_but_failures(lowered(tmp_path / "same", {(2, 0): 1}))
    assert same.startswith("first divergence: window 2, view main: ")
    assert same.endswith("the model was given the same pictures")
    other = made_run(tmp_path / "input", source=Brighter(42))
    assert "the model was given other pictures already" in last_but_failures(other)
    seed = made_run(tmp_path / "seed", LevelModel(traits(), {(0, 0): 1}), changes=["model.cond_aug=0.01"])
    assert "same pictures and another seed" in last_but_failures(seed)


def test_verdict_and_json_agree(golden: RunFolder, tmp_path: Path) -> None:
    comparison = compare(golden, lowered(tmp_path / "run", {(1, 4): 5}))
    assert report_text(comparison, Tolerance(min_psnr_db=30.0)).startswith("near enough: 2 of 3")
    assert report_text(comparison, Tolerance(min_psnr_db=60.0)).startswith("DIFFERENT: 1 of 3")
    plain = json.loads(msgspec.json.encode(to_plain(comparison, EXACT)))
    assert (plain["passed"], plain["identical"]) == (False, False)
    assert plain["first_divergence"] == {"window_id": 1, "view_id": "main"}
    distances = [view["distance"] for view in plain["views"]]
    assert [distance["psnr_db"] is None for distance in distances] == [True, False, True]
    assert distances[1]["worst_frame"] == 4


def test_exit_codes_tell_same_different_damaged_and_missing(
    golden: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = lowered(tmp_path / "run", {(1, 4): 5})
    damaged = copied(golden, tmp_path / "damaged")
    (damaged / MANIFEST).write_text("{")
    a, b = str(golden.path), str(other.path)
    assert run_app(["diff", a, a]) == 0
    assert run_app(["diff", a, b]) == 1
    assert run_app(["diff", a, b, "--min-psnr", "30"]) == 0
    assert run_app(["diff", a, str(damaged)]) == 65
    assert run_app(["diff", str(tmp_path / "nowhere"), b]) == 66
    capsys.readouterr()
    assert run_app(["diff", a, b, "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["views"][1]["distance"]["largest"] == 5
