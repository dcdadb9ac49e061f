"""The report as a folder: `report.md`, its tables as CSV, plots, galleries and videos."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from gcd_train.errors import RecipeError, RunError
from gcd_train.evaluation.galleries import shown_clips, strips, write_sheet, write_video
from gcd_train.evaluation.paper import is_model, tables_for
from gcd_train.evaluation.plots import all_plots, curves_csv, draw, require_matplotlib
from gcd_train.evaluation.runs import EvaluatedSet, Method, Run, gather, on_the_same_goals
from gcd_train.evaluation.statistics import FEW_SCENES, SEED, Span
from gcd_train.evaluation.store import folder_name
from gcd_train.evaluation.tables import (
    NOTHING,
    STAR_OF_FIGURE,
    Difference,
    Table,
    all_figures,
    class_table,
    clips_csv,
    differences,
    differences_csv,
    differences_markdown,
    frames_told,
    main_tables,
    markdown_rows,
    region_table,
    to_csv,
    to_markdown,
)
from gcd_train.files import write_whole

_SPANS: tuple[Span, ...] = ("2-last", "last")
"""Of tables; the released script's figures are over all frames, so these come first where a run used it."""


def make_report(
    folders: Sequence[Path],
    out: Path,
    *,
    leads: Sequence[str] = (),
    rows: Mapping[str, str] | None = None,
    clips: int = 4,
    drawn: bool = True,
    command: str = "",
) -> Path:
    """Read runs and write everything about them. Nothing is measured again.

    Args:
        folders: of runs. leads: methods that are compared with all others; empty for every model, or the first method
            where there is none. rows: method to its row in the paper's tables, where name and note do not tell. clips:
            in the gallery. drawn: whether there are plots, which want matplotlib. command: the line that makes this
            report, for its first page.
    Returns: the path of `report.md`.
    Raises:
        RunError: a run cannot be read, two do not go together, or a file cannot be written.
        RecipeError: a row is none of the paper's tables that its method's clips belong in.
        RenderError: plots are wanted and matplotlib is not installed.
    """
    if drawn:
        require_matplotlib()
    runs = tuple(Run.read(folder) for folder in folders)
    sets = gather(runs, rows)
    _require_choices(leads, rows or {}, sets)
    pages = [_first_page(runs, command)]

    def writer(of: EvaluatedSet, place: str) -> _Writer:
        return _Writer(of=of, out=out, place=place, chosen=tuple(leads), clips=clips, drawn=drawn)

    for number, each in enumerate(sets, start=1):
        place = "." if len(sets) == 1 else f"{number}-{each.note.kind}-{each.note.modality}"
        pages.append("\n".join(writer(each, place).sections()))
    joined, notes = on_the_same_goals(sets)
    for number, each in enumerate(joined, start=1):
        pages.append("\n".join(writer(each, f"last-frame-{number}").last_frames()))
    if notes:
        pages.append("\n".join(["## What is not compared\n", *(f"- {note}" for note in notes)]))
    write_whole(out / "report.md", ("\n".join(pages).rstrip() + "\n").encode())
    return out / "report.md"


def _require_choices(leads: Sequence[str], rows: Mapping[str, str], sets: Sequence[EvaluatedSet]) -> None:
    """Raises RunError for a method that none of the sets has, RecipeError for a row that it cannot stand in."""
    known = dict.fromkeys(method.name for each in sets for method in each.methods)
    unknown = [name for name in (*leads, *rows) if name not in known]
    if unknown:
        raise RunError(f"no method is called {unknown[0]!r} in these runs; there are {', '.join(known)}")
    for method, label in rows.items():
        its = [each for each in sets if any(known.name == method for known in each.methods)]
        labels = dict.fromkeys(row for each in its for table in tables_for(each.note) for row in table.rows)
        if not labels:
            raise RecipeError(
                f"--row says where {method} stands in the paper's tables, and none of them is for these clips; "
                "leave it out"
            )
        if label not in labels:
            raise RecipeError(f"--row {method}: no row is called {label!r}; there are {'; '.join(labels)}")


def _first_page(runs: Sequence[Run], command: str) -> str:
    """What the figures were made by: commands, seeds, digests."""
    lines = ["# Report", ""]
    if command:
        lines += ["```bash", command, "```", ""]
    lines += [f"Intervals: 95 %, 10 000 draws of scenes, seed {SEED}.", ""]
    for run in runs:
        lines += [f"## Run {run.folder.name}", "", "```bash", run.note.command, "```", "", *_note_lines(run), ""]
    return "\n".join(lines)


def _note_lines(run: Run) -> list[str]:
    note = run.note
    versions = ", ".join(f"{name} {version}" for name, version in note.versions.items())
    seconds: dict[str, list[float]] = {name: [] for name in note.methods}
    for record in run.records:
        seconds.setdefault(record.method, []).append(record.seconds)
    rows = [
        [
            name,
            str(len(seconds[name])),
            f"{fmean(seconds[name]):.2f}" if seconds[name] else NOTHING,
            ", ".join(f"{key} {value}" for key, value in told.items()),
        ]
        for name, told in note.methods.items()
    ]
    lines = [
        f"- made: {note.made}, {versions}",
        f"- clips: {', '.join(note.data)}, digest {note.data_identity}",
        f"- protocol: {note.protocol}, seed {note.seed}",
        f"- size: {note.frames} frames of {note.width}x{note.height}",
        "",
        *markdown_rows(["method", "clips", "s/clip", "what it is"], rows),
    ]
    without = [name for name in note.methods if not seconds[name]]
    if without:
        why = "No clip was measured; the line of `gcd-train evaluate` says why."
        lines += ["", f"**Failed: {', '.join(without)}. {why}**"]
    return lines


