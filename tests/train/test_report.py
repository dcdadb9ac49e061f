"""Reports: from made-up records to tables, stars, intervals, curves, galleries; and from the command line."""

import csv
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from driving_plane import PlaneClips
from made_records import FRAMES, note, record, region
from tiny_world import write_untrained
from typer.testing import CliRunner

from gcd_model.geometry import SphericalDelta
from gcd_train.cli.main import app
from gcd_train.errors import RunError
from gcd_train.evaluation.figures import all_plots, make_figure
from gcd_train.evaluation.paper import PAPER_TABLES, row_label
from gcd_train.evaluation.report import make_report
from gcd_train.evaluation.runs import EvaluatedSet, gather, on_the_same_goals, targets_apart
from gcd_train.evaluation.store import ClipRecord, Run, RunKeeper, RunNote
from gcd_train.evaluation.tables import (
    differences,
    main_tables,
    region_table,
    to_csv,
    to_markdown,
)

WEIGHTS = {"weights": "0123456789ab", "steps": "4"}
COPIED = {"baseline": "copy_source"}
SCENES = 6


def records(method: str, shift: float = 0.0) -> list[ClipRecord]:
    """Two clips of each of six scenes, each scene of another PSNR, turning further from scene to scene."""
    made: list[ClipRecord] = []
    for number in range(2 * SCENES):
        scene, sample = divmod(number, 2)
        regions = {
            "all": region((18.0 + scene + 0.25 * sample + shift,) * FRAMES),
            "occluded": region((None, *(15.0 + scene + shift,) * (FRAMES - 1))),
        }
        change = (15.0 * scene * (-1) ** sample, 5.0, 0.0)
        made.append(record(method, f"scn{scene:05d}.sample_{sample:02d}", regions=regions, change=change))
    return made


def two(method: str, *, draws: int = 1, classes: bool = False) -> list[ClipRecord]:
    """Two clips, visible pixels at 30 dB, occluded ones at 10."""
    counts = [(0, 0, 9), (1, 0, 1)] if classes else None
    regions = {
        name: region((value,) * FRAMES, draws=draws, counts=counts)
        for name, value in {"all": 20.0, "visible": 30.0, "occluded": 10.0}.items()
    }
    return [record(method, f"scn{n:05d}.sample_00", regions=regions, draws=draws) for n in range(2)]


def run(note_: RunNote, *methods: Sequence[ClipRecord], folder: str = "run") -> Run:
    return Run(folder=Path(folder), note=note_, records=tuple(each for method in methods for each in method))


def measured(*methods: Sequence[ClipRecord], **more: object) -> EvaluatedSet:
    names = {each[0].method: COPIED if each[0].method == "copy_source" else WEIGHTS for each in methods}
    (found,) = gather([run(note(methods=names, **more), *methods)])
    return found


def kept(folder: Path, *methods: Sequence[ClipRecord], **more: object) -> Path:
    """A run on the disk."""
    keeper = RunKeeper(folder)
    names = {each[0].method: COPIED if each[0].method == "copy_source" else WEIGHTS for each in methods}
    keeper.begin(note(methods=names, **more))
    for each in (each for method in methods for each in method):
        keeper.keep(each)
    return folder


def lines(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(text.splitlines()))


# --- tables -------------------------------------------------------------------------------------------------------


def test_a_table_of_the_paper_has_its_rows_and_nobody_is_given_a_printed_figure() -> None:
    ablation, main = main_tables(measured(records("gradual-max90"), kind="kubric", protocol="paper"))
    text = to_markdown(main)
    (ours,) = [line for line in text.splitlines() if "gradual-max90" in line]
    assert "20.6" in ours  # measured
    assert "20.3, 0.587, 0.408, 18.6, 0.527" in ours  # printed, in a column of its own
    for name in ("HexPlane", "4D-GS", "DynIBaR", "Vanilla SVD", "ZeroNVS", "Reproject RGB-D"):
        (line,) = [line for line in text.splitlines() if line.startswith(f"| {name} |")]
        assert line.count("not run") == 5
    assert len(ablation.rows) == 8 + 3
    direct = next(row for row in lines(to_csv(ablation)) if row["row"] == "GCD (direct, max 90, finetuned)")
    assert (direct["method"], direct["PSNR all"], direct["PSNR all paper"]) == ("not run", "", "17.23")


