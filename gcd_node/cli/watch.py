"""`gcd-node view`, `status` and `viewer`: live tables of a running node's views and of how it does, and the page for
both. Needs no torch."""

import json
import math
import os
import time
import webbrowser
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import typer
from rich.console import Console, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text
from typer import Argument, Option

from gcd_client.endpoints import resolve_endpoint
from gcd_client.protocol import MessageError, StatusMessage
from gcd_client.subscriber import ReceivedView, StatusSubscriber, ViewSubscriber
from gcd_node.cli.control import KeyFolder, NodeKey, client_keys
from gcd_node.cli.main import table
from gcd_node.errors import StaleError
from gcd_node.health import Level

STALE_AFTER_S = 3.0
"""A node publishes its status once a second; after so long without one, the last no longer holds."""

_REFRESH_MS = 250  # so that ages grow on the screen
_RATE_SPAN = 10
_EVENTS = 8
_LONGEST = 60
_STYLES = {Level.OK: "green", Level.WARN: "yellow", Level.ERROR: "bold red", Level.STALE: "magenta"}
_TITLE = "Virtual views: generated pixels, never evidence of free space"

Endpoint: TypeAlias = Annotated[str, Argument(metavar="ENDPOINT", help="ipc, ipc://PATH or tcp://HOST:PORT.")]


def view(
    endpoint: Endpoint = "ipc",
    name: Annotated[str | None, Option("--view", help="One view's id; else all.")] = None,
    kind: Annotated[
        Literal["win", "frm", "std", "cls", "vis", "depth", "all"],
        Option(help="Windows, frames at the goal pose, deviations, class maps, what was seen, depth, or all of these."),
    ] = "win",
    save: Annotated[Path | None, Option(help="Folder for PNG files and a lossless MKV per view.")] = None,
    hatch: Annotated[bool, Option("--hatch", help="Save windows also with lines over their painted pixels.")] = False,
    limit: Annotated[int | None, Option(min=1, help="End after so many messages.")] = None,
    timeout: Annotated[
        float | None, Option(help="End when nothing came for so many seconds; 69 if nothing ever did.")
    ] = None,
    key_folder: KeyFolder = None,
    node_key: NodeKey = None,
) -> None:
    """Watch the views of a node: a live table, and with --save pictures on disk."""
    if hatch and kind not in ("win", "all"):
        raise typer.BadParameter("--hatch is for windows: --kind win or all")
    kinds = None if kind == "all" else ("win", "vis") if hatch else kind
    where, shown, damaged, saver = resolve_endpoint(endpoint, "data"), ViewTable(), 0, None
    console, patience_s = Console(markup=False), math.inf if timeout is None else timeout
    with ExitStack() as stack:
        if save is not None:
            from gcd_node.image_io import ViewSaver  # takes seconds, in which a subscriber would lose views

            saver = stack.enter_context(closing(ViewSaver(save, hatch=hatch)))
        keys = client_keys(key_folder, node_key)
        views = stack.enter_context(ViewSubscriber(endpoint, name, kinds, conflate=False, keys=keys))
        live = stack.enter_context(_live(console, lambda: shown.render(where, ended=views.ended)))
        until_s = time.monotonic() + patience_s
        while not (views.ended or views.received >= (limit or math.inf) or time.monotonic() >= until_s):
            received = views.receive(_REFRESH_MS)
            if received is not None:
                until_s = time.monotonic() + patience_s
                shown.add(received, time.monotonic())
                try:
                    if saver is not None:
                        saver.add(received)
                except MessageError:  # its pixels
                    damaged += 1
            live.refresh()
    if timeout is not None and views.received == 0 and not views.ended:
        raise StaleError(f"no view from {where} within {timeout:g} s: is the node running, and has it such a view?")
    ending = "the stream ended" if views.ended else "at --limit" if views.received == limit else "nothing more came"
    files = 0 if saver is None else saver.files
    console.print(f"{views.received} messages, {files} files, {damaged + views.damaged} damaged; {ending}")


