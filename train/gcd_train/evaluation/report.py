"""The report as a folder: `report.md`, its tables as CSV, plots, galleries and videos."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import isnan
from pathlib import Path
from statistics import fmean

from gcd_train.errors import RunError
from gcd_train.evaluation.anyview import benchmark_table, published_table
from gcd_train.evaluation.figures import all_plots, draw
from gcd_train.evaluation.galleries import shown_clips, strips, write_sheet, write_video
from gcd_train.evaluation.paper import is_model
from gcd_train.evaluation.runs import EvaluatedSet, gather, on_the_same_goals
from gcd_train.evaluation.statistics import FEW_SCENES, SEED, Span
from gcd_train.evaluation.store import FRAMES_IN, Run, folder_name
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
from gcd_train.pictures import require_matplotlib

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
        yield from map(self.table, (benchmark_table(self.of), published_table(), region_table(self.of, "all")))
        yield f"Clip by clip: {self._written('tables/clips.csv', clips_csv(self.of, 'all'))}."

    def differences(self, spans: Sequence[Span]) -> Iterator[str]:
        """Of the chosen methods that the set has, else of its models, else of saved frames, else of its first, from all
        others."""
        methods, every = self.of.methods, list[Difference]()
        leads = tuple(method for name in self.chosen for method in methods if method.name == name)
        if not self.chosen:
            models = tuple(method for method in methods if is_model(method.name, method.details))
            leads = models or tuple(method for method in methods if FRAMES_IN in method.details) or methods[:1]
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
            shown, picture = f"{plot.up} by {plot.across}", self.place / f"plots/{plot.name}.png"
            yield f"### {plot.title}: {shown}\n\nThe numbers: {by_point}"
            if drawn:
                draw(plot, self.out / picture)
                yield f"![{shown}]({picture})"

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