def test_the_papers_means_over_variants_are_rows_where_all_were_measured() -> None:
    better = {"gradual": 0.5, "max90": 0.25, "finetuned": 1.0}
    names = [f"{path}-{most}-{start}" for path in ("direct", "gradual") for most in ("max90", "max180")
             for start in ("scratch", "finetuned")]  # fmt: skip
    every = [records(name, sum(gain for word, gain in better.items() if word in name)) for name in names]
    for measured_, shown in ((every, ["0.50", "0.25", "1.00"]), (every[1:], ["not run"] * 3)):
        ablation, _ = main_tables(measured(*measured_, kind="kubric", protocol="paper"))
        gains = ablation.rows[-3:]
        assert [str(row.cells[0]) for row in gains] == shown
        assert [row.printed[0] for row in gains] == [1.17, 0.55, 1.34]


def test_the_papers_tables_hold_all_it_prints() -> None:
    printed = [[value for row in table.rows.values() for value in row if value is not None] for table in PAPER_TABLES]
    assert [len(values) for values in printed] == [40, 20, 8, 33, 18, 3]
    assert [table.name for table in PAPER_TABLES] == [f"table{number}" for number in range(1, 7)]
    assert [table.frames for table in PAPER_TABLES] == ["last"] * 3 + ["2-last"] * 3
    # sums over each table's rows, from the paper
    assert [sum(values) for values in printed] == pytest.approx([277.162, 191.311, 2.751, 203.069, 138.253, 1.189])


def test_a_released_run_also_has_its_own_figures_over_all_frames(tmp_path: Path) -> None:
    def bright(each: ClipRecord) -> ClipRecord:
        first = {"all": region((99.0, *(each.regions["all"].psnr_db or ((),))[0][1:]))}
        return msgspec.structs.replace(each, regions={**each.regions, **first})

    both = [list(map(bright, records(name))) for name in ("gradual-90", "b")]
    for protocol in ("release", "paper"):
        kept(tmp_path / protocol, *both, kind="kubric", protocol=protocol)
    text = make_report([tmp_path / "release"], tmp_path / "out", drawn=False).read_text()
    assert f"all {FRAMES} frames" in text
    assert text.index("all_frames.csv") < text.index("table4.csv")
    tables = tmp_path / "out" / "tables"
    every, table4 = (
        next(row for row in lines((tables / f"{name}.csv").read_text()) if "gradual" in row["method"])
        for name in ("all_frames", "table4")
    )
    assert float(every["PSNR all"]) == pytest.approx((99.0 + 3 * float(table4["PSNR all"])) / 4, rel=1e-5)
    assert {row["frames"] for row in lines((tables / "differences.csv").read_text())} == {"all", "2-last", "last"}
    make_report([tmp_path / "paper"], tmp_path / "other", drawn=False)
    assert not (tmp_path / "other" / "tables" / "all_frames.csv").exists()


@pytest.mark.parametrize(
    ("method", "details", "table", "label"),
    [
        ("hexplane_4", {}, 3, "HexPlane"),
        ("4D-GS", {}, 3, "4D-GS"),
        ("zeronvs (scale 5)", {}, 3, "ZeroNVS"),
        ("dynibar", {"frames in": "/frames"}, 3, "DynIBaR"),
        ("4dgs_8", {}, 3, "4D-GS"),
        ("vanilla_svd", {}, 3, "Vanilla SVD"),
        ("reproject_rgbd", {}, 4, "Reproject RGB-D"),
        ("reproject_semd", {}, 5, "Reproject Sem-D"),
        ("kubric_direct_max180", WEIGHTS, 0, "GCD (direct, max 180, finetuned)"),
        ("mine", {"weights": "ab", "family": "kubric90"}, 3, "GCD (gradual, max 90, finetuned)"),
        ("mine", {"weights": "sha 1902", "steps": "25"}, 3, None),
        ("kubric-gradual-max90-splat", {**WEIGHTS, "splat": "given depth"}, 3, None),
        ("study-direct-scratch", WEIGHTS, 1, "GCD (direct, scratch)"),
        ("pardom_gradual_semantic", WEIGHTS, 2, "GCD (gradual, finetuned)"),
        ("copy_source", {}, 4, None),
    ],
)
def test_a_method_finds_its_row(method: str, details: Mapping[str, str], table: int, label: str | None) -> None:
    found = row_label(method, details, PAPER_TABLES[table])
    assert found == label
    assert found is None or found in PAPER_TABLES[table].rows


