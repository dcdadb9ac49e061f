"""Whether the claims of the small study (docs/evaluation.md) hold, from folders that `gcd-train evaluate` wrote.

    python tools/study_findings.py runs/small-study/evaluated/* --out runs/small-study/findings

The claims are those of Van Hoorick et al. 2024 (GCD), section 5: gradual views are better than direct ones, pretraining
on image-to-video helps, and the model beats what it is compared with. One holds where the 95 % interval of the paired
difference (bootstrap over scenes) lies above zero. Clips are paired by name where both show the same in the frames that
count: models of two paths share the last frame alone. Writes findings.md and findings.csv.
"""

import argparse
from pathlib import Path

from gcd_train.evaluation.paper import PICTURE_COLUMNS
from gcd_train.evaluation.runs import Run, gather, targets_apart
from gcd_train.evaluation.tables import differences, differences_csv, markdown_rows

CLAIMS = [
    ("gradual > direct", "study-gradual-pretrained", "study-direct-pretrained", "last"),
    ("gradual > direct", "study-gradual-scratch", "study-direct-scratch", "last"),
    ("pretrained > scratch", "study-gradual-pretrained", "study-gradual-scratch", "2-last"),
    ("pretrained > scratch", "study-direct-pretrained", "study-direct-scratch", "2-last"),
    ("ours > baseline", "study-gradual-pretrained", "reproject_rgbd", "2-last"),
    ("ours > baseline", "study-gradual-pretrained", "vanilla_svd", "2-last"),
    ("ours > baseline", "study-gradual-pretrained", "hexplane_1", "2-last"),
]
HEADS = ["claim", "first", "other", "frames", "figure", "first ahead [95 %]", "clips", "the claim"]
VERDICTS = {"better": "holds", "worse": "the opposite holds", "open": "not shown"}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--small", action="store_true", help="of models trained with --small")
    options = parser.parse_args()
    methods = by_name(gather([Run.read(run) for run in options.runs]))
    rows, notes, found = [], [], []
    for text, *names, frames in CLAIMS:
        first, other = (name + "-small" if options.small and name.startswith("study-") else name for name in names)
        head = [text, first, other, frames]
        if first not in methods or other not in methods:
            rows.append([*head, "-", "not run", "-", "-"])
            continue
        keys, note = shared(methods[first], methods[other], frames)
        notes += [note] if note else []
        apart = differences(methods[first], methods[other], frames, keys=keys, columns=PICTURE_COLUMNS)
        rows += [[*head, *figures(each)] for each in apart] or [[*head, "-", "no clips in common", "-", "-"]]
        found += apart
    table = "\n".join([*markdown_rows(HEADS, rows), *(f"\n{note}" for note in notes)]) + "\n"
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "findings.md").write_text(table)
    (options.out / "findings.csv").write_text(differences_csv(found))
    print(table)


def by_name(sets):
    methods = {}
    for method in (method for each in sets for method in each.methods):
        if method.name in methods:
            raise SystemExit(f"{method.name} was measured on two sets of clips; name the runs of one of them")
        methods[method.name] = method
    return methods


def shared(first, other, frames):
    """The clips in which both show the same, and which are left out and why."""
    pairs = {
        key: (first.records[first.places[key]], other.records[other.places[key]]) for key in first.common_keys(other)
    }
    why = {key: targets_apart(*pair, frames) for key, pair in pairs.items()}
    left_out = [key for key, reason in why.items() if reason]
    if not left_out:
        return list(why), ""
    note = (
        f"{first.name} and {other.name}, frames {frames}: of {len(why)} clips of the same names {len(left_out)} do not "
        f"show the same, so they are not compared. In {left_out[0]} {why[left_out[0]]}."
    )
    return [key for key, reason in why.items() if not reason], note


def figures(each):
    numbers = (f"{number:+.{each.column.digits}f}" for number in (each.apart.value, each.apart.low, each.apart.high))
    return [each.column.heading, "{} [{}, {}]".format(*numbers), str(each.clips), VERDICTS[each.verdict]]


if __name__ == "__main__":
    main()
