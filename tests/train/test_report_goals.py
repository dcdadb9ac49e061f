"""Only clips whose targets are the same are compared across sets."""

from collections.abc import Sequence
from pathlib import Path

import msgspec
import pytest
from made_records import FRAMES, note, record, region

from gcd_train.evaluation.report import Choices, make_report
from gcd_train.evaluation.runs import EvaluatedSet, Run, gather, on_the_same_goals
from gcd_train.evaluation.store import ClipRecord, RegionRecord, RunKeeper

Change = tuple[float, float, float]
AHEAD: Change = (30.0, 5.0, 0.0)
ASIDE: Change = (-60.0, 20.0, 1.0)


def sharp(values: Sequence[float]) -> RegionRecord:
    """All pixels of a clip whose target is so sharp in each frame."""
    return msgspec.structs.replace(region((20.0,) * FRAMES), gradient_target=tuple(values))


def clips(method: str, *changes: Change | None, target: Sequence[float] = (2.0,) * FRAMES) -> list[ClipRecord]:
    """A clip of each of as many scenes as there are changes."""
    return [
        record(method, f"scn{number:05d}.sample_00", change=change, regions={"all": sharp(target)})
        for number, change in enumerate(changes)
    ]


def sets(**methods: list[list[ClipRecord]]) -> tuple[EvaluatedSet, ...]:
    """A run by each name, of clips of its own digest."""
    return gather([run(name, *of) for name, of in methods.items()])


def run(name: str, *of: list[ClipRecord]) -> Run:
    told = note(kind="kubric", protocol="paper", data_identity=name, methods={each[0].method: {} for each in of})
    return Run(folder=Path(name), note=told, records=tuple(each for method in of for each in method))


def test_clips_of_the_same_name_that_go_elsewhere_are_not_joined_and_it_is_said_why() -> None:
    found = on_the_same_goals(sets(k0=[clips("a", AHEAD, ASIDE)], k1=[clips("b", ASIDE, AHEAD)]))
    assert found[0] == ()
    (told,) = found[1]
    assert told.startswith("k0 and k1: of 2 clips of the same names 2 do not end at the same goal")
    assert "azimuth +30.0, elevation +5.0, radius +0.0 and by azimuth -60.0" in told


def test_of_clips_that_end_at_the_same_goal_in_part_only_those_are_joined() -> None:
    nearly = (30.001, 5.0, 0.0)
    found = on_the_same_goals(sets(k0=[clips("a", AHEAD, ASIDE)], k1=[clips("b", nearly, AHEAD)]))
    (joined,) = found[0]
    assert {method.name: method.keys for method in joined.methods} == {
        "a": ("scn00000.sample_00", "scn00001.sample_00"),
        "b": ("scn00000.sample_00",),
    }
    assert "of 2 clips of the same names 1 do not" in found[1][0]


@pytest.mark.parametrize("change", [None, AHEAD])
def test_the_same_path_at_another_moment_is_another_goal(change: Change | None) -> None:
    moved = clips("b", change, change, target=(2.0, 2.0, 2.0, 2.01))
    found = on_the_same_goals(sets(k0=[clips("a", change, change)], k1=[moved]))
    assert (found[0], len(found[1])) == ((), 1)
    assert "the target's pictures differ" in found[1][0]


def test_another_way_to_the_same_last_picture_is_joined() -> None:
    direct = clips("b", None, target=(5.0, 5.0, 5.0, 2.0))
    (joined,) = on_the_same_goals(sets(k0=[clips("a", None)], k1=[direct]))[0]
    assert [method.name for method in joined.methods] == ["a", "b"]


def test_a_report_of_other_goals_makes_no_claim_and_says_so(tmp_path: Path) -> None:
    for name, change in (("k0", AHEAD), ("k1", ASIDE)):
        keeper = RunKeeper(tmp_path / name)
        keeper.begin(note(kind="kubric", protocol="paper", data_identity=name, methods={name: {"weights": "ab"}}))
        for each in clips(name, change, change):
            keeper.keep(each)
    text = make_report([tmp_path / "k0", tmp_path / "k1"], tmp_path / "out", Choices(drawn=False, worst=0)).read_text()
    assert "The last frame together" not in text
    assert "## What is not compared" in text
    assert "do not end at the same goal" in text