@pytest.mark.parametrize("kind", ["kubric", "driving"])
def test_methods_outside_the_papers_rows_stand_below_in_the_last_frame_too(kind: str) -> None:
    last, main = main_tables(measured(two("copy_source"), two("hexplane_1"), kind=kind, protocol="paper"))
    assert (main.below[0].label, main.below[0].method) == ("not in the paper", "copy_source")
    assert [(row.label, row.method) for row in last.below] == [
        ("not in the paper", "copy_source"),
        ("HexPlane, not in this table", "hexplane_1"),
    ]


def test_a_mean_iou_from_exact_classes_is_noted() -> None:
    both = two("copy_source", classes=True), two("majority_map", classes=True)
    of = measured(*both, kind="driving", classes=["a", "b"])
    assert any(line.startswith("mIoU of copy_source: ") for line in main_tables(of)[0].notes)
    assert not any("mIoU of" in line for line in main_tables(measured(two("copy_source")))[0].notes)


def test_visible_pixels_diversity_and_sharpness_stand_in_a_table() -> None:
    table = region_table(measured(two("a", draws=2), two("b")))
    assert table.headings == (
        *("PSNR all", "PSNR visible", "PSNR occluded", "SSIM all", "SSIM visible", "SSIM occluded"),
        *("diversity", "gradient energy", "flicker"),
    )
    values = [str(cell).split(" ")[0] for cell in table.rows[0].cells]
    assert values == ["20.00", "30.00", "10.00", "0.500", "0.500", "0.500", "0.0100", "0.50", "0.50"]
    assert str(table.rows[1].cells[6]) == "-"
    assert "nan" not in to_markdown(table)


# --- differences and curves ----------------------------------------------------------------------------------------


def test_a_claim_is_made_only_where_zero_lies_outside() -> None:
    of = measured(records("a", 1.0), records("b"))
    found = {each.column.heading: each.verdict for each in differences(*of.methods)}
    assert (found["PSNR all"], found["PSNR occluded"], found["SSIM all"]) == ("better", "better", "open")
    back = {each.column.heading: each.verdict for each in differences(*reversed(of.methods))}
    assert back["PSNR all"] == "worse"


def test_figures_of_other_pixels_are_marked_and_never_subtracted() -> None:
    part = [msgspec.structs.replace(each, crop=(8, 0, 32, 32)) for each in records("b")]
    of = measured(part, records("a", 1.0))
    assert differences(*of.methods) == ()
    assert {record.crop for record in of.clips.values()} == {None}  # what says which goals are alike is of whole frames
    assert targets_apart(part[0], records("a")[0]) != ""
    (main, _), text = main_tables(of), to_markdown(region_table(of))
    assert [row.method for row in main.rows] == ["b †", "a"]
    assert f"† Measured on the middle 32 x 32 of a frame's {of.note.width} x {of.note.height} pixels" in text


def test_the_row_of_frames_made_elsewhere_names_their_source() -> None:
    of = measured(records("dynibar"), kind="kubric", protocol="paper")
    given = {"frames in": "/frames/dynibar", "digest": "0123456789ab"}
    of = replace(of, methods=(replace(of.methods[0], details=given),))
    table = main_tables(of, ("2-last",))[0]
    assert [row.method for row in table.rows if row.label == "DynIBaR"] == ["dynibar"]
    assert "dynibar: made elsewhere, read from /frames/dynibar (digest 0123456789ab)." in table.notes


