"""`gcd-node viewer`: the page for a running node, served from a process of its own."""

import os
import signal
import sys
import threading
import webbrowser
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
    """Serve the page for a running node; ends with Ctrl-C."""
    from gcd_node.viewer.feed import NodeEndpoints  # OpenCV and the server: the other quick commands need neither
    from gcd_node.viewer.server import ViewerServer

    ended = threading.Event()
    if ends_with_stdin:
        threading.Thread(target=lambda: (sys.stdin.buffer.read(), ended.set()), daemon=True).start()
    keys = client_keys(key_folder, node_key)
    node = NodeEndpoints(data=data, status=status, control=None if control == "none" else control, keys=keys)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: ended.set())
    with ViewerServer(http, node) as server:
        typer.echo(f"page {server.operator_url}", err=True)  # nowhere else is the token shown
        if show and any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")):
            webbrowser.open(server.operator_url)
        ended.wait()
