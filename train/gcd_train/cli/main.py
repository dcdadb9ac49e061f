"""`gcd-train`: data, training and evaluation from the command line."""

import sys
from collections.abc import Collection
from importlib import import_module

import typer

COMMANDS = {
    "augment": ("data:augment", "Write data sets with more cameras than filmed them."),
    "cache": ("data:cache", "Encode a driving set once, so that training never runs the frozen encoders again."),
    "calibrate": (
        "evaluate:calibrate_command",
        "Measure how often the truth lies within the intervals of the samples, and the scale that makes it as meant.",
    ),
    "data": ("data:data", "Downloaded data sets: repacking."),
    "evaluate": (
        "evaluate:evaluate_command",
        "Measure weights, baselines and others' frames on held-out clips, and say what is reached.",
    ),
    "export": ("data:export", "Write data in other programs' formats."),
    "figure": (
        "evaluate:figure_command",
        "Draw one figure of the paper from what was measured; nothing is measured again.",
    ),
    "gallery": (
        "look:gallery_command",
        "View real videos from other cameras: sheets, videos, and a page of them all. A bad video is one line.",
    ),
    "generate": ("generate:app", "Make training data with a procedural world (extra `scenes`)."),
    "lerobot": (
        "data:lerobot_command",
        "Read pairs of cameras of a LeRobot data set as training would, and say what was left out.",
    ),
    "lora": ("train:lora", "Adapters that a run with model.train = lora writes, and their bases."),
    "recipes": ("train:recipes", "List the recipes that ship, or show one whole: on its bases, with every default."),
    "report": (
        "evaluate:report_command",
        "Write the paper's tables, or the same for our own clips, from what was measured; nothing is measured again.",
    ),
    "show": ("look:show", "Contact sheet, video, camera path and facts of one clip of a scene (extra `train`)."),
    "train": (
        "train:train",
        "Train a model on clips, or go on where a run stopped. Ctrl-C stops after the update and saves.",
    ),
}
"""Where each command stands in this package, and what its help begins with: only the one that is asked for is imported,
as torch takes seconds."""


def new_app(loaded: Collection[str]) -> typer.Typer:
    """`gcd-train` with these commands, and of the others their names."""
    app = typer.Typer(
        no_args_is_help=True,
        rich_markup_mode="rich",
        help="Data, training and evaluation for virtual camera views.",
    )
    app.callback()(_several)
    for name, (place, summary) in COMMANDS.items():
        if name not in loaded:
            app.command(name, help=summary)(lambda: None)  # for the list of commands alone
            continue
        module, _, attribute = place.partition(":")
        command = getattr(import_module(f"gcd_train.cli.{module}"), attribute)
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name)
        else:
            app.command(name)(command)
    return app


def __getattr__(name: str) -> typer.Typer:
    """`app`: with every command."""
    if name != "app":
        raise AttributeError(name)
    return new_app(COMMANDS)


def _several() -> None:
    """It has sub-commands, however many there are."""


def main() -> None:
    """Entry point."""
    try:
        new_app([next((word for word in sys.argv[1:] if not word.startswith("-")), "")])()
    except SystemExit as end:
        sys.exit(64 if end.code == 2 else end.code)  # a wrong command line, as sysexits and gcd-node say it