def test_error_against_angle_is_of_the_last_frame_and_either_way_round() -> None:
    of = measured(records("a"))
    (points,) = next(plot for plot in all_plots(of) if plot.name == "psnr_by_angle").curves.values()
    assert [point.x for point in points] == [0.0, 15.0, 30.0, 45.0, 60.0, 75.0]
    assert [point.y.value for point in points] == pytest.approx([18.125 + scene for scene in range(SCENES)])
    assert {point.clips for point in points} == {2}
    drawn = [msgspec.structs.replace(each, change=(each.change[0] + 0.3, 5.0, 0.0)) for each in records("a")]
    (points,) = all_plots(measured(drawn))[0].curves.values()
    assert [point.x for point in points] == [7.5 + 15 * number for number in range(6)]


def test_each_curve_over_views_is_of_its_own_method_and_pixels() -> None:
    regions = {"all": region((20.0,) * FRAMES, ssim=0.7), "occluded": region((20.0,) * FRAMES, ssim=0.3)}
    few = [msgspec.structs.replace(each, regions=regions) for each in two("hexplane_1")]
    of = measured(two("hexplane_4"), few, two("a"), two("4dgs_4"))
    plot = next(plot for plot in all_plots(of) if plot.name == "ssim_by_views")
    found = {name: [(str(point.x), round(point.y.value, 6)) for point in each] for name, each in plot.curves.items()}
    assert found == {
        "HexPlane, all": [("1", 0.7), ("4", 0.5)],
        "4D-GS, all": [("4", 0.5)],
        "4D-GS, occluded": [("4", 0.5)],
        "a, all": [("nan", 0.5)],
        "HexPlane, occluded": [("1", 0.3), ("4", 0.5)],
    }


# --- runs ---------------------------------------------------------------------------------------------------------


def test_runs_on_the_same_clips_make_one_set_and_others_their_own() -> None:
    one = run(note(methods={"a": WEIGHTS}), records("a"), folder="one")
    two = run(note(methods={"b": WEIGHTS, "a": WEIGHTS}), records("b"), records("a"), folder="two")
    other = run(note(methods={"a": WEIGHTS}, data_identity="else"), records("a"), folder="three")
    sets = gather([one, other, two])
    assert [[method.name for method in each.methods] for each in sets] == [["a", "b"], ["a"]]
    assert sets[0].method("a").folder == Path("one")
    part = run(note(methods={"a": WEIGHTS}), records("a")[:3], folder="part")
    assert gather([part, one])[0].method("a").folder == Path("one")  # where more clips were measured


def test_clips_without_a_record_count_and_frames_that_equal_the_target_are_told() -> None:
    table = main_tables(measured(records("a")[:3], two("b"), clips=5))[0]
    assert [row.clips for row in table.rows] == ["3 of 5", "2 of 5"]
    assert "equal the target" not in "".join(table.notes)
    table = main_tables(measured(records("a"), [record("b", "scn00001.sample_00", psnr_db=100.0)]))[0]
    assert "Frames that equal the target count as 100 dB: some of b do." in table.notes
    table = main_tables(measured([two("a")[0], two("a", draws=2)[1]]))[0]
    assert "a has 1 to 2 draws of a clip." in table.notes


def test_a_method_measured_with_lpips_in_one_run_and_frames_that_were_moved_stay_one_method() -> None:
    def both(first: dict[str, str], second: dict[str, str]) -> list[str]:
        runs = [run(note(methods={"a": told}), records("a"), folder=str(told)) for told in (first, second)]
        return [method.name for method in gather(runs)[0].methods]

    assert both({"baseline": "a"}, {"baseline": "a", "lpips": "vgg"}) == ["a"]
    assert both({"frames in": "/one", "digest": "d"}, {"frames in": "/two", "digest": "d"}) == ["a"]
    with pytest.raises(RunError, match="measure it alike in both"):
        both({"lpips": "vgg"}, {"lpips": "alex"})


