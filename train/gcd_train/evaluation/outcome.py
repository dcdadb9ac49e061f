"""From the records of a run to the report that `evaluate` prints and writes."""

import math
from collections.abc import Callable, Mapping, Sequence

from gcd_model.geometry import CameraMount
from gcd_train.errors import DataError
from gcd_train.evaluation.clips import EvaluationSet
from gcd_train.evaluation.contact_sheet import write_contact_sheet
from gcd_train.evaluation.figures import Figures, summed_up
from gcd_train.evaluation.held_out import class_grid
from gcd_train.evaluation.keeping import RunKeeper
from gcd_train.evaluation.paired_set import PairedSet
from gcd_train.evaluation.plan import Plan
from gcd_train.evaluation.record import ClipRecord
from gcd_train.evaluation.report import Conditions, MountNumbers, Report, Shot, best_of, write_report
from gcd_train.evaluation.spread import ClipWork
from gcd_train.evaluation.tables import to_markdown
from gcd_train.evaluation.tallies import MAIN, Selection

Rows = Mapping[str, tuple[ClipRecord, ...]]
"""Records by method; all methods have the same clips, in the order of the set."""


_SHEET_SECONDS = 60.0
"""A method that would take longer than this to make its rows of the sheet again is left out there."""


def write_outcome(plan: Plan, work: ClipWork, sheet_clips: int) -> str:
    """Write `evaluation.json`, `evaluation.md` and, for some clips, `contact_sheet.png`; gives the text.

    Raises:
        DataError: no clip was measured with every method. RunError: a record is damaged, or nothing can be written.
    """
    keeper, clips = RunKeeper(work.folder), plan.clips
    rows = complete_rows(keeper, [method.name for method in plan.methods], clips)
    selection = Selection(frames="all") if plan.asked.protocol == "released" else MAIN
    found = {name: summed_up(records, selection, classes=len(clips.classes)) for name, records in rows.items()}
    shots = tuple(shot(clips, record) for record in next(iter(rows.values())))
    report = Report(
        conditions=_conditions(plan, shots),
        classes=tuple(each.name for each in clips.classes),
        model=tuple(found[method.name] for method in plan.models if method.name in found),
        baselines=tuple(found[method.name] for method in plan.rivals if method.name in found),
    )
    text = to_markdown(report)
    write_report(report, text, work.folder)
    if sheet_clips:
        keys = [record.key for record in next(iter(rows.values()))][:sheet_clips]
        write_contact_sheet(
            work.folder / "contact_sheet.png",
            [work.predictor(name) for name in _shown(report, len(keys))],
            [(str(each), clips.clip(key)) for each, key in zip(shots, keys, strict=False)],
            classes=clips.classes,
        )
    return text


def complete_rows(keeper: RunKeeper, methods: Sequence[str], clips: EvaluationSet) -> Rows:
    """The records of clips that every method has, of methods that have any: figures of others cannot be compared.

    Raises: DataError where no clip is left. RunError: a record is damaged.
    """
    found = {name: [key for key in clips.keys if keeper.has(name, key)] for name in methods}
    there = {name: keys for name, keys in found.items() if keys}
    shared = [key for key in clips.keys if there and all(key in keys for keys in there.values())]
    if not shared:
        raise DataError("no clip could be measured with every method; see the failures above")
    return {name: tuple(keeper.read(name, key) for key in shared) for name in there}


def shot(clips: EvaluationSet, record: ClipRecord) -> Shot:
    """How the clip of a record is called in a table."""
    if isinstance(clips, PairedSet):
        number = clips.number(record.key)
        world, scene = clips.clips.scene(number)
        return Shot(world=world, scene=scene, clip=clips.clips.name(number), change=record.change)
    world = record.scene.rstrip("0123456789")
    number = int(record.scene[len(world) :] or 0)
    return Shot(world=world.strip("_"), scene=number, clip=record.key.rpartition(".")[2], change=record.change)


def _conditions(plan: Plan, shots: tuple[Shot, ...]) -> Conditions:
    clips, model, asked = plan.clips, plan.model, plan.asked
    pairs = clips if isinstance(clips, PairedSet) else None
    return Conditions(
        data=tuple(map(str, asked.data)),
        weights=None if model is None else model.name,
        sha256_12=None if model is None else model.sha256_12,
        steps=None if model is None else model.config.sampling.steps,
        shots=shots,
        frames=clips.frames,
        size=(clips.height, clips.width),
        grid=class_grid(clips),
        camera=clips.camera,
        true_mount=None if pairs is None else _numbers(pairs.clips.mount),
        declared_mount=None if pairs is None else _numbers(pairs.declared),
        train=() if plan.training is None else tuple(map(str, asked.rivals.train or ())),
        train_clips=0 if plan.training is None else plan.training.count,
        samples=asked.tested.sampling.samples,
        first_frame=1 if asked.protocol == "released" else 2,
    )


def _shown(report: Report, sheet_clips: int) -> list[str]:
    """The model, and the best rivals with and without more than the source, by its kinds of figure."""
    wanted = [each.name for each in report.model[:1]]
    quick = [each for each in report.baselines if each.seconds_per_clip * sheet_clips <= _SHEET_SECONDS]
    for figure in _compared(report):
        for privileged in (False, True):
            best = best_of([each for each in quick if each.privileged == privileged], figure)
            wanted += [] if best is None else [best.name]
    return [each.name for each in report.evaluations if each.name in wanted]


def _compared(report: Report) -> list[Callable[[Figures], float]]:
    def psnr(of: Figures) -> float:
        return of.psnr_db

    def miou(of: Figures) -> float:
        return of.miou

    return [figure for figure in (psnr, miou) if not (report.model and math.isnan(figure(report.model[0].total)))]


def _numbers(mount: CameraMount | None) -> MountNumbers | None:
    return None if mount is None else MountNumbers(height_m=mount.height_m, tilt_deg=mount.tilt_deg)
