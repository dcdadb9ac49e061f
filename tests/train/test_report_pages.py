"""Reports from runs that are made up: tables, intervals, curves, galleries, failure cases."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from made_records import FRAMES, note, record, region
from typer.testing import CliRunner

from gcd_train.cli.generate import app
from gcd_train.errors import RunError
from gcd_train.evaluation.paper import PAPER_TABLES, row_label
from gcd_train.evaluation.plots import all_plots
from gcd_train.evaluation.report import make_report
from gcd_train.evaluation.runs import EvaluatedSet, Run, gather
from gcd_train.evaluation.store import ClipRecord, RunKeeper, RunNote
from gcd_train.evaluation.tables import differences, main_tables, to_csv, to_markdown

WEIGHTS = {"weights": "0123456789ab", "steps": "4"}
SCENES = 6


def records(method: str, shift: float = 0.0, *, occluded: float | None = 15.0, **more: object) -> list[ClipRecord]:
    """Two clips of each of six scenes, each scene of another PSNR, turning further from scene to scene."""
    made: list[ClipRecord] = []
    for number in range(2 * SCENES):
        scene, sample = divmod(number, 2)
        value = 18.0 + scene + 0.25 * sample + shift
        regions = {"all": region((value,) * FRAMES)}
        if occluded is not None:
            regions["occluded"] = region((None, *(occluded + scene + shift,) * (FRAMES - 1)))
        angle = 15.0 * scene * (-1) ** sample
        made.append(
            record(method, f"scn{scene:05d}.sample_{sample:02d}", regions=regions, change=(angle, 5.0, 0.0), **more)  # pyright: ignore[reportArgumentType]
        )
    return made


def run(note_: RunNote, *methods: Sequence[ClipRecord], folder: str = "run") -> Run:
    return Run(folder=Path(folder), note=note_, records=tuple(each for method in methods for each in method))


def measured(*methods: Sequence[ClipRecord], **told: object) -> EvaluatedSet:
    names = {each[0].method: {} if each[0].method in ("copy_source", "oracle") else WEIGHTS for each in methods}
    (found,) = gather([run(note(methods=names, **told), *methods)])  # pyright: ignore[reportArgumentType]
    return found


# --- tables -------------------------------------------------------------------------------------------------------


def lines(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(text.splitlines()))


def test_a_table_of_the_paper_has_its_rows_and_nobody_is_given_a_printed_figure() -> None:
    of = measured(records("gradual-max90"), kind="kubric", protocol="paper")
    ablation, main = main_tables(of)
    text = to_markdown(main)
    (ours,) = [line for line in text.splitlines() if "gradual-max90" in line]
    assert "20.6" in ours  # measured
    assert "20.3, 0.587, 0.408, 18.6, 0.527" in ours  # printed, in a column of its own
    for name in ("HexPlane", "4D-GS", "DynIBaR", "Vanilla SVD", "ZeroNVS", "Reproject RGB-D"):
        (line,) = [line for line in text.splitlines() if line.startswith(f"| {name} |")]
        assert line.count("not run") == 5
    assert len(ablation.rows) == 8
    direct = next(row for row in lines(to_csv(ablation)) if row["row"] == "GCD (direct, max 90, finetuned)")
    assert (direct["method"], direct["PSNR all"], direct["PSNR all paper"]) == ("not run", "", "17.23")


def test_a_released_run_also_has_its_own_figures_over_all_frames(tmp_path: Path) -> None:
    for protocol in ("release", "paper"):
        keeper = RunKeeper(tmp_path / protocol)
        keeper.begin(note(methods={"gradual-90": WEIGHTS, "b": {}}, kind="kubric", protocol=protocol))
        for each in (*records("gradual-90"), *records("b")):
            first = {"all": region((99.0, *(each.regions["all"].psnr_db or ((),))[0][1:]))}
            keeper.keep(msgspec.structs.replace(each, regions={**each.regions, **first}))
    text = make_report([tmp_path / "release"], tmp_path / "out", drawn=False).read_text()
    assert f"all {FRAMES} frames" in text
    assert text.index("all_frames.csv") < text.index("table4.csv")
    every, table4 = (
        next(
            row
            for row in lines((tmp_path / "out" / "tables" / f"{name}.csv").read_text())
            if "gradual" in row["method"]
        )
        for name in ("all_frames", "table4")
    )
    assert float(every["PSNR all"]) == pytest.approx((99.0 + 3 * float(table4["PSNR all"])) / 4, rel=1e-5)
    compared = {row["frames"] for row in lines((tmp_path / "out" / "tables" / "differences.csv").read_text())}
    assert compared == {"all", "2-last", "last"}
    make_report([tmp_path / "paper"], tmp_path / "other", drawn=False)
    assert not (tmp_path / "other" / "tables" / "all_frames.csv").exists()


@pytest.mark.parametrize(
    ("method", "details", "table", "label"),
    [
        ("hexplane_4", {}, 3, "HexPlane"),
        ("4D-GS", {}, 3, "4D-GS"),
        ("Zero-NVS", {}, 3, "ZeroNVS"),
        ("vanilla_svd", {}, 3, "Vanilla SVD"),
        ("reproject_rgbd", {}, 4, "Reproject RGB-D"),
        ("reproject_semd", {}, 5, "Reproject Sem-D"),
        ("kubric_direct_max180", WEIGHTS, 0, "GCD (direct, max 180, finetuned)"),
        ("mine", {"weights": "ab", "family": "kubric90"}, 3, "GCD (gradual, max 90, finetuned)"),
        ("mine", {"weights": "sha 1902", "steps": "25"}, 3, None),
        ("study-direct-scratch", WEIGHTS, 1, "GCD (direct, scratch)"),
        ("pardom_gradual_semantic", WEIGHTS, 2, "GCD (gradual, finetuned)"),
        ("copy_source", {}, 4, None),
    ],
)
def test_a_method_finds_its_row(method: str, details: Mapping[str, str], table: int, label: str | None) -> None:
    found = row_label(method, details, PAPER_TABLES[table])
    assert found == label
    assert found is None or found in PAPER_TABLES[table].rows


def test_the_papers_tables_hold_all_it_prints() -> None:
    printed = [[value for row in table.rows.values() for value in row if value is not None] for table in PAPER_TABLES]
    assert [len(values) for values in printed] == [40, 20, 8, 33, 18, 3]
    assert [table.name for table in PAPER_TABLES] == [f"table{number}" for number in range(1, 7)]
    assert [table.frames for table in PAPER_TABLES] == ["last"] * 3 + ["2-last"] * 3
    # sums over each table's rows, from the paper
    assert [sum(values) for values in printed] == pytest.approx([277.162, 191.311, 2.751, 203.069, 138.253, 1.189])


# --- differences --------------------------------------------------------------------------------------------------


def test_a_claim_is_made_only_where_zero_lies_outside() -> None:
    noisy = [
        record("noisy", each.key, regions={"all": region((18.0 + number % 12 * 0.5,) * 4)})
        for number, each in enumerate(records("a"))
    ]
    of = measured(records("a", 1.0), records("b"), noisy)
    found = {(each.other, each.column.heading): each for each in differences(of, of.method("a"))}
    assert found["b", "PSNR all"].verdict == "better"
    assert found["b", "PSNR occluded"].verdict == "better"
    assert found["b", "SSIM all"].verdict == "open"
    back = {(each.other, each.column.heading): each for each in differences(of, of.method("b"))}
    assert back["a", "PSNR all"].verdict == "worse"


# --- runs ---------------------------------------------------------------------------------------------------------


def test_runs_on_the_same_clips_make_one_set_and_others_their_own() -> None:
    one = run(note(methods={"a": WEIGHTS}), records("a"), folder="one")
    two = run(note(methods={"b": WEIGHTS, "a": WEIGHTS}), records("b"), records("a"), folder="two")
    other = run(note(methods={"a": WEIGHTS}, data_identity="else"), records("a"), folder="three")
    sets = gather([one, other, two])
    assert [[method.name for method in each.methods] for each in sets] == [["a", "b"], ["a"]]
    assert sets[0].method("a").folder == Path("one")


def test_a_method_measured_with_lpips_in_one_run_and_frames_that_were_moved_stay_one_method() -> None:
    kinds = (
        ({"baseline": "a"}, {"baseline": "a", "lpips": "vgg"}),
        (
            {"frames in": "/one", "digest": "d"},
            {"frames in": "/two", "digest": "d"},
        ),
    )
    for first, second in kinds:
        one = run(note(methods={"a": first}), records("a"), folder="one")
        two = run(note(methods={"a": second}), records("a"), folder="two")
        assert [method.name for method in gather([one, two])[0].methods] == ["a"]
    vgg, alex = (run(note(methods={"a": {"lpips": name}}), records("a"), folder=name) for name in ("vgg", "alex"))
    with pytest.raises(RunError, match="measure it alike in both"):
        gather([vgg, alex])


def test_the_same_clips_measured_in_another_way_are_refused() -> None:
    one, two = (run(note(protocol=name), records("a"), folder=name) for name in ("paper", "release"))
    with pytest.raises(RunError, match="release has protocol release, paper has paper"):
        gather([one, two])


def test_last_frames_of_two_ways_to_the_same_goals_are_compared(tmp_path: Path) -> None:
    folders = [tmp_path / "gradual", tmp_path / "direct"]
    for number, folder in enumerate(folders):
        keeper, name = RunKeeper(folder), folder.name
        keeper.begin(note(methods={name: WEIGHTS, "copy_source": {}}, data_identity=name))
        for each in (*records(name, 1.0 - number), *records("copy_source", -number)):
            keeper.keep(each)
    text = make_report(folders, tmp_path / "out", drawn=False).read_text()
    together = text.split("## The last frame together")[1]
    assert "### gradual against the others, last frame" in together
    assert "| direct | **+1.00 [+1.00, +1.00]** better" in together
    assert "| copy_source | **+1.00 [+1.00, +1.00]** better" in together  # of the first set
    assert "frames 2-4" not in together
    assert (tmp_path / "out" / "last-frame-1" / "tables" / "last_frame.csv").is_file()


# --- curves and failures ------------------------------------------------------------------------------------------


def test_error_against_angle_is_of_the_last_frame_and_either_way_round() -> None:
    of = measured(records("a"))
    (curve,) = next(plot for plot in all_plots(of) if plot.name == "psnr_by_angle").curves
    assert [point.x for point in curve.points] == [0.0, 15.0, 30.0, 45.0, 60.0, 75.0]
    assert [point.y.value for point in curve.points] == pytest.approx([18.125 + scene for scene in range(SCENES)])
    assert {point.clips for point in curve.points} == {2}


# --- the whole report ---------------------------------------------------------------------------------------------


def picture(folder: Path, shade: int, frames: int = FRAMES) -> None:
    folder.mkdir(parents=True)
    for number in range(frames):
        assert cv2.imwrite(str(folder / f"{number:04d}.png"), np.full((32, 47, 3), shade + number, np.uint8))


def kept(folder: Path, *, views: bool = True) -> Path:
    """A run of two methods on the disk."""
    keeper, both = RunKeeper(folder), ("gradual (1 step)", "copy_source")
    keeper.begin(note(methods={both[0]: WEIGHTS, both[1]: {}}))
    for number, method in enumerate(both):
        for each in records(method, -number):
            keeper.keep(each)
            if views and each.key.endswith("00"):
                at = keeper.views(method, each.key)
                for name, shade in (("source", 10), ("target", 200), ("sample_0", 60 + 60 * number)):
                    picture(at / name, shade)
    return folder


def test_a_report_is_written_from_records_and_kept_frames(tmp_path: Path) -> None:
    out = tmp_path / "out"
    given = ("report", kept(tmp_path / "run"), "--out", out, "--clips", 2)
    done = CliRunner().invoke(app, [str(each) for each in given])
    assert done.exit_code == 0, done.output
    text = (out / "report.md").read_text()
    assert "gcd-train evaluate --data held-out --out run" in text
    assert "digest 0123456789ab" in text
    assert "weights 0123456789ab, steps 4" in text
    assert "**+1.00 [+1.00, +1.00]** better" in text
    assert "Of 6 scenes alone" in text
    assert "nan" not in text
    links = [part.split(")")[0] for part in text.split("](")[1:]]
    assert [link for link in links if not (out / link).is_file()] == []
    assert {"tables/main.csv", "tables/figures.csv", "plots/psnr_by_angle.png", "gallery/sheet.png"} <= set(links)
    figures = lines((out / "tables" / "figures.csv").read_text())
    (last,) = [
        each
        for each in figures
        if (each["method"], each["frames"], each["pixels"], each["figure"])
        == ("copy_source", "last", "occluded", "psnr_db")
    ]
    assert float(last["value"]) == pytest.approx(14.0 + 2.5)


def test_a_gallery_has_source_methods_and_target_and_plays(tmp_path: Path) -> None:
    out = tmp_path / "out"
    make_report([kept(tmp_path / "run")], out, clips=2, drawn=False)
    sheet = cv2.imread(str(out / "gallery" / "sheet.png"))
    assert sheet is not None
    height = 3 * 14 + 4  # of a row: its label's three lines, as these pictures are lower, and a gap
    assert sheet.shape == (2 * 4 * height, 140 + FRAMES * (47 + 4), 3)
    assert [int(sheet[row * height, 141, 0]) for row in range(4)] == [10, 60, 120, 200]
    video = cv2.VideoCapture(str(next((out / "gallery").glob("*.mp4"))))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == FRAMES + 7  # the last is held
    assert video.get(cv2.CAP_PROP_FRAME_WIDTH) == 4 * (47 + 4)


@pytest.mark.parametrize(
    ("arguments", "code", "hint"),
    [
        (("--row", "mine"), 78, "METHOD=ROW"),
        (("--lead", "nobody"), 73, "no method is called 'nobody'"),
        (("--row", "nobody=DynIBaR"), 73, "no method is called 'nobody'"),
        (("--row", "copy_source=DynIBaR"), 78, "none of them is for these clips"),
    ],
)
def test_a_wrong_option_is_said_in_one_line(tmp_path: Path, arguments: tuple[str, ...], code: int, hint: str) -> None:
    given = ("report", str(kept(tmp_path / "run", views=False)), "--out", str(tmp_path / "out"), "--no-plots")
    done = CliRunner().invoke(app, [*given, *arguments])
    assert done.exit_code == code
    assert hint in done.output


def test_an_empty_run_is_refused(tmp_path: Path) -> None:
    RunKeeper(tmp_path).begin(note(methods={"a": {}}))
    with pytest.raises(RunError, match="holds no record yet"):
        Run.read(tmp_path)
