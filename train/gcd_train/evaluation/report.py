"""The report as a folder: `report.md`, its tables as CSV, plots, galleries and videos."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from math import inf, isnan, nan
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from gcd_train.errors import RunError
from gcd_train.evaluation.anyview import benchmark_table, published_table
from gcd_train.evaluation.galleries import shown_clips, strips, write_sheet, write_video
from gcd_train.evaluation.paper import is_model
from gcd_train.evaluation.runs import EvaluatedSet, gather, on_the_same_goals
from gcd_train.evaluation.statistics import FEW_SCENES, SEED, Interval, Span
from gcd_train.evaluation.store import Region, Run, folder_name
from gcd_train.evaluation.tables import (
    NOTHING,
    Difference,
    Table,
    all_figures,
    class_table,
    clips_csv,
    csv_text,
    differences,
    differences_csv,
    differences_markdown,
    frames_told,
    main_tables,
    markdown_rows,
    numbers,
    region_table,
    to_csv,
    to_markdown,
)
from gcd_train.files import write_whole
from gcd_train.pictures import new_figure, require_matplotlib, save

_SPANS: tuple[Span, ...] = ("2-last", "last")
"""Of tables; the released script's figures are over all frames, so these come first where a run used it."""


def make_report(
    folders: Sequence[Path],
    out: Path,
    *,
    leads: Sequence[str] = (),
    clips: int = 4,
    drawn: bool = True,
    command: str = "",
) -> Path:
    """Read runs and write everything about them. Nothing is measured again.

    Args:
        folders: of runs. leads: methods that are compared with all others; empty for every model, or the first method
            where there is none. clips: in the gallery. drawn: whether there are plots, which want matplotlib. command:
            the line that makes this report, for its first page.
    Returns: the path of `report.md`.
    Raises:
        RunError: a run cannot be read, two do not go together, none has a lead, or a file cannot be written.
        RenderError: plots are wanted and matplotlib is not installed.
    """
    if drawn:
        require_matplotlib()
    runs = tuple(Run.read(folder) for folder in folders)
    sets = gather(runs)
    known = dict.fromkeys(method.name for each in sets for method in each.methods)
    unknown = [name for name in leads if name not in known]
    if unknown:
        raise RunError(f"no method is called {unknown[0]!r} in these runs; there are {', '.join(known)}")
    pages = ["# Report", *([f"```bash\n{command}\n```"] if command else [])]
    pages.append(f"Intervals: 95 %, 10 000 draws of scenes, seed {SEED}.")
    pages += map(_about, runs)
    for number, each in enumerate(sets, start=1):
        place = Path("." if len(sets) == 1 else f"{number}-{each.note.kind}-{each.note.modality}")
        writer = _Writer(of=each, out=out, place=place, chosen=tuple(leads))
        spans: tuple[Span, ...] = ("all", *_SPANS) if each.note.protocol == "release" else _SPANS
        if each.note.protocol == "anyviewbench":
            pages += [f"## {each.title}", *writer.benchmark()]
        else:
            pages += [f"## {each.title}", *writer.tables(spans), *writer.differences(spans), *writer.plots(drawn)]
        pages += writer.gallery(clips)
    joined, notes = on_the_same_goals(sets)
    for number, each in enumerate(joined, start=1):
        writer = _Writer(of=each, out=out, place=Path(f"last-frame-{number}"), chosen=tuple(leads))
        pages.append(f"## The last frame together: {each.title}")
        pages.append(
            "Clips of the same names end at the same goals here, so their last frames are comparable and no others."
        )
        pages += [*map(writer.table, main_tables(each, ("last",))), *writer.differences(("last",))]
    if notes:
        pages += ["## What is not compared", "\n".join(f"- {note}" for note in notes)]
    write_whole(out / "report.md", ("\n\n".join(page.rstrip("\n") for page in pages) + "\n").encode())
    return out / "report.md"


