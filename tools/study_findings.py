"""Whether the claims of the small study (docs/evaluation.md) hold, from folders that `gcd-train evaluate` wrote.

    python tools/study_findings.py runs/small-study/evaluated/* --out runs/small-study/findings

The claims are those of Van Hoorick et al. 2024 (GCD), section 5: gradual views are better than direct ones, pretraining
on image-to-video helps, training on goals up to 90 degrees is better there than up to 180, and the model beats what it
is compared with; and ours, that it helps to be shown the source's points. A training is there once for each seed:
NAME-s1, NAME-s2 and so on. The figure is the mean paired difference over scenes and seeds; its 95 % interval draws both
anew, scenes and seeds (bootstrap, 10 000 draws), and what seeds differ by is widened by sqrt(S / (S - 1)), as S of them
drawn from S differ by less. A claim holds where the interval lies on the better side of zero and so does the difference
of each of two seeds or more. Clips are paired by name where both show the same in the frames that count: models of two
paths share the last frame alone. Writes findings.md, the tables of docs/log/small-study.md (bold: the claim holds;
slanted: its opposite does), and findings.csv, which has each seed's difference, too.
"""

import argparse
import re
from pathlib import Path

import numpy as np

from gcd_train.errors import TrainError
from gcd_train.evaluation.paper import PICTURE_COLUMNS, Column
from gcd_train.evaluation.runs import Run, gather, targets_apart
from gcd_train.evaluation.statistics import COVERAGE, DRAWS, FEW_SCENES, SEED, Interval, scene_weights
from gcd_train.evaluation.tables import Difference, csv_text, markdown_rows

GRADUAL, DROP, DROP_180 = (
    "study-gradual-pretrained",
    "study-drop-gradual-90-pretrained",
    "study-drop-gradual-180-pretrained",
)
SCRATCH, DROP_SCRATCH = "study-gradual-scratch", "study-drop-gradual-90-scratch"
DIRECT, DROP_DIRECT, DROP_DIRECT_180 = (each.replace("gradual", "direct") for each in (GRADUAL, DROP, DROP_180))
BASELINES = {"Reproject RGB-D": "reproject_rgbd", "Vanilla SVD": "vanilla_svd", "HexPlane, one view": "hexplane_1"}
CLAIMS = [
    ("gradual > direct, pretrained", GRADUAL, DIRECT, "last"),
    ("gradual > direct, scratch", SCRATCH, "study-direct-scratch", "last"),
    ("gradual > direct, max 90, pretrained", DROP, DROP_DIRECT, "last"),
    ("gradual > direct, max 180, pretrained", DROP_180, DROP_DIRECT_180, "last"),
    *(
        (*claim, frames)
        for claim in (
            ("pretrained > scratch, gradual", GRADUAL, SCRATCH),
            ("pretrained > scratch, direct", DIRECT, "study-direct-scratch"),
            ("pretrained > scratch, gradual, max 90", DROP, DROP_SCRATCH),
            ("pretrained > scratch, gradual, max 180", DROP_180, "study-drop-gradual-180-scratch"),
            ("max 90 > max 180, gradual, pretrained", DROP, DROP_180),
            ("max 90 > max 180, direct, pretrained", DROP_DIRECT, DROP_DIRECT_180),
            ("max 90 > max 180, gradual, scratch", DROP_SCRATCH, "study-drop-gradual-180-scratch"),
        )
        for frames in ("last", "2-last")  # the paper's tables are of the last
    ),
    ("points by given depth > none", "study-gradual-pretrained-given", GRADUAL, "2-last"),
    ("points by estimated depth > none", "study-gradual-pretrained-estimated", GRADUAL, "2-last"),
    *((f"gradual > {text}", GRADUAL, name, "2-last") for text, name in BASELINES.items()),
    *((f"gradual 90 > {text}", DROP, name, "2-last") for text, name in BASELINES.items()),
]
HEADS = ["claim", "first", "other", "frames", "figure", "first ahead [95 %]", "each seed", "clips", "the claim"]
VERDICTS = {"better": "holds", "worse": "the opposite holds", "open": "not shown"}
MARKS = {"holds": "**", "the opposite holds": "*"}
WORLDS = {"driving": "Driving", "kubric": "Things that fall"}
GRADIENT = Column(heading="gradient energy", figure="gradient_energy")
MEANS = [
    *((column, "2-last") for column in (*PICTURE_COLUMNS, GRADIENT)),
    *((column, "last") for column in PICTURE_COLUMNS),
]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    try:
        sets = gather([Run.read(run) for run in options.runs])
    except TrainError as error:
        raise SystemExit(str(error)) from error
    methods = by_name(sets)
    rows, notes = [], []
    seeds = sorted({seed for name in methods for seed in re.findall(r"-(s\d+)$", name)})
    for text, first, other, frames in CLAIMS:
        head, pairs = [text, first, other, frames], seeds_of(methods, first, other)
        if not pairs:
            rows.append([*head, "-", "not run", "-", "-", "-"])
            continue
        each_keys = []
        for pair in pairs.values():
            keys, note = shared(*pair, frames)
            notes += [note] if note else []
            each_keys.append(keys)
        keys = [key for key in each_keys[0] if all(key in others for others in each_keys)]
        most, lacking = max(map(len, each_keys)), [seed for seed in seeds if seed not in pairs]
        if len(keys) < most:
            notes.append(
                f"{first} and {other}: {len(keys)} of {most} clips, as not every seed has been measured whole."
            )
        if lacking:
            notes.append(f"{first} and {other}: without {', '.join(lacking)}, which is not there on both sides.")
        apart = [of for column in PICTURE_COLUMNS if (of := difference(pairs, column, frames, keys))] if keys else []
        rows += [[*head, *figures(*each)] for each in apart] or [[*head, "-", "no clips in common", "-", "-", "-"]]
    marks = "**Bold**: the claim holds. *Slanted*: its opposite does."
    parts = [*claims_tables(rows), marks, *means_tables(sets), *dict.fromkeys(notes)]
    table = "\n\n".join(parts) + "\n"
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "findings.md").write_text(table)
    (options.out / "findings.csv").write_text(csv_text(HEADS, rows))
    print(table)