# --- sets that end at the same goals --------------------------------------------------------------------------------

Change = tuple[float, float, float]
AHEAD: Change = (30.0, 5.0, 0.0)
ASIDE: Change = (-60.0, 20.0, 1.0)


def clips(method: str, *changes: Change | None, target: Sequence[float] = (2.0,) * FRAMES) -> list[ClipRecord]:
    """A clip of each of as many scenes as there are changes, whose targets are so sharp in each frame."""
    sharp = msgspec.structs.replace(region((20.0,) * FRAMES), gradient_target=tuple(target))
    return [
        record(method, f"scn{number:05d}.sample_00", change=change, regions={"all": sharp})
        for number, change in enumerate(changes)
    ]


def joined(*runs: list[ClipRecord]) -> tuple[dict[str, tuple[str, ...]], str]:
    """Of runs k0, k1 of one method each, on clips of their own: the clips of each that are compared, and the note."""
    named = {f"k{number}": of for number, of in enumerate(runs)}
    told = {
        name: note(kind="kubric", protocol="paper", data_identity=name, methods={of[0].method: {}})
        for name, of in named.items()
    }
    sets, (reason,) = on_the_same_goals(gather([run(told[name], of, folder=name) for name, of in named.items()]))
    return {method.name: tuple(method.places) for each in sets for method in each.methods}, reason


def test_only_clips_of_the_same_name_that_end_at_the_same_goal_are_joined_and_it_is_said_why() -> None:
    found, told = joined(clips("a", AHEAD, ASIDE), clips("b", ASIDE, AHEAD))
    assert found == {}
    assert told.startswith("k0 and k1: of 2 clips of the same names 2 do not end at the same goal")
    assert "azimuth +30.0, elevation +5.0, radius +0.0 and by azimuth -60.0" in told
    found, told = joined(clips("a", AHEAD, ASIDE), clips("b", (30.001, 5.0, 0.0), AHEAD))
    assert found == {"a": ("scn00000.sample_00", "scn00001.sample_00"), "b": ("scn00000.sample_00",)}
    assert "of 2 clips of the same names 1 do not" in told


@pytest.mark.parametrize("change", [None, AHEAD])
def test_the_same_path_at_another_moment_is_another_goal(change: Change | None) -> None:
    found, told = joined(clips("a", change, change), clips("b", change, change, target=(2.0, 2.0, 2.0, 2.01)))
    assert (found, "the target's pictures differ" in told) == ({}, True)


def test_last_frames_of_two_ways_to_the_same_goals_are_compared(tmp_path: Path) -> None:
    folders = [
        kept(tmp_path / name, records(name, 1.0 - n), records("copy_source", -n), data_identity=name)
        for n, name in enumerate(("gradual", "direct"))
    ]
    text = make_report(folders, tmp_path / "out", drawn=False).read_text()
    together = text.split("## The last frame together")[1]
    assert "### gradual against the others, last frame" in together
    assert "| direct | **+1.00 [+1.00, +1.00]** better" in together
    assert "| copy_source | **+1.00 [+1.00, +1.00]** better" in together  # of the first set
    assert "frames 2-4" not in together
    assert (tmp_path / "out" / "last-frame-1" / "tables" / "last_frame.csv").is_file()


# --- the whole report ---------------------------------------------------------------------------------------------


def shown(folder: Path, *, clips: int = 1) -> Path:
    """A run of two methods on the disk, with frames of the first clips of each scene."""
    both = "gradual (1 step)", "copy_source"
    kept(folder, *(records(method, -number) for number, method in enumerate(both)))
    for method, scene, clip in product(both, range(SCENES), range(clips)):
        at = RunKeeper(folder).views(method, f"scn{scene:05d}.sample_{clip:02d}")
        for name, shade in (("source", 10), ("target", 200), ("sample_0", 60 + 60 * both.index(method))):
            (at / name).mkdir(parents=True)
            for number in range(FRAMES):
                picture = np.full((32, 47, 3), shade + number, np.uint8)
                assert cv2.imwrite(str(at / name / f"{number:04d}.png"), picture)
    return folder


