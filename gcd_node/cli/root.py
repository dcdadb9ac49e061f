"""What all commands of `gcd-node` have in common."""

import logging
import sys
from typing import Annotated

import typer


def new_app() -> typer.Typer:
    """`gcd-node` without commands."""
    app = typer.Typer(
        no_args_is_help=True,
        rich_markup_mode="rich",
        pretty_exceptions_enable=False,
        help="Virtual camera views from one camera, live.\n\n"
        "Start with [bold]gcd-node demo[/bold]. Every pixel of a view is generated: never evidence of free space.",
    )
    app.callback()(setup)
    return app


def setup(
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log what happens, with times.")] = False,
) -> None:
    """Log to stderr, so that stdout stays for results."""
    line = "%(asctime)s %(levelname)s %(name)s: %(message)s" if verbose else "%(levelname)s: %(message)s"
    logging.basicConfig(level="INFO" if verbose else "WARNING", format=line, stream=sys.stderr, force=True)
