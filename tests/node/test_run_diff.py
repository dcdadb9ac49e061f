"""Two runs compared: what counts as the same, how far apart they are, and what is said and shown of it."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from fakes import FakeSource, painting_traits, traits
from rich.console import Console
from runs import FRAMES, WINDOWS, LevelModel, copied, made_run, nan_model

from gcd_model import View
from gcd_node.cli.main import run_app
from gcd_node.errors import DamagedRunError, UsageError
from gcd_node.replay.compare import Missing, RunComparison, Tolerance, ViewComparison, compare, psnr_db
from gcd_node.replay.diff_report import (
    WORST,
    describe,
    divergence,
    gain_for,
    report_text,
    tables,
    to_plain,
    verdict,
    write_report,
)
from gcd_node.replay.run import (
    MANIFEST,
    KeptKind,
    Manifest,
    PixelWriter,
    RunFolder,
    SizeEntry,
    WindowEntry,
    open_run,
    pixel_digest,
    pixels_path,
    write_manifest,
)

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
    manifest: Manifest = msgspec.structs.replace(run.manifest, **changes)
    write_manifest(folder, manifest)
    return open_run(folder)


def resized(run: RunFolder, folder: Path, *, honest: bool, kind: KeptKind = "win") -> RunFolder:
    """A copy whose pictures or class maps are black, with true digests. honest: the manifest states their size."""
    frames, height, width = run.manifest.size.frames, 16, 24
    copied(run, folder)
    pixels = np.zeros((frames, height, width, 3) if kind == "win" else (frames, height, width), np.uint8)
    path = pixels_path(folder, "main", kind)
    path.unlink()
    writer = PixelWriter(path, height=height, width=width, fps=10.0)
    windows: list[WindowEntry] = []
    for window in run.manifest.windows:
        writer.write(pixels)
        view = window.views["main"]
        view = msgspec.structs.replace(view, sha256=view.sha256 | {kind: pixel_digest(pixels)})
        windows.append(msgspec.structs.replace(window, views={"main": view}))
    writer.close()
    said = SizeEntry(frames=frames, height=height, width=width) if honest else run.manifest.size
    write_manifest(folder, msgspec.structs.replace(run.manifest, windows=tuple(windows), size=said))
    return open_run(folder)


def first_view(comparison: RunComparison) -> ViewComparison:
    return comparison.views[0]


# Laws.


def test_a_run_is_identical_to_itself_and_to_its_like(golden: RunFolder, tmp_path: Path) -> None:
    for other in (golden, made_run(tmp_path / "again")):
        comparison = compare(golden, other)
        assert len(comparison.views) == WINDOWS
        assert all(view.identical for view in comparison.views)
        assert (comparison.facts, comparison.missing, comparison.first_divergence) == ((), (), None)
        assert comparison.failures(EXACT) == comparison.worst(WORST) == ()


@pytest.mark.parametrize("levels", [1, 2, 10])
def test_psnr_is_that_of_the_definition(levels: int, golden: RunFolder, tmp_path: Path) -> None:
    other = lowered(tmp_path / "run", {(0, frame): levels for frame in range(FRAMES)})
    distance = first_view(compare(golden, other)).distance
    assert distance is not None
    assert distance.psnr_db == pytest.approx(20 * math.log10(255 / levels))
    assert distance.worst_psnr_db == pytest.approx(distance.psnr_db)
    assert distance.largest == levels


def test_comparison_is_symmetric(golden: RunFolder, tmp_path: Path) -> None:
    other = lowered(tmp_path / "run", {(0, 3): 2, (2, 5): 7})
    there, back = compare(golden, other), compare(other, golden)
    assert there.views == back.views
    assert [(fact.a, fact.b) for fact in there.facts] == [(fact.b, fact.a) for fact in back.facts]


def test_psnr_of_equal_pictures_is_infinite_and_of_black_and_white_is_nothing() -> None:
    assert psnr_db(0.0, 100) == math.inf
    assert psnr_db(100 * 255.0**2, 100) == 0.0


# What counts.


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
    assert [each.window_id for each in comparison.failures(EXACT)] == [1]
    assert comparison.first_divergence == view


def test_class_pixels_have_a_bound_of_their_own(tmp_path: Path) -> None:
    a, b = classed(tmp_path / "a", {}), classed(tmp_path / "b", {1: 24})
    view = compare(a, b).views[1]
    assert view.distance is not None
    share = 24 / 96 / FRAMES  # a quarter of the columns, in one frame
    assert view.distance.shares == {"cls": pytest.approx(share)}
    assert view.distance.worst_class_frame == 0
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
    assert compare(usual, made_run(tmp_path / "again", MovedMaps(1.0, 0))).first_divergence is None
    near = compare(usual, made_run(tmp_path / "near", MovedMaps(1.005, 0))).views[0]
    assert not near.identical
    assert near.within(Tolerance(max_class_share=0.001))
    far = compare(usual, made_run(tmp_path / "far", MovedMaps(1.05, 24))).views[0]
    assert far.distance is not None
    shares = far.distance.shares
    assert shares["depth"] == pytest.approx(6 / 7, abs=0.01)  # the others have none
    assert shares["vis"] == pytest.approx(24 / 96 * 2 / 3, abs=0.01)
    assert not far.within(Tolerance(max_class_share=0.8))
    assert "of the depth" in describe(far)
    plain = compare(usual, made_run(tmp_path / "plain")).views[0]
    assert plain.facts == ("visibility", "depth")


def test_windows_that_only_one_run_has_always_fail(golden: RunFolder, tmp_path: Path) -> None:
    longer = made_run(tmp_path / "run", source=FakeSource(4 * FRAMES))
    comparison = compare(golden, longer)
    assert comparison.missing == (Missing(window_id=3, view_id="main", only_in="B"),)
    assert comparison.failures(Tolerance(min_psnr_db=1.0)) == comparison.missing
    assert comparison.first_divergence == comparison.missing[0]
    assert compare(longer, golden).missing[0].only_in == "A"


def test_a_window_that_is_missing_does_not_shift_what_follows(golden: RunFolder, tmp_path: Path) -> None:
    comparison = compare(golden, made_run(tmp_path / "run", nan_model({1})))
    assert comparison.missing == (Missing(window_id=1, view_id="main", only_in="A"),)
    assert [(view.window_id, view.identical) for view in comparison.views] == [(0, True), (2, True)]
    assert {fact.name for fact in comparison.facts} == {
        "total windows",
        "total nan_windows",
        "trouble MODEL_NAN in window 1",
    }


def test_a_damaged_run_is_never_compared(golden: RunFolder, tmp_path: Path) -> None:
    windows = golden.manifest.windows
    with pytest.raises(DamagedRunError, match="SHA-256"):  # the pixels of window 1 are where those of 2 should be
        compare(golden, restated(golden, tmp_path / "run", windows=(windows[0], windows[2])))


def test_a_view_that_one_run_lacks_is_missing_in_every_window(golden: RunFolder, tmp_path: Path) -> None:
    two = made_run(tmp_path / "run", changes=["view.second.azimuth_deg=5.0"])
    comparison = compare(golden, two)
    assert [(each.window_id, each.view_id) for each in comparison.missing] == [(i, "second") for i in range(WINDOWS)]
    assert {fact.name for fact in comparison.facts} >= {"config view.second.azimuth_deg"}


@pytest.mark.parametrize(
    ("field", "value"),
    [("stamps", tuple((9, i) for i in range(FRAMES))), ("seqs", tuple(range(1, FRAMES + 1))), ("epoch", 4)],
)
def test_other_moments_fail_even_if_the_pixels_agree(
    field: str, value: object, golden: RunFolder, tmp_path: Path
) -> None:
    first, *others = golden.manifest.windows
    changed = msgspec.structs.replace(first, **{field: value})
    comparison = compare(golden, restated(golden, tmp_path / "run", windows=(changed, *others)))
    assert first_view(comparison).facts == (field,)
    assert not first_view(comparison).within(Tolerance(min_psnr_db=1.0))
    assert comparison.worst(WORST) == ()


def test_another_flag_on_a_view_fails(golden: RunFolder, tmp_path: Path) -> None:
    first, *others = golden.manifest.windows
    view = msgspec.structs.replace(first.views["main"], ood=("fps",))
    changed = msgspec.structs.replace(first, views={"main": view})
    comparison = compare(golden, restated(golden, tmp_path / "run", windows=(changed, *others)))
    assert first_view(comparison).facts == ("ood",)


def test_pictures_of_another_size_cannot_be_near(golden: RunFolder, tmp_path: Path) -> None:
    comparison = compare(golden, resized(golden, tmp_path / "run", honest=True))
    assert first_view(comparison).facts == ("size",)
    assert len(comparison.failures(Tolerance(min_psnr_db=1.0))) == WINDOWS


@pytest.mark.parametrize("kind", ["win", "cls"])
def test_a_manifest_that_lies_about_the_size_is_damage(kind: KeptKind, tmp_path: Path) -> None:
    golden = classed(tmp_path / "golden", {})
    with pytest.raises(DamagedRunError, match=r"manifest\.json says"):
        compare(golden, resized(golden, tmp_path / "run", honest=False, kind=kind))


@pytest.mark.parametrize("bounds", [{"min_psnr_db": 0.0}, {"min_psnr_db": math.nan}, {"max_class_share": 1.5}])
def test_bounds_that_make_no_sense_are_refused(bounds: dict[str, float]) -> None:
    with pytest.raises(UsageError):
        Tolerance(**bounds)


# What is said.


def test_what_the_runs_were_made_from_is_named_first(golden: RunFolder, tmp_path: Path) -> None:
    other = made_run(tmp_path / "run", changes=["model.steps=3", "source.resize=area"])
    made_from = other.manifest.made_from | {"weights sha256_12": "f" * 12, "version torch": "0.1"}
    other = restated(other, tmp_path / "restated", made_from=made_from)
    comparison = compare(golden, other)
    assert [(fact.name, fact.a, fact.b) for fact in comparison.facts] == [
        ("config source.resize", "released", "area"),
        ("config model.steps", "1", "3"),
        ("weights sha256_12", "0" * 12, "f" * 12),
        ("version torch", golden.manifest.made_from["version torch"], "0.1"),
    ]
    text = report_text(comparison, EXACT)
    assert text.index("model.steps: 1, 3") < text.index("first divergence: window 0, view main")


def test_what_a_strange_manifest_says_cannot_command_a_terminal(golden: RunFolder, tmp_path: Path) -> None:
    made_from = golden.manifest.made_from | {"weights name": "\x1b]0;mine\x07"}
    comparison = compare(golden, restated(golden, tmp_path / "run", made_from=made_from))
    assert [(fact.name, fact.b) for fact in comparison.facts] == [("weights name", "\\x1b]0;mine\\x07")]


def test_settings_a_replay_does_not_use_are_no_difference(golden: RunFolder, tmp_path: Path) -> None:
    other = made_run(tmp_path / "run", changes=["publish.jpeg_quality=70", "life.nice=3", "source.pace=realtime"])
    assert compare(golden, other).facts == ()


def test_the_first_divergence_says_whether_the_input_was_the_same(golden: RunFolder, tmp_path: Path) -> None:
    same_input = compare(golden, lowered(tmp_path / "a", {(2, 0): 1}))
    assert "window 2" in (divergence(same_input) or "")
    assert "given the same pictures" in (divergence(same_input) or "")
    shifted = FakeSource(42)
    shifted.frames = lambda: (  # type: ignore[method-assign]
        type(frame)(image=frame.image + 1, stamp_ns=frame.stamp_ns, seq=frame.seq) for frame in FakeSource(42).frames()
    )
    other_input = compare(golden, made_run(tmp_path / "b", source=shifted))
    assert "other pictures already" in (divergence(other_input) or "")


def test_the_first_divergence_says_when_settings_brought_another_seed(golden: RunFolder, tmp_path: Path) -> None:
    other = made_run(tmp_path / "run", LevelModel(traits(), {(0, 0): 1}), changes=["model.cond_aug=0.01"])
    comparison = compare(golden, other)
    assert not first_view(comparison).same_seed
    assert "same pictures and another seed" in str(divergence(comparison))
    assert "another seed" not in str(divergence(compare(golden, lowered(tmp_path / "lowered", {(0, 0): 1}))))
    assert to_plain(comparison, EXACT)["views"][0]["same_seed"] is False


def test_the_verdict_has_three_words(golden: RunFolder, tmp_path: Path) -> None:
    comparison = compare(golden, lowered(tmp_path / "run", {(1, 0): 1}))
    assert verdict(compare(golden, golden), EXACT) == "identical: all 3 views"
    assert verdict(comparison, Tolerance(min_psnr_db=40.0)).startswith("near enough: 2 of 3")
    assert verdict(comparison, Tolerance(min_psnr_db=60.0)).startswith("DIFFERENT: 1 of 3")


def test_tables_show_every_view(golden: RunFolder, tmp_path: Path) -> None:
    other = made_run(tmp_path / "run", source=FakeSource(56), changes=["model.steps=2"])
    comparison, console = compare(golden, other), Console(record=True, width=120)
    console.print(*tables(comparison, EXACT))
    shown = console.export_text()
    assert "config model.steps" in shown
    assert shown.count("up to 1 levels") == WINDOWS
    assert "only in B" in shown


def test_json_says_the_same_and_knows_no_infinity(golden: RunFolder, tmp_path: Path) -> None:
    comparison = compare(golden, lowered(tmp_path / "run", {(1, 4): 5}))
    plain = json.loads(msgspec.json.encode(to_plain(comparison, EXACT)))
    assert (plain["passed"], plain["identical"]) == (False, False)
    assert plain["first_divergence"] == {"window_id": 1, "view_id": "main"}
    distances = [view["distance"] for view in plain["views"]]
    assert [distance["psnr_db"] is None for distance in distances] == [True, False, True]
    assert distances[1]["worst_frame"] == 4


# What is shown.


def test_pictures_show_the_worst_views_and_where_they_differ(golden: RunFolder, tmp_path: Path) -> None:
    other = lowered(tmp_path / "run", {(0, 2): 1, (2, 6): 9})
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "window-000099-view-old.png").touch()
    (tmp_path / "out" / "mine.txt").touch()
    paths = write_report(tmp_path / "out", compare(golden, other), EXACT, (golden, other))
    assert [path.name for path in paths] == ["window-000002-view-main.png", "window-000000-view-main.png"]
    assert sorted(path.name for path in (tmp_path / "out").glob("*.*")) == [
        "diff.json",
        "mine.txt",
        "window-000000-view-main.png",
        "window-000002-view-main.png",
    ]
    picture = cv2.imread(str(paths[0]))
    assert picture is not None
    right = picture[:, -100:]  # of the last column, the difference: black but for the middle row of three
    rows = [right[int(part * right.shape[0])].mean() for part in (0.2, 0.5, 0.8)]
    assert rows == [0.0, 9.0 * gain_for(9), 0.0]


def test_class_maps_are_shown_where_they_differ(tmp_path: Path) -> None:
    a, b = classed(tmp_path / "a", {}), classed(tmp_path / "b", {0: 48})
    (path,) = write_report(tmp_path / "out", compare(a, b), EXACT, (a, b))
    picture = cv2.imread(str(path))
    assert picture is not None
    assert np.all(picture[-150, -340] == 255)  # the last row of pictures, above the legend: where classes differ
    assert np.all(picture[-150, -20] == 0)


@pytest.mark.parametrize(
    ("largest", "gain"), [(0, 64), (1, 64), (3, 64), (4, 32), (10, 16), (127, 2), (128, 1), (255, 1)]
)
def test_a_difference_is_made_as_bright_as_it_can_be(largest: int, gain: int) -> None:
    assert gain_for(largest) == gain


# The command.


def test_exit_codes_tell_same_different_damaged_and_missing(
    golden: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = lowered(tmp_path / "run", {(1, 4): 5})
    damaged = copied(golden, tmp_path / "damaged")
    (damaged / MANIFEST).write_text("{")
    a, b = str(golden.path), str(other.path)
    assert run_app(["diff", a, a]) == 0
    assert run_app(["diff", a, b]) == 1
    assert run_app(["diff", a, b, "--min-psnr", "30", "--out", str(tmp_path / "out")]) == 0
    assert run_app(["diff", a, b, "--min-psnr", "40"]) == 1
    assert run_app(["diff", a, b, "--min-psnr", "-1"]) == 64
    assert run_app(["diff", a, str(damaged)]) == 65
    assert run_app(["diff", str(tmp_path / "nowhere"), b]) == 66
    capsys.readouterr()
    assert run_app(["diff", a, b, "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["views"][1]["distance"]["largest"] == 5
    assert (tmp_path / "out" / "window-000001-view-main.png").stat().st_size > 1000