def _about(run: Run) -> str:
    """What the figures of a run were made by: command, seeds, digests."""
    note = run.note
    seconds = {name: [each.seconds for each in run.records if each.method == name] for name in note.methods}
    rows = [
        [
            name,
            str(len(seconds[name])),
            f"{fmean(seconds[name]):.2f}" if seconds[name] else NOTHING,
            ", ".join(f"{key} {value}" for key, value in details.items()),
        ]
        for name, details in note.methods.items()
    ]
    lines = [
        f"## Run {run.folder.name}\n\n```bash\n{note.command}\n```\n",
        f"- made: {note.made}, {', '.join(f'{name} {version}' for name, version in note.versions.items())}",
        f"- clips: {', '.join(note.data)}, digest {note.data_identity}",
        f"- protocol: {note.protocol}, seed {note.seed}",
        f"- size: {'at most ' * bool(note.groups)}{note.frames} frames of {note.width}x{note.height}",
        "",
        *markdown_rows(["method", "clips", "s/clip", "what it is"], rows),
    ]
    without = [name for name in note.methods if not seconds[name]]
    if without:
        why = "No clip was measured; the line of `gcd-train evaluate` says why."
        lines.append(f"\n**Failed: {', '.join(without)}. {why}**")
    return "\n".join(lines)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Writer:
    """One set's part of the report, as paragraphs; its files are written on the way.

    place: its folder within `out`. chosen: see `make_report`.
    """

    of: EvaluatedSet
    out: Path
    place: Path
    chosen: tuple[str, ...]

    def table(self, table: Table) -> str:
        return f"{to_markdown(table)}\n{self._written(f'tables/{table.name}.csv', to_csv(table))}"

    def tables(self, spans: Sequence[Span]) -> Iterator[str]:
        yield from map(self.table, main_tables(self.of, spans))
        yield self.table(region_table(self.of, spans[0]))
        if any(method.makes_classes for method in self.of.methods):
            yield self.table(class_table(self.of, spans[0]))
        figures = self._written("tables/figures.csv", all_figures(self.of))
        by_clip = self._written("tables/clips.csv", clips_csv(self.of))
        yield f"All figures with their intervals: {figures}; clip by clip: {by_clip}."

    def benchmark(self) -> Iterator[str]:
        """Of AnyViewBench: its own means, and what is published."""
        yield from map(self.table, (benchmark_table(self.of), published_table()))
        yield f"Clip by clip: {self._written('tables/clips.csv', clips_csv(self.of, 'all'))}."

    def differences(self, spans: Sequence[Span]) -> Iterator[str]:
        """Of the chosen methods that the set has, else of its models, else of its first, from all others."""
        methods, every = self.of.methods, list[Difference]()
        leads = tuple(method for name in self.chosen for method in methods if method.name == name)
        if not self.chosen:
            leads = tuple(method for method in methods if is_model(method.name, method.details)) or methods[:1]
        for frames in spans:
            for lead in leads:
                others = (other for other in methods if other.name != lead.name)
                found = [each for other in others for each in differences(lead, other, frames)]
                every += found
                if found:
                    yield f"### {lead.starred} against the others, {frames_told(self.of, frames)}"
                    yield differences_markdown(found, self.of)
        if every:
            yield (
                "How far it lies above the other on the same clips; bold where zero lies outside the 95 % interval, "
                f"which is paired over scenes. {self._written('tables/differences.csv', differences_csv(every))}"
            )
        if every and self.of.scenes < FEW_SCENES:
            yield f"Of {self.of.scenes} scenes alone: too few to rest a claim on, whatever is bold."

    def plots(self, drawn: bool) -> Iterator[str]:
        for plot in all_plots(self.of):
            points = [(name, point) for name, curve in plot.curves.items() for point in curve]
            lines = [[name, "" if isnan(p.x) else f"{p.x:g}", *numbers(p.y), str(p.clips)] for name, p in points]
            heads = ["method", plot.across, plot.up, "low", "high", "clips"]  # levels have no x
            by_point = self._written(f"plots/{plot.name}.csv", csv_text(heads, lines))
            if drawn:
                shown, picture = f"{plot.up} by {plot.across}", self.place / f"plots/{plot.name}.png"
                draw(plot, self.out / picture)
                yield f"### {plot.title}: {shown}\n\n![{shown}]({picture})"
            yield f"The numbers: {by_point}"

    def gallery(self, count: int) -> Iterator[str]:
        """A sheet of so many clips, and a video of each."""
        keys = shown_clips(self.of, self.of.methods, count) if count else ()
        if count and not keys:
            yield "No frames were kept, so there is no gallery: evaluate with `--views few`."
        if not keys:
            return
        clips, sheet = [(key, strips(self.of.methods, key)) for key in keys], self.place / "gallery/sheet.png"
        write_sheet(clips, self.out / sheet)
        yield f"### Gallery\n\n![{', '.join(keys)}]({sheet})"
        files = {key: self.place / f"gallery/{folder_name(key)}.mp4" for key in keys}
        made = [files[key] for key, rows in clips if write_video(rows, self.of.clips[key].fps, self.out / files[key])]
        if made:
            yield f"Videos: {', '.join(f'[{file.name}]({file})' for file in made)}"

    def _written(self, name: str, text: str) -> str:
        """Write a file; gives the link to it."""
        write_whole(self.out / self.place / name, text.encode())
        return f"[{Path(name).name}]({self.place / name})"