def status(
    endpoint: Endpoint = "ipc",
    once: Annotated[bool, Option("--once", help="Print one status and end; 69 if none comes.")] = False,
    as_json: Annotated[bool, Option("--json", help="One JSON object a line, for programs.")] = False,
    timeout: Annotated[
        float, Option("--timeout", min=0.1, help="A node silent for so many seconds is stale.")
    ] = STALE_AFTER_S,
    key_folder: KeyFolder = None,
    node_key: NodeKey = None,
) -> None:
    """Watch how a node does: states, rates, ages, drops, stage times and events.

    The live table ends with Ctrl-C. With --json each status, event and meta note is a line of its own.
    """
    where, board, console = resolve_endpoint(endpoint, "status"), StatusBoard(timeout), Console(markup=False)
    until_s = time.monotonic() + timeout
    with ExitStack() as stack:
        notes = stack.enter_context(StatusSubscriber(endpoint, keys=client_keys(key_folder, node_key)))
        live = None
        if not once and not as_json:
            live = stack.enter_context(_live(console, lambda: board.render(time.monotonic(), where)))
        while not once or board.stale(time.monotonic()):
            note = notes.receive(_REFRESH_MS)
            if note is not None:
                board.add(note, time.monotonic(), time.time_ns())
            if live is not None:
                live.refresh()
            elif once and time.monotonic() > until_s and board.stale(time.monotonic()):
                question = "is the node running, and is this the status endpoint of its [publish]?"
                raise StaleError(f"no status from {where} within {timeout:g} s: {question}")
            elif not once and note is not None:
                origin = {"node_id": note.header.node_id, "boot_id": note.header.boot_id}
                typer.echo(json.dumps({"topic": note.topic, **note.fields, **origin}))
    if as_json:
        typer.echo(json.dumps({"topic": "status", **board.record(time.monotonic())}))
    else:
        console.print(board.render(time.monotonic(), where))


def _live(console: Console, draw: Callable[[], RenderableType]) -> Live:
    """Drawn anew at every refresh(); into a file or a pipe once, at the end."""
    return Live(get_renderable=draw, console=console, auto_refresh=False)


def viewer(
    http: Annotated[str, Option(help="Where to serve the page: 127.0.0.1:PORT.")] = "127.0.0.1:8470",
    data: Annotated[str, Option(help="The node's data endpoint: ipc, ipc://PATH or tcp://HOST:PORT.")] = "ipc",
    status_endpoint: Annotated[str, Option("--status", help="Its status endpoint.")] = "ipc",
    control: Annotated[str, Option(help="Its control endpoint; none to look only.")] = "ipc",
    key_folder: KeyFolder = None,
    node_key: NodeKey = None,
    show: Annotated[bool, Option("--open", help="Open the page in a browser, where there is a screen.")] = False,
    ends_with_stdin: Annotated[bool, Option("--ends-with-stdin", hidden=True)] = False,
) -> None:
    """Serve the page for a running node; ends with Ctrl-C."""
    from gcd_node.viewer.feed import NodeEndpoints  # the server's libraries: the tables need none
    from gcd_node.viewer.server import ViewerServer

    commands, keys = None if control == "none" else control, client_keys(key_folder, node_key)
    server = ViewerServer(http, NodeEndpoints(data=data, status=status_endpoint, control=commands, keys=keys))
    typer.echo(f"page {server.operator_url}", err=True)  # nowhere else is the token shown
    if show and any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")):
        webbrowser.open(server.operator_url)
    server.run(ends_with_stdin=ends_with_stdin)


class ViewTable:
    """The newest message of each topic, and what it adds up to. Times are monotonic seconds, given by the caller."""

    def __init__(self) -> None:
        self._newest: dict[str, ReceivedView] = {}
        self._arrivals: dict[str, deque[float]] = {}
        self._missed: Counter[str] = Counter()

    def add(self, view: ReceivedView, now_s: float) -> None:
        """A message that arrived now."""
        topic = view.message.topic
        self._newest[topic] = view
        self._arrivals.setdefault(topic, deque(maxlen=_RATE_SPAN)).append(now_s)
        self._missed[topic] += view.skipped

    def rows(self, now_s: float, *, ended: bool) -> Iterator[tuple[str, ...]]:
        """By topic: window, shape, age in ms, messages a second, messages missed, and the state, with what lies outside
        the model's training."""
        for topic, newest in sorted(self._newest.items()):
            header, arrivals = newest.header, self._arrivals[topic]
            since_ms, span_s = 1000 * (now_s - arrivals[-1]), arrivals[-1] - arrivals[0]
            rate_hz = (len(arrivals) - 1) / span_s if span_s > 0 else 0.0
            expired = newest.expired or since_ms > header.valid_for_ms
            state = "ended" if ended else "expired" if expired else "live"
            shape, age = "x".join(map(str, header.shape)), f"{newest.age_ms + since_ms:.0f}"
            figures = (age, f"{rate_hz:.2f}", str(self._missed[topic]))
            yield topic, str(header.window_id), shape, *figures, ", ".join((state, *header.quality.ood))

    def render(self, where: str, *, ended: bool) -> Table | Text:
        """For rich. where: the endpoint, named while nothing has come."""
        if not self._newest and not ended:
            return Text(f"no view yet from {_shown(where)}: is the node running, and has it such a view?")
        columns = ("topic", ">window", ">shape", ">age ms", ">rate Hz", ">missed", "state")
        return table(self.rows(time.monotonic(), ended=ended), columns, _TITLE)


