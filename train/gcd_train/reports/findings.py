"""Whether a study's findings hold: each is a difference between two methods over the scenes both were measured on.

The claims are those of Van Hoorick et al. 2024 (GCD), section 5: gradual views are better than direct ones, pretraining
on image-to-video helps, and the model beats what it is compared with.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gcd_train.errors import RunError
from gcd_train.evaluation.record import ClipRecord
from gcd_train.evaluation.tallies import Selection, Span
from gcd_train.reports.comparison import Difference
from gcd_train.reports.goals import SharedClips, shared_clips
from gcd_train.reports.intervals import difference, drawn
from gcd_train.reports.material import Method, Run, gather
from gcd_train.reports.paper import PICTURE_COLUMNS, Column
from gcd_train.reports.table import NOT_RUN, NOTHING, markdown_rows

_SHOWN = {"better": "holds", "worse": "the opposite holds", "open": "not shown"}


@dataclass(frozen=True, kw_only=True, slots=True)
class Claim:
    """That one method is better than another. frames: that count; models of two paths share the last frame alone."""

    text: str
    first: str
    other: str
    frames: Span


@dataclass(frozen=True, kw_only=True, slots=True)
class Finding:
    """A claim and, for each figure, how far the first method is ahead; none where there is nothing to compare.

    note: which clips of the same names are not compared, and why; empty for none. run: whether both methods were.
    """

    claim: Claim
    apart: tuple[Difference, ...]
    note: str = ""
    run: bool = True


def study_claims(suffix: str = "") -> tuple[Claim, ...]:
    """What the small-scale study asks. suffix: of the models' names, "-small" for the tiny form."""

    def model(path: str, start: str) -> str:
        return f"study-{path}-{start}{suffix}"

    ours = model("gradual", "pretrained")
    rivals = ("reproject_rgbd", "vanilla_svd", "hexplane_1")
    return (
        *(
            Claim(text="gradual > direct", first=model("gradual", start), other=model("direct", start), frames="last")
            for start in ("pretrained", "scratch")
        ),
        *(
            Claim(
                text="pretrained > scratch",
                first=model(path, "pretrained"),
                other=model(path, "scratch"),
                frames="2-last",
            )
            for path in ("gradual", "direct")
        ),
        *(Claim(text="ours > baseline", first=ours, other=other, frames="2-last") for other in rivals),
    )


def findings(runs: Sequence[Run], claims: Sequence[Claim], *, seed: int = 0) -> tuple[Finding, ...]:
    """Each claim with its differences and their paired 95 % intervals, bootstrap over scenes.

    Methods may have been measured on sets of their own, of the same scenes: clips are paired by their keys, where their
    targets are the same in the claim's frames.

    Raises:
        RunError: two runs name two different methods alike, or one method was measured on two sets.
    """
    methods = _by_name(runs)
    return tuple(_finding(methods, claim, seed) for claim in claims)


def to_markdown(found: Sequence[Finding]) -> str:
    """A row for each claim and figure: how far ahead, its interval, and whether the claim holds."""
    heads = ["claim", "first", "other", "frames", "figure", "first ahead [95 %]", "clips", "the claim"]
    rows = [row for finding in found for row in _rows(finding)]
    notes = [f"\n{finding.note}" for finding in found if finding.note]
    return "\n".join([*markdown_rows(heads, rows), *notes]) + "\n"


def _by_name(runs: Sequence[Run]) -> Mapping[str, Method]:
    methods: dict[str, Method] = {}
    for each in gather(runs):
        for method in each.methods:
            if method.name in methods:
                raise RunError(
                    f"{method.name} was measured on two sets of clips, {methods[method.name].folder} and "
                    f"{method.folder}; name the runs of one of them"
                )
            methods[method.name] = method
    return methods


def _finding(methods: Mapping[str, Method], claim: Claim, seed: int) -> Finding:
    if claim.first not in methods or claim.other not in methods:
        return Finding(claim=claim, apart=(), run=False)
    shared = shared_clips(methods[claim.first].records, methods[claim.other].records, claim.frames)
    return Finding(
        claim=claim,
        apart=_apart(claim, shared.first, shared.other, seed) if shared.first else (),
        note=_left_out(claim, shared),
    )


def _apart(claim: Claim, ours: Sequence[ClipRecord], theirs: Sequence[ClipRecord], seed: int) -> tuple[Difference, ...]:
    found: list[Difference] = []
    for column in PICTURE_COLUMNS:
        selection = Selection(frames=claim.frames, region=column.region)
        first, other = (drawn(records, selection, seed=seed) for records in (ours, theirs))
        apart = difference(first, other, column.figure)
        if apart.known:
            found.append(
                Difference(
                    first=claim.first,
                    other=claim.other,
                    column=column,
                    frames=claim.frames,
                    clips=len(ours),
                    apart=apart,
                )
            )
    return tuple(found)


def _left_out(claim: Claim, shared: SharedClips) -> str:
    if not shared.left_out:
        return ""
    key, reason = next(iter(shared.left_out.items()))
    return (
        f"{claim.first} and {claim.other}, frames {claim.frames}: of {len(shared.left_out) + len(shared.first)} clips "
        f"of the same names {len(shared.left_out)} do not show the same, so they are not compared. In {key} {reason}."
    )


def _rows(finding: Finding) -> list[list[str]]:
    claim = finding.claim
    head = [claim.text, claim.first, claim.other, claim.frames]
    if not finding.apart:
        return [[*head, NOTHING, "no clips in common" if finding.run else NOT_RUN, NOTHING, NOTHING]]
    return [
        [*head, each.column.heading, _figures(each, each.column), str(each.clips), _SHOWN[each.verdict]]
        for each in finding.apart
    ]


def _figures(each: Difference, column: Column) -> str:
    value, low, high = (
        f"{number:+.{column.digits}f}" for number in (each.apart.value, each.apart.low, each.apart.high)
    )
    return f"{value} [{low}, {high}]"