def test_a_report_is_written_from_records_and_kept_frames(tmp_path: Path) -> None:
    out = tmp_path / "out"
    given = ("report", shown(tmp_path / "run"), "--out", out, "--clips", 2)
    done = CliRunner().invoke(app, [str(each) for each in given])
    assert done.exit_code == 0, done.output
    text = (out / "report.md").read_text()
    for words in ("gcd-train evaluate --data held-out --out run", "digest 0123456789ab", "Of 6 scenes alone"):
        assert words in text
    assert "weights 0123456789ab, steps 4" in text
    assert "**+1.00 [+1.00, +1.00]** better" in text
    assert "nan" not in text
    links = [part.split(")")[0] for part in text.split("](")[1:]]
    assert [link for link in links if not (out / link).is_file()] == []
    assert {"tables/main.csv", "tables/figures.csv", "plots/psnr_by_angle.png", "gallery/sheet.png"} <= set(links)
    figures = {
        (each["method"], each["frames"], each["pixels"], each["figure"]): float(each["value"])
        for each in lines((out / "tables" / "figures.csv").read_text())
    }
    assert figures["copy_source", "last", "occluded", "psnr_db"] == pytest.approx(14.0 + 2.5)
    sheet = cv2.imread(str(out / "gallery" / "sheet.png"))
    height = 3 * 14 + 4  # of a row: its label's three lines, as these pictures are lower, and a gap
    assert sheet.shape == (2 * 4 * height, 140 + FRAMES * (47 + 4), 3)
    assert [int(sheet[row * height, 141, 0]) for row in range(4)] == [10, 60, 120, 200]
    video = cv2.VideoCapture(str(next((out / "gallery").glob("*.mp4"))))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == FRAMES + 7  # the last is held
    assert video.get(cv2.CAP_PROP_FRAME_WIDTH) == 4 * (47 + 4)


@pytest.mark.parametrize(("kind", "columns"), [("failures", 3), ("ablation", 3), ("angles", 0)])
def test_a_figure_is_one_picture_of_what_was_measured(tmp_path: Path, kind: str, columns: int) -> None:
    out = tmp_path / "figure.png"
    given = ["figure", kind, str(shown(tmp_path / "run", clips=2)), "--out", str(out), "--clips", "2"]
    done = CliRunner().invoke(app, given)
    assert done.exit_code == 0, done.output
    picture = cv2.imread(str(out))
    if columns:
        assert picture.shape[1] == columns * (47 + 4) + 1  # source, the model, target
        assert int(picture[-20, 60, 0]) == 60 + FRAMES - 1  # the model's last frame
    else:
        assert min(picture.shape[:2]) > 300


def test_curves_are_of_the_clips_that_all_methods_were_measured_on_and_of_whole_frames() -> None:
    few, box = records("few")[:6], (0, 0, 8, 8)
    cut = [msgspec.structs.replace(each, crop=box) for each in records("zeronvs (scale 2)")]
    plot = next(plot for plot in all_plots(measured(records("a"), few, cut)) if plot.name == "psnr_by_angle")
    assert set(plot.curves) == {"a", "few"}
    assert [[point.clips for point in curve] for curve in plot.curves.values()] == [[2, 2, 2]] * 2
    assert f"6 of {2 * SCENES} clips" in plot.title


def test_the_worst_clip_is_asked_for_even_where_its_frames_were_not_kept(tmp_path: Path) -> None:
    run = shown(tmp_path / "run")
    shutil.rmtree(RunKeeper(run).views("gradual (1 step)", "scn00000.sample_00"))
    with pytest.raises(RunError, match=r"scn00000\.sample_00; evaluate with --views last"):
        make_figure("failures", [run], tmp_path / "figure.png", clips=1)


def test_a_figure_is_of_one_set_of_clips(tmp_path: Path) -> None:
    runs = [
        shown(tmp_path / "one"),
        kept(tmp_path / "other", records("gradual (1 step)"), data_identity="ab", seed=4, kind="driving"),
    ]
    with pytest.raises(RunError, match="2 sets"):
        make_figure("failures", runs, tmp_path / "figure.png")


