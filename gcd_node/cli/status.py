"""`gcd-node status`: how a running node does."""

import json
import time
from typing import Annotated, TypeAlias

from rich.console import Console
from rich.live import Live
from typer import Argument, Option

from gcd_client.endpoints import resolve_endpoint
from gcd_client.protocol import StatusMessage
from gcd_node.cli.control import KeyFolder, NodeKey, client_keys
from gcd_node.watching.status_board import STALE_AFTER_S, StatusBoard
from gcd_node.watching.status_table import StatusRequest, render_status, watch_status

Endpoint: TypeAlias = Annotated[str, Argument(metavar="ENDPOINT", help="ipc, ipc://PATH or tcp://HOST:PORT.")]
Once: TypeAlias = Annotated[bool, Option("--once", help="Print one status and end; 69 if none comes.")]
AsJson: TypeAlias = Annotated[bool, Option("--json", help="One JSON object a line, for programs.")]
Timeout: TypeAlias = Annotated[float, Option(min=0.1, help="A node silent for so many seconds is stale.")]


def status(
    endpoint: Endpoint = "ipc",
    once: Once = False,
    as_json: AsJson = False,
    timeout: Timeout = STALE_AFTER_S,
    key_folder: KeyFolder = None,
    node_key: NodeKey = None,
) -> None:
    """Watch how a node does: states, rates, ages, drops, stage times and events.

    The live table ends with Ctrl-C. With --json each status, event and meta note is a line of its own.
    """
    keys = client_keys(key_folder, node_key)
    request = StatusRequest(endpoint=endpoint, once=once, timeout_s=timeout, keys=keys)
    if as_json:
        _print_json(request)
    elif once:
        watch_status(request, _print_table, _ignore)
    else:
        _show_live(request)


def _print_json(request: StatusRequest) -> None:
    """Statuses as the board knows them (with their age), other notes as they came."""
    console = Console(soft_wrap=True, highlight=False, markup=False, emoji=False)

    def line(topic: str, told: dict[str, object]) -> None:
        console.out(json.dumps({"topic": topic, **told}), highlight=False)

    def one(board: StatusBoard) -> None:
        line("status", board.record(time.monotonic()))

    def note(message: StatusMessage) -> None:
        header = message.header
        line(message.topic, {**message.fields, "node_id": header.node_id, "boot_id": header.boot_id})

    if request.once:
        watch_status(request, one, _ignore)
    else:
        watch_status(request, lambda _: None, note)


def _print_table(board: StatusBoard) -> None:
    Console().print(render_status(board, time.monotonic()))


def _show_live(request: StatusRequest) -> None:
    """Over itself on a terminal; into a file or a pipe, where nothing can be taken back, one table a status."""
    console = Console()
    if not console.is_terminal:
        printed: list[object] = [None]

        def append(board: StatusBoard) -> None:
            if board.known and board.fields is not printed[0]:
                printed[0] = board.fields
                console.print(render_status(board, time.monotonic()))

        watch_status(request, append, _ignore)
        return
    endpoint = resolve_endpoint(request.endpoint, "status")
    with Live(console=console, auto_refresh=False) as live:

        def show(board: StatusBoard) -> None:
            live.update(render_status(board, time.monotonic(), endpoint), refresh=True)

        watch_status(request, show, _ignore)


def _ignore(_: StatusMessage) -> None:
    """The board has it already."""