def by_name(sets):
    """What was measured under each name; a baseline on several sets of clips."""
    methods = {}
    for method in (method for each in sets for method in each.methods):
        methods.setdefault(method.name, []).append(method)
    return methods


def seeds_of(methods, first, other):
    """Both methods of each seed that both were trained with; what is not trained stands beside every seed."""
    pairs = {}
    for name, (ours, *again) in sorted(methods.items()):
        if re.fullmatch(rf"{re.escape(first)}-s\d+", name):
            if again:
                raise SystemExit(f"{name} was measured on two sets of clips; name the runs of one of them")
            seed = name.removeprefix(f"{first}-")
            named = methods.get(f"{other}-{seed}") or methods.get(other, [])
            theirs = next((each for each in named if ours.common_keys(each)), None)
            pairs |= {seed: (ours, theirs)} if theirs is not None else {}
    return pairs


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


def difference(pairs, column, frames, keys):
    """How far the first lies above the other in one figure, and how far with each seed; None where it is unknown."""
    per_seed = []
    for first, other in pairs.values():
        ours, theirs = (each.sums(frames, column.region, keys).figure(column.figure) for each in (first, other))
        per_seed.append(ours - theirs)
    apart = np.array(per_seed)  # [seeds, scenes]
    apart = apart[:, ~np.isnan(apart).any(axis=0)]
    seeds, scenes = apart.shape
    if not scenes:
        return None
    drawn = np.random.default_rng(SEED).multinomial(seeds, np.full(seeds, 1 / seeds), size=DRAWS) / seeds
    if seeds > 1:
        drawn = 1 / seeds + (drawn - 1 / seeds) * np.sqrt(seeds / (seeds - 1))
    means = np.einsum("ds,sn,dn->d", drawn, apart, scene_weights(scenes) / scenes, optimize=True)
    low, high = np.quantile(means, [(1 - COVERAGE) / 2, (1 + COVERAGE) / 2]) if scenes > 1 else (np.nan, np.nan)
    (first, other), *_ = pairs.values()
    interval = Interval(value=float(apart.mean()), low=float(low), high=float(high))
    told = {"first": first.name, "other": other.name, "column": column, "frames": frames, "clips": len(keys)}
    return Difference(apart=interval, **told), apart.mean(axis=1)


def figures(each, seeds):
    form = f"+.{each.column.digits}f"
    numbers = (format(number, form) for number in (each.apart.value, each.apart.low, each.apart.high))
    apart = ", ".join(format(number, form) for number in seeds)
    agree = len(seeds) > 1 and len({number > 0 for number in seeds}) == 1
    verdict = each.verdict if agree and each.clips >= FEW_SCENES else "open"
    return [each.column.heading, "{} [{}, {}]".format(*numbers), apart, str(each.clips), VERDICTS[verdict]]


def claims_tables(rows):
    """A table for each world, with a row for each claim and a column for each figure."""
    found = {}
    for claim, first, _, frames, figure, apart, _, _, verdict in rows:
        world = WORLDS["kubric" if first.startswith("study-drop") else "driving"]
        mark = MARKS.get(verdict, "")
        found.setdefault(world, {}).setdefault((claim, frames), {})[figure] = f"{mark}{apart}{mark}"
    for world, claims in found.items():
        told = [column.heading for column in PICTURE_COLUMNS]
        heads = [head for head in told if any(head in each for each in claims.values())] or told[:1]
        cells = [[*claim, *(each.get(head, each.get("-", "-")) for head in heads)] for claim, each in claims.items()]
        yield "\n".join(markdown_rows([world, "frames", *heads], cells))


def means_tables(sets):
    """A table for each world, of every method's own figures: the mean over clips and seeds."""
    for kind, world in WORLDS.items():
        named = {}
        for method in (method for each in sets if each.note.kind == kind for method in each.methods):
            named.setdefault(re.sub(r"-s\d+( |$)", r"\1", method.starred), []).append(method)
        heads = [world, *(f"{frames}: {column.heading}" for column, frames in MEANS)]
        cells = [[name, *(mean(each, column, frames) for column, frames in MEANS)] for name, each in named.items()]
        used = [place for place in range(len(heads)) if any(row[place] != "-" for row in cells)]
        if cells:
            heads, *cells = ([row[place] for place in used] for row in (heads, *cells))
            yield "\n".join(markdown_rows(heads, cells))


def mean(methods, column, frames):
    """Of one figure, over clips and then over trainings."""
    every = [each.sums(frames, column.region).figure(column.figure) for each in methods]
    known = [each[~np.isnan(each)] for each in every]
    if not all(len(each) for each in known):
        return "-"
    return format(np.mean([each.mean() for each in known]), f".{column.digits}f")


if __name__ == "__main__":
    main()
