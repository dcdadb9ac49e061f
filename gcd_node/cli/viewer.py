"""`gcd-node viewer`: the page for a running node, served from a process of its own."""

import os
import signal
import sys
import threading
import webbrowser
from types import FrameType
from typing import Annotated, TypeAlias

import typer
from typer import Option

from gcd_node.cli.control import KeyFolder, NodeKey, client_keys

Http: TypeAlias = Annotated[str, Option(help="Where to serve the page: 127.0.0.1:PORT.")]
Data: TypeAlias = Annotated[str, Option(help="The node's data endpoint: ipc, ipc://PATH or tcp://HOST:PORT.")]
Status: TypeAlias = Annotated[str, Option(help="Its status endpoint.")]
Control: TypeAlias = Annotated[str, Option(help="Its control endpoint; none to look only.")]
Open: TypeAlias = Annotated[bool, Option("--open", help="Open the page in a browser, where there is a screen.")]
EndsWithStdin: TypeAlias = Annotated[bool, Option("--ends-with-stdin", hidden=True)]


def viewer(
    http: Http = "127.0.0.1:8470",
    data: Data = "ipc",
    status: Status = "ipc",
    control: Control = "ipc",
    key_folder: KeyFolder = None,
    node_key: NodeKey = None,
    show: Open = False,
    ends_with_stdin: EndsWithStdin = False,
) -> None:
    """Serve the page for a running node, which it reads as any client does; ends with Ctrl-C."""
    from gcd_node.viewer.node_link import NodeEndpoints  # OpenCV and the server: the other quick commands need neither
    from gcd_node.viewer.server import ViewerServer

    ended = threading.Event()

    def end(_number: int, _frame: FrameType | None) -> None:
        ended.set()

    def end_with_stdin() -> None:
        sys.stdin.buffer.read()
        ended.set()

    if ends_with_stdin:
        threading.Thread(target=end_with_stdin, daemon=True).start()
    keys = client_keys(key_folder, node_key)
    node = NodeEndpoints(data=data, status=status, control=None if control == "none" else control, keys=keys)
    previous = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with ViewerServer(http, node) as server:
            typer.echo(f"page {server.operator_url}", err=True)  # nowhere else is the token shown
            if show and any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")):
                webbrowser.open(server.operator_url)
            ended.wait()
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
