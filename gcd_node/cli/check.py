"""`gcd-node check`: looks at everything a launch file needs before anything is started."""

from pathlib import Path
from typing import Annotated, TypeAlias

import typer
from rich.console import Console
from rich.table import Table
from typer import Argument, Option

from gcd_model import printable
from gcd_node.check import Finding, check
from gcd_node.config import load_config
from gcd_node.config_dump import to_toml

ConfigPath: TypeAlias = Annotated[Path, Argument(metavar="CONFIG", help="A launch file, such as launch/demo.toml.")]
Changes: TypeAlias = Annotated[
    list[str] | None, Option("--set", metavar="KEY=VALUE", help="Change a setting, as model.steps=4. Again for more.")
]
PrintConfig: TypeAlias = Annotated[bool, Option("--print-config", help="Print the whole configuration, and end.")]

_STYLES = {"ok": "green", "warning": "yellow", "failed": "red"}


def check_launch(config: ConfigPath, changes: Changes = None, print_config: PrintConfig = False) -> None:
    """Look at endpoints, camera or recording, weights, memory, views and time of a launch file; loads no weights.

    Ends with what a start would fail with: 65 weights, 66 a recording, 69 no camera, 73 an endpoint, 78 a setting.
    """
    settings = load_config(config, changes or ())
    if print_config:
        typer.echo(to_toml(settings), nl=False)
        return
    with Console(stderr=True, markup=False).status("looking"):
        findings = list(check(settings))
    Console(markup=False).print(_table(findings))
    for finding in findings:
        if finding.error is not None:
            raise finding.error


def _table(findings: list[Finding]) -> Table:
    table = Table(show_header=False)
    for finding in findings:
        table.add_row(finding.topic, finding.verdict, printable(finding.detail, 4000), style=_STYLES[finding.verdict])
    return table