ANGLE_STEP_DEG = 15.0
_MOST_ANGLES = 13  # so many different ones are shown as they are
_HEXPLANE = re.compile(r"hexplane[ _-]?(\d+)", re.IGNORECASE)


@dataclass(frozen=True, kw_only=True, slots=True)
class Point:
    """x: where on the axis, NaN for a level right across. y: the figure there. clips: that it is of."""

    x: float
    y: Interval
    clips: int


@dataclass(frozen=True, kw_only=True, slots=True)
class Plot:
    """name: of its files. title, across, up: what it shows. curves: points by the name of their line."""

    name: str
    title: str
    across: str
    up: str
    curves: dict[str, list[Point]]


def all_plots(of: EvaluatedSet) -> tuple[Plot, ...]:
    """All that the records are enough for."""
    return tuple(plot for plot in (error_by_angle(of), ssim_by_views(of)) if plot.curves)


def error_by_angle(of: EvaluatedSet) -> Plot:
    """PSNR of the last frame over the angle that the camera has turned by, |azimuth|; no curve on one path for all.

    Source: GCD, the study of angles in appendix B.2: error against the rotation about the scene.
    """
    curves: dict[str, list[Point]] = {}
    for method in of.methods:
        turned = {each.key: abs(each.change[0]) for each in method.records if each.change is not None}
        many, groups = len({round(angle, 1) for angle in turned.values()}) > _MOST_ANGLES, dict[float, list[str]]()
        for key, angle in turned.items():  # as it is or, where many differ, in the middle of its step
            middle = (min(angle, 179.999) // ANGLE_STEP_DEG + 0.5) * ANGLE_STEP_DEG
            groups.setdefault(middle if many else round(angle, 1), []).append(key)
        points = [
            Point(x=x, y=method.sums("last", keys=keys).interval("psnr_db"), clips=len(keys))
            for x, keys in sorted(groups.items())
        ]
        known = [point for point in points if point.y.known]
        curves |= {method.name: known} if len(known) > 1 else {}
    across = "azimuth turned by, degrees"
    return Plot(name="psnr_by_angle", title="Last frame, all pixels", across=across, up="PSNR, dB", curves=curves)


def ssim_by_views(of: EvaluatedSet) -> Plot:
    """SSIM over the number of views that HexPlane is given; every other method as a level. No curve without HexPlane.

    Source: GCD, section 5: how many input views a reconstruction needs to come near.
    """
    views = {method.name: int(m[1]) for method in of.methods if (m := _HEXPLANE.search(method.name))}
    regions: tuple[Region, ...] = ("all", "occluded")
    curves: dict[str, list[Point]] = {}
    for region, method in product(regions, sorted(of.methods, key=lambda m: views.get(m.name, inf))):
        name = "HexPlane" if method.name in views else method.name
        y = method.sums(region=region).interval("ssim")
        if y.known and views and (name == "HexPlane" or region == "all"):
            point = Point(x=views.get(method.name, nan), y=y, clips=len(method.records))
            curves.setdefault(f"{name}, {region}", []).append(point)
    if all(isnan(curve[0].x) for curve in curves.values()):  # levels alone
        curves = {}
    title = "HexPlane, frames 2 to the last"
    return Plot(name="ssim_by_views", title=title, across="views given", up="SSIM", curves=curves)


_SIZE_IN = (7.2, 4.4)
_MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")


def draw(plot: Plot, out: Path) -> None:
    """One PNG: lines with 95 % intervals, levels dashed. Raises RenderError without matplotlib."""
    figure = new_figure(*_SIZE_IN)
    axes = figure.add_subplot()
    for number, (name, curve) in enumerate(plot.curves.items()):
        x, y, colour = [point.x for point in curve], [point.y.value for point in curve], f"C{number % 10}"
        if isnan(x[0]):
            axes.axhline(y[0], linestyle="--", linewidth=1.0, color=colour, label=name)
            continue
        bounds = np.array([(each.value - each.low, each.high - each.value) for each in (point.y for point in curve)])
        yerr, mark = np.nan_to_num(bounds).clip(0.0).T, _MARKS[number % len(_MARKS)]
        style: dict[str, Any] = {"marker": mark, "color": colour, "markersize": 4, "linewidth": 1.2}
        axes.errorbar(x, y, yerr=yerr, capsize=2, elinewidth=0.7, label=name, **style)
    axes.set_title(plot.title, fontsize=10, loc="left")
    places = sorted({point.x for curve in plot.curves.values() for point in curve if not isnan(point.x)})
    axes.set(xlabel=plot.across, ylabel=plot.up, xticks=places, xlim=(places[0] - 1, places[-1] + 1))
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    figure.tight_layout()
    save(figure, out)
