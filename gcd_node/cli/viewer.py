"""`gcd-node viewer`: the page for a node that runs in another process; and how any page's address is told."""

import os
import signal
import threading
import webbrowser
from types import FrameType
from typing import Annotated, TypeAlias

from rich.console import Console
from typer import Option

from gcd_node.cli.control import KeyFolder, NodeKey, client_keys
from gcd_node.viewer.hub import NodeEndpoints
from gcd_node.viewer.server import ViewerOptions, ViewerServer

Http: TypeAlias = Annotated[str, Option(help="Where to serve the page: 127.0.0.1:PORT.")]
Data: TypeAlias = Annotated[str, Option(help="The node's data endpoint: ipc, ipc://PATH or tcp://HOST:PORT.")]
Status: TypeAlias = Annotated[str, Option(help="Its status endpoint.")]
Control: TypeAlias = Annotated[str, Option(help="Its control endpoint.")]


def viewer(
    http: Http = "127.0.0.1:8470",
    data: Data = "ipc",
    status: Status = "ipc",
    control: Control = "ipc",
    key_folder: KeyFolder = None,
    node_key: NodeKey = None,
) -> None:
    """Serve the page for a running node, from a process of its own; ends with Ctrl-C."""
    keys = client_keys(key_folder, node_key)
    node = NodeEndpoints(data=data, status=status, control=control, keys=keys)
    ended = threading.Event()

    def end(_number: int, _frame: FrameType | None) -> None:
        ended.set()

    previous = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with ViewerServer(ViewerOptions(http=http, node=node)) as server:
            tell_page(Console(stderr=True), server.operator_url)
            ended.wait()
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def tell_page(console: Console, url: str) -> None:
    """The one place where the token is shown; without it, whoever has the rest of the address may look."""
    console.print(f"page {url}", soft_wrap=True, highlight=False, markup=False)


def show_page(url: str) -> None:
    """Open a page where there is a screen; a browser in the terminal would only take the terminal away."""
    if any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")):
        webbrowser.open(url)
