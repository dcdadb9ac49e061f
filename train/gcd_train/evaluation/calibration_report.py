"""A calibration as files: JSON for programs, a table for people, and the plot of what intervals hold."""

from pathlib import Path

import msgspec

from gcd_train.evaluation.calibration import LEVELS, Calibration, Reliability
from gcd_train.evaluation.keeping import write_whole
from gcd_train.evaluation.record import Region

STATED = (0.5, 0.9)
"""Levels that tables show."""

FEW_SCENES = 10
"""Of fewer, no claim can rest on what was found."""

_COLOURS: dict[Region, str] = {"all": "#1f4e9c", "visible": "#2c8a4b", "occluded": "#c0392b"}


class CalibrationNote(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a calibration holds for, and what it found; `calibration.json`.

    weights, sha256_12: of the model. data: folders. data_identity: digest of the clips. clips: measured. unreadable:
    clips that could not be read, with the reason. samples, steps, seed: of the sampler.
    """

    weights: str
    sha256_12: str
    data: tuple[str, ...]
    data_identity: str
    clips: int
    unreadable: tuple[str, ...]
    samples: int
    steps: int
    seed: int
    found: Calibration


def write_calibration(note: CalibrationNote, folder: Path) -> str:
    """Write `calibration.json`, `calibration.md` and `reliability.png`; gives the text.

    Raises: RunError if they cannot be written, RenderError without matplotlib.
    """
    text = calibration_text(note)
    write_whole(folder / "calibration.json", msgspec.json.format(msgspec.json.encode(note), indent=1))
    write_whole(folder / "calibration.md", text.encode())
    write_plot(note.found, folder / "reliability.png")
    return text


def calibration_text(note: CalibrationNote) -> str:
    """Markdown: one row for each kind of pixel."""
    found = note.found
    head = [f"{_percent(level)} interval holds | with the scale" for level in STATED]
    columns = ["pixels", *head, "mean absolute miscoverage | with the scale"]
    lines = [
        f"# Calibration of {note.weights}",
        "",
        f"Weights {note.sha256_12}, {note.samples} samples, steps {note.steps}, seed {note.seed}; {note.clips} clips "
        f"({note.data_identity}) of {_scenes(len(found.fitted) + len(found.reported))} in {', '.join(note.data)}.",
        "",
        f"**Scale {found.scale:.3g}**, chosen on {_scenes(len(found.fitted))}; the table is of the other "
        f"{len(found.reported)}.",
        "",
        *(f"{line}\n" for line in warnings(note)),
        f"| {' | '.join(columns)} |",
        "|" + " --- |" * (2 * len(STATED) + 3),
        *(_row(region, found.regions[region]) for region in found.regions),
        *(f"\nNot read: {told}" for told in note.unreadable),
    ]
    return "\n".join(lines) + "\n"


def warnings(note: CalibrationNote) -> tuple[str, ...]:
    """What the scale should not be trusted for, line by line."""
    scenes = len(note.found.fitted) + len(note.found.reported)
    if scenes >= FEW_SCENES:
        return ()
    return (f"Measured on {_scenes(scenes)}: of fewer than {FEW_SCENES} no claim can rest on this scale.",)


def stored_line(note: CalibrationNote, file: Path) -> str:
    """What a scale that was stored holds for; the file keeps the number alone."""
    return (
        f"{file} holds the scale {note.found.scale:.3g}: for {note.samples} samples in {note.steps} steps, and scenes "
        "like these; with other --samples it is wrong"
    )


def write_plot(found: Calibration, out: Path) -> None:
    """What intervals hold over what they are meant to hold, with the scale and without.

    Raises: RenderError without matplotlib.
    """
    from gcd_train.show.matplotlib_door import new_figure, save

    figure = new_figure(6.0, 5.6)
    axes = figure.add_axes((0.12, 0.11, 0.84, 0.8))
    axes.plot([0, 100], [0, 100], color="#999999", linewidth=1)
    levels = [100 * level for level in found.levels]
    for region, of in found.regions.items():
        colour = _COLOURS[region]
        axes.plot(
            levels, [100 * held for held in of.held], "--", color=colour, linewidth=1, label=f"{region}, as drawn"
        )
        scaled = [100 * held for held in of.held_scaled]
        axes.plot(levels, scaled, "o-", color=colour, markersize=3.5, label=f"{region}, times {found.scale:.3g}")
    axes.set(xlim=(0, 100), ylim=(0, 100), xlabel="interval is meant to hold, %", ylabel="held, % of colours")
    axes.set_title("How often the truth lies within the interval", fontsize=10.5)
    axes.grid(color="#eeeeee")
    axes.legend(fontsize=8, loc="upper left")
    save(figure, out)


def _row(region: Region, of: Reliability) -> str:
    cells: list[str] = [region]
    for level in STATED:
        place = LEVELS.index(level)
        cells += [_percent(of.held[place]), _percent(of.held_scaled[place])]
    return f"| {' | '.join([*cells, f'{of.miscoverage:.3f}', f'{of.miscoverage_scaled:.3f}'])} |"


def _scenes(count: int) -> str:
    return f"{count} scene" + "s" * (count != 1)


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"