class StatusBoard:
    """The last status and the latest events of one node. Times are monotonic seconds, given by the caller. What a note
    holds was written by others: fields may be missing or of any type."""

    def __init__(self, stale_after_s: float = STALE_AFTER_S) -> None:
        self._stale_after_s, self._heard_s = stale_after_s, 0.0
        self._status: StatusMessage | None = None
        self._events: deque[tuple[float, Mapping[str, Any]]] = deque(maxlen=_EVENTS)

    def add(self, note: StatusMessage, now_s: float, wall_ns: int) -> None:
        """A note arrived. wall_ns: the wall clock now; the first status may be one that was kept for late readers, and
        is as old as its stamp says."""
        if note.topic == "status":
            kept_s = 0.0 if self._status is not None else max(0.0, (wall_ns - note.header.t_publish_ns) / 1e9)
            self._status, self._heard_s = note, now_s - kept_s
        elif note.topic == "event":
            self._events.append((now_s, note.fields))

    def stale(self, now_s: float) -> bool:
        """Whether the node has been silent for too long, or was never heard."""
        return self._status is None or now_s - self._heard_s > self._stale_after_s

    def level(self, now_s: float) -> Level:
        """As the node said, anything else than a level counting as an error; or STALE."""
        if self._status is None or self.stale(now_s):
            return Level.STALE
        told = self._status.fields.get("level")
        return Level(told) if told in tuple(Level) else Level.ERROR

    def record(self, now_s: float) -> dict[str, Any]:
        """The last status for a program: as it came, with the node's name, its age in ms, and STALE where it is."""
        now = {"level": int(self.level(now_s)), "stale": self.stale(now_s)}
        if self._status is None:
            return now
        header, age_ms = self._status.header, round(1000 * (now_s - self._heard_s))
        return {**self._status.fields, "node_id": header.node_id, "boot_id": header.boot_id, "age_ms": age_ms, **now}

    def render(self, now_s: float, where: str = "") -> Table:
        """For rich: the level, every field of the status under its name, and the latest events. where: the endpoint,
        named while nothing has come."""
        level, rows = self.level(now_s), [("", f"no status yet from {_shown(where)}: is the node running?")]
        if self._status is not None:
            silence = f"  silent for {now_s - self._heard_s:.0f} s" if self.stale(now_s) else ""
            rows = [(level.name, _shown(self._status.header.node_id) + silence), *_facts(self._status.fields)]
        rows += [(f"{now_s - heard_s:.0f} s ago", _pairs(fields)) for heard_s, fields in reversed(self._events)]
        shown = table(rows)
        shown.rows[0].style = _STYLES[level]
        return shown


def _facts(fields: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """A line for the plain values of a mapping, and lines of their own for each mapping in it."""
    pending = [("", fields)]
    for name, mapping in pending:
        nested = {key: value for key, value in mapping.items() if isinstance(value, Mapping)}
        pending += ((f"{name} {key}".strip(), value) for key, value in nested.items())
        if text := _pairs({key: value for key, value in mapping.items() if key not in nested}):
            yield _shown(name or "node"), text


def _pairs(pairs: Mapping[str, Any]) -> str:
    return ", ".join(f"{_shown(key)} {_shown(value)}" for key, value in pairs.items() if value not in (None, []))


def _shown(value: object) -> str:
    """A foreign value on one line: no control characters, not too long."""
    text = " ".join(map(str, value)) if isinstance(value, list) else str(value)
    text = "".join(char if char.isprintable() else "?" for char in text)
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."