@dataclass(frozen=True, kw_only=True, slots=True)
class _Writer:
    """One set's part of the report. place: its folder within `out`. chosen, clips, drawn: see `make_report`."""

    of: EvaluatedSet
    out: Path
    place: str
    chosen: tuple[str, ...]
    clips: int
    drawn: bool

    @property
    def leads(self) -> tuple[Method, ...]:
        """The methods that are compared with all others; those of the choice that the set has."""
        if self.chosen:
            return tuple(method for name in self.chosen for method in self.of.methods if method.name == name)
        models = tuple(method for method in self.of.methods if is_model(method.name, method.details))
        return models or self.of.methods[:1]

    def sections(self) -> Iterator[str]:
        spans: tuple[Span, ...] = ("all", *_SPANS) if self.of.note.protocol == "release" else _SPANS
        yield f"## {self.of.title}\n"
        yield from self._tables(spans)
        yield from self._differences(spans)
        yield from self._plots()
        yield from self._gallery()

    def last_frames(self) -> Iterator[str]:
        """Only what the last frame tells, of methods that go there in different ways."""
        yield f"## The last frame together: {self.of.title}\n"
        yield "Clips of the same names end at the same goals here, so their last frames are comparable and no others.\n"
        yield from map(self._table, main_tables(self.of, ("last",)))
        yield from self._differences(("last",))

    def _table(self, table: Table) -> str:
        self._write(f"tables/{table.name}.csv", to_csv(table))
        return f"{to_markdown(table)}\n{self._link(f'tables/{table.name}.csv')}\n"

    def _tables(self, spans: Sequence[Span]) -> Iterator[str]:
        yield from map(self._table, main_tables(self.of, spans))
        yield self._table(region_table(self.of, spans[0]))
        if any(method.makes_classes for method in self.of.methods):
            yield self._table(class_table(self.of, spans[0]))
        self._write("tables/figures.csv", all_figures(self.of))
        self._write("tables/clips.csv", clips_csv(self.of))
        yield (
            f"All figures with their intervals: {self._link('tables/figures.csv')}; "
            f"clip by clip: {self._link('tables/clips.csv')}.\n"
        )

    def _differences(self, spans: Sequence[Span]) -> Iterator[str]:
        every: list[Difference] = []
        for frames in spans:
            told = frames_told(self.of, frames)
            for lead in self.leads:
                found = differences(self.of, lead, frames)
                every += found
                if found:
                    yield f"### {lead.starred} against the others, {told}\n"
                    yield differences_markdown(found, self.of)
        if every:
            self._write("tables/differences.csv", differences_csv(every))
            yield (
                "How far it lies above the other on the same clips; bold where zero lies outside the 95 % interval, "
                f"which is paired over scenes. {self._link('tables/differences.csv')}\n"
            )
        if any(each.starred for each in every):
            yield f"{STAR_OF_FIGURE}\n"
        if every and self.of.scenes < FEW_SCENES:
            yield f"Of {self.of.scenes} scenes alone: too few to rest a claim on, whatever is bold.\n"

    def _plots(self) -> Iterator[str]:
        for plot in all_plots(self.of):
            self._write(f"plots/{plot.name}.csv", curves_csv(plot))
            if self.drawn:
                told = f"{plot.up} by {plot.across}"
                draw(plot, self._path(f"plots/{plot.name}.png"))
                yield f"### {plot.title}: {told}\n\n![{told}]({self._name(f'plots/{plot.name}.png')})\n"
            yield f"The numbers: {self._link(f'plots/{plot.name}.csv')}\n"

    def _gallery(self) -> Iterator[str]:
        if not self.clips:
            return
        keys = shown_clips(self.of, self.of.methods, self.clips)
        if not keys:
            yield "No frames were kept, so there is no gallery: evaluate with `--views few`.\n"
            return
        yield "### Gallery\n"
        yield from self._shown("gallery", keys)

    def _shown(self, folder: str, keys: Sequence[str]) -> Iterator[str]:
        """A sheet of clips, and a video of each."""
        clips = [(key, strips(self.of.methods, key)) for key in keys]
        write_sheet(clips, self._path(f"{folder}/sheet.png"))
        yield f"![{', '.join(keys)}]({self._name(f'{folder}/sheet.png')})\n"
        names = {key: f"{folder}/{folder_name(key)}.mp4" for key in keys}
        made = {names[key]: write_video(rows, self.of.clips[key].fps, self._path(names[key])) for key, rows in clips}
        videos = [self._link(name) for name, done in made.items() if done]
        if videos:
            yield f"Videos: {', '.join(videos)}\n"

    def _name(self, name: str) -> str:
        return name if self.place == "." else f"{self.place}/{name}"

    def _path(self, name: str) -> Path:
        return self.out / self._name(name)

    def _link(self, name: str) -> str:
        return f"[{Path(name).name}]({self._name(name)})"

    def _write(self, name: str, text: str) -> None:
        write_whole(self._path(name), text.encode())
