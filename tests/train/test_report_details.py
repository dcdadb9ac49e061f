"""What stands in a report's tables, stars, ticks and captions, and which options it refuses."""

from collections.abc import Sequence
from pathlib import Path

import msgspec
import pytest
from made_records import FRAMES, note, record, region

from gcd_train.evaluation.runs import EvaluatedSet, Run, gather, on_the_same_goals
from gcd_train.evaluation.store import ClipRecord
from gcd_train.evaluation.tables import differences, differences_markdown, main_tables, region_table, to_markdown

COUNTS = [(0, 0, 9), (1, 0, 1)]


def two(method: str, *, draws: int = 1, classes: bool = False, pictures: bool = True) -> list[ClipRecord]:
    """Two clips, visible pixels at 30 dB, occluded ones at 10."""
    shown = {"all": 20.0, "visible": 30.0, "occluded": 10.0} if pictures else dict.fromkeys(["all"])
    counts = COUNTS if classes else None
    regions = {
        name: region(None if value is None else (value,) * FRAMES, draws=draws, counts=counts)
        for name, value in shown.items()
    }
    return [record(method, f"scn{n:05d}.sample_00", regions=regions, draws=draws) for n in range(2)]  # pyright: ignore[reportArgumentType]


def measured(*methods: list[ClipRecord], **told: object) -> EvaluatedSet:
    named = {each[0].method: {"baseline": each[0].method} for each in methods}
    note_ = note(methods=named, **told)  # pyright: ignore[reportArgumentType]
    (found,) = gather([Run(folder=Path("run"), note=note_, records=tuple(r for each in methods for r in each))])
    return found


# --- rows ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["kubric", "driving"])
def test_methods_outside_the_papers_rows_stand_below_in_the_last_frame_too(kind: str) -> None:
    of = measured(two("copy_source"), two("hexplane_1"), kind=kind, protocol="paper")
    last, main = main_tables(of)
    assert (main.below[0].label, main.below[0].method) == ("not in the paper", "copy_source")
    assert [(row.label, row.method) for row in last.below] == [
        ("not in the paper", "copy_source"),
        ("HexPlane, not in this table", "hexplane_1"),
    ]


# --- stars --------------------------------------------------------------------------------------------------------


def test_a_mean_iou_from_exact_classes_is_starred_and_the_star_is_explained() -> None:
    of = measured(
        two("copy_source", classes=True), two("majority_map", classes=True), kind="driving", classes=["a", "b"]
    )
    table = main_tables(of)[0]
    cells = {row.method: [str(cell).endswith(" *") for cell in row.cells] for row in table.rows}
    assert cells["copy_source"] == [heading.startswith("mIoU") for heading in table.headings]
    assert not any(cells["majority_map"])
    assert any("made from the source's exact ones" in line for line in table.notes)
    apart = differences_markdown(differences(of, of.method("majority_map")), of)
    assert [cell.strip().endswith("*") for cell in apart.splitlines()[-1].split("|")[2:-1]] == cells["copy_source"][
        :2
    ] + (cells["copy_source"][3:])
    pictures = measured(two("copy_source"))
    assert not any("exact ones" in line for line in main_tables(pictures)[0].notes)


# --- regions and frames -------------------------------------------------------------------------------------------


def test_visible_pixels_diversity_and_sharpness_stand_in_a_table() -> None:
    table = region_table(measured(two("a", draws=2), two("b")))
    assert table.headings == (
        *("PSNR all", "PSNR visible", "PSNR occluded", "SSIM all", "SSIM visible", "SSIM occluded"),
        *("diversity", "gradient energy"),
    )
    values = [str(cell).split(" ")[0] for cell in table.rows[0].cells]
    assert values == ["20.00", "30.00", "10.00", "0.500", "0.500", "0.500", "0.0100", "0.50"]
    assert str(table.rows[1].cells[6]) == "-"
    assert "nan" not in to_markdown(table)


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


def sets_of(**runs: list[ClipRecord]) -> tuple[EvaluatedSet, ...]:
    """A run of one method by each name, of clips of its own digest."""
    told = {name: note(kind="kubric", protocol="paper", data_identity=name, methods={name: {}}) for name in runs}
    return gather([Run(folder=Path(name), note=told[name], records=tuple(of)) for name, of in runs.items()])


def test_clips_of_the_same_name_that_go_elsewhere_are_not_joined_and_it_is_said_why() -> None:
    found = on_the_same_goals(sets_of(k0=clips("a", AHEAD, ASIDE), k1=clips("b", ASIDE, AHEAD)))
    assert found[0] == ()
    (told,) = found[1]
    assert told.startswith("k0 and k1: of 2 clips of the same names 2 do not end at the same goal")
    assert "azimuth +30.0, elevation +5.0, radius +0.0 and by azimuth -60.0" in told


def test_of_clips_that_end_at_the_same_goal_in_part_only_those_are_joined() -> None:
    nearly = (30.001, 5.0, 0.0)
    found = on_the_same_goals(sets_of(k0=clips("a", AHEAD, ASIDE), k1=clips("b", nearly, AHEAD)))
    (joined,) = found[0]
    assert {method.name: method.keys for method in joined.methods} == {
        "a": ("scn00000.sample_00", "scn00001.sample_00"),
        "b": ("scn00000.sample_00",),
    }
    assert "of 2 clips of the same names 1 do not" in found[1][0]


@pytest.mark.parametrize("change", [None, AHEAD])
def test_the_same_path_at_another_moment_is_another_goal(change: Change | None) -> None:
    moved = clips("b", change, change, target=(2.0, 2.0, 2.0, 2.01))
    found = on_the_same_goals(sets_of(k0=clips("a", change, change), k1=moved))
    assert (found[0], len(found[1])) == ((), 1)
    assert "the target's pictures differ" in found[1][0]