def test_the_clips_that_a_model_misses_most_come_first(tmp_path: Path) -> None:
    run, drawn = shown(tmp_path / "run", clips=2), [0, 0]
    for place, clips in enumerate((1, SCENES)):
        make_figure("failures", [run], tmp_path / "figure.png", clips=clips)
        drawn[place] = len(cv2.imread(str(tmp_path / "figure.png")))
    assert drawn[1] == SCENES * drawn[0]
    at = RunKeeper(run).views("gradual (1 step)", "scn00000.sample_00")  # the worst of all, by the records
    for path in (at / "sample_0").iterdir():
        assert cv2.imwrite(str(path), np.full((32, 47, 3), 99, np.uint8))
    make_figure("failures", [run], tmp_path / "figure.png", clips=1)
    assert int(cv2.imread(str(tmp_path / "figure.png"))[-20, 60, 0]) == 99


@pytest.mark.parametrize(
    ("kind", "methods"), [("views", ()), ("failures", ("nobody",)), ("failures", ("gradual (1 step)", "copy_source"))]
)
def test_a_figure_of_what_the_runs_do_not_hold_is_refused(tmp_path: Path, kind: str, methods: Sequence[str]) -> None:
    with pytest.raises(RunError):
        make_figure(kind, [shown(tmp_path / "run")], tmp_path / "figure.png", methods=methods)


def test_a_lead_that_no_run_has_is_said_in_one_line(tmp_path: Path) -> None:
    given = ("report", str(kept(tmp_path / "run", two("copy_source"))), "--out", str(tmp_path / "out"), "--no-plots")
    done = CliRunner().invoke(app, [*given, "--lead", "nobody"])
    assert (done.exit_code, "Traceback" in done.output) == (73, False)


def test_an_empty_run_is_refused(tmp_path: Path) -> None:
    RunKeeper(tmp_path).begin(note(methods={"a": {}}))
    with pytest.raises(RunError):
        Run.read(tmp_path)


# --- from clips to the report ---------------------------------------------------------------------------------------


def evaluated(out: Path, *arguments: object) -> tuple[dict[str, float], str]:
    """PSNR of each method, frames 2 to the last; and what the command said."""
    done = CliRunner().invoke(app, ["evaluate", "--out", str(out), *(str(each) for each in arguments)])
    assert done.exit_code == 0, done.output
    rows = [row for row in lines((out / "tables" / "figures.csv").read_text()) if row["figure"] == "psnr_db"]
    chosen = [row for row in rows if (row["frames"], row["pixels"]) == ("2-last", "all")]
    return {row["method"]: float(row["value"]) for row in chosen}, done.output


def test_weights_are_evaluated_from_the_command_line(tmp_path: Path) -> None:
    held_out = PlaneClips.make(1, width=64).write(tmp_path / "a")
    given = ("--weights", write_untrained(tmp_path), "--no-baselines", "--views", "none")
    found, output = evaluated(tmp_path / "out", "--data", held_out, *given, "--steps", 1, "--steps", 2)  # 1 as shipped
    assert list(found) == ["untrained", "untrained (2 steps)"]
    assert 0 < found["untrained"] < 30
    assert "### untrained against the others" in output


def test_an_orbit_is_evaluated_from_the_command_line(tmp_path: Path) -> None:
    changes = [SphericalDelta(azimuth_deg=azimuth) for azimuth in (40.0, -30.0, 10.0)]
    found, _ = evaluated(tmp_path / "out", "--data", PlaneClips.orbits(changes).write(tmp_path / "a", 3000))
    assert "reproject_semd" not in found
    assert found["ground_homography"] < found["copy_source"]  # black where it sees nothing
    rows = lines((tmp_path / "out" / "tables" / "clips.csv").read_text())
    turned = [float(row["azimuth"]) for row in rows if row["method"] == "copy_source"]
    assert turned == pytest.approx([40.0, -30.0, 10.0])
    assert (tmp_path / "out" / "gallery" / "sheet.png").is_file()
