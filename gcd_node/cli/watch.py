"""`gcd-node view`, `status` and `viewer`: live tables of a running node's views and of how it does, and the page for
both. Needs no torch."""

import json
import math
import os
import signal
import sys
import threading
import time
import webbrowser
from collections import deque
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import typer
from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.styled import Styled
from rich.table import Table
from rich.text import Text
from typer import Argument, Option

from gcd_client.endpoints import resolve_endpoint
from gcd_client.protocol import MessageError, StatusMessage
from gcd_client.subscriber import ReceivedView, StatusSubscriber, ViewSubscriber
from gcd_node.cli.control import KeyFolder, NodeKey, client_keys
from gcd_node.errors import StaleError
from gcd_node.health import Level

STALE_AFTER_S = 3.0
"""A node publishes its status once a second; after so long without one, the last no longer holds."""

_REFRESH_MS = 250  # so that ages grow on the screen
_RATE_SPAN = 10
_EVENTS = 8
_LONGEST = 60
_STYLES = {Level.OK: "green", Level.WARN: "yellow", Level.ERROR: "bold red", Level.STALE: "magenta"}
_VIEW_STYLES = {"live": "green", "expired": "yellow", "ended": "dim"}
_TITLE = "Virtual views: generated pixels, never evidence of free space"
_SECTIONS = {
    "source": "state, fps FPS, last_frame_age_ms ms ago, reconnects reconnects, corrupt corrupt, dropped dropped",
    "window": "built built, rejected rejected, skipped skipped",
    "model": "state, ms_p50 ms p50, ms_p99 ms p99, gpu_mem_mb MB, oom_count out of memory, nan_windows NaN",
    "publish": "sent sent, subs subscribed, bytes B, dropped dropped",
    "rec": "state, file, bytes B",
}
"""What the status table shows: of each section its fields, each with what follows its value."""

Endpoint: TypeAlias = Annotated[str, Argument(metavar="ENDPOINT", help="ipc, ipc://PATH or tcp://HOST:PORT.")]
Status: TypeAlias = Annotated[str, Option("--status", help="Its status endpoint.")]
Control: TypeAlias = Annotated[str, Option(help="Its control endpoint; none to look only.")]


def view(
    endpoint: Endpoint = "ipc",
    name: Annotated[str | None, Option("--view", help="One view's id; else all.")] = None,
    kind: Annotated[
        Literal["win", "frm", "std", "cls", "vis", "depth", "all"],
        Option(help="Windows, frames at the goal pose, deviations, class maps, what was seen, depth, or all of these."),
    ] = "win",
    save: Annotated[Path | None, Option(help="Folder for PNG files and a lossless MKV per view.")] = None,
    hatch: Annotated[
        bool, Option("--hatch", help="Save windows with lines over their painted pixels; over all where nobody says.")
    ] = False,
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
    keys, console, table, damaged = client_keys(key_folder, node_key), Console(markup=False), ViewTable(), 0
    with ExitStack() as stack:
        saver = None
        if save is not None:
            from gcd_node.image_io import ViewSaver  # takes seconds, in which a subscriber would lose views

            saver = stack.enter_context(ViewSaver(save, hatch=hatch))
        views = stack.enter_context(ViewSubscriber(endpoint, name, kinds, conflate=False, keys=keys))
        live = stack.enter_context(Live(console=console, auto_refresh=False)) if console.is_terminal else None
        if live is None:  # the last picture of it, also after Ctrl-C
            stack.callback(lambda: console.print(table.render(time.monotonic(), ended=views.ended, endpoint=endpoint)))
        patience_s = math.inf if timeout is None else timeout
        until_s = time.monotonic() + patience_s
        while not (views.ended or views.received >= (limit or math.inf) or time.monotonic() >= until_s):
            received = views.receive(_REFRESH_MS)
            if received is not None:
                until_s = time.monotonic() + patience_s
                table.add(received, time.monotonic())
                try:
                    if saver is not None:
                        saver.add(received)
                except MessageError:  # its pixels
                    damaged += 1
            if live is not None:
                live.update(table.render(time.monotonic(), ended=views.ended, endpoint=endpoint), refresh=True)
    if timeout is not None and views.received == 0 and not views.ended:
        where = resolve_endpoint(endpoint, "data")
        raise StaleError(f"no view from {where} within {timeout:g} s: is the node running, and has it such a view?")
    ending = "the stream ended" if views.ended else "stopped"
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
    where, board, console = resolve_endpoint(endpoint, "status"), StatusBoard(timeout), Console()
    until_s = time.monotonic() + timeout
    with ExitStack() as stack:
        notes = stack.enter_context(StatusSubscriber(endpoint, keys=client_keys(key_folder, node_key)))
        live = None
        if console.is_terminal and not once and not as_json:
            live = stack.enter_context(Live(console=console, auto_refresh=False))
        while True:
            note = notes.receive(_REFRESH_MS)
            now_s = time.monotonic()
            if note is not None:
                board.add(note, now_s, time.time_ns())
            if once and board.stale(now_s):
                if now_s > until_s:
                    raise StaleError(_silence(board, now_s, where, timeout))
            elif as_json and once:
                typer.echo(json.dumps({"topic": "status", **board.record(now_s)}))
            elif as_json and note is not None:
                origin = {"node_id": note.header.node_id, "boot_id": note.header.boot_id}
                typer.echo(json.dumps({"topic": note.topic, **note.fields, **origin}))
            elif live is not None:
                live.update(board.render(now_s, where), refresh=True)
            elif not as_json and (once or (note is not None and note.topic == "status")):  # into a file or a pipe
                console.print(board.render(now_s, where))
            if once and not board.stale(now_s):
                return


def viewer(
    http: Annotated[str, Option(help="Where to serve the page: 127.0.0.1:PORT.")] = "127.0.0.1:8470",
    data: Annotated[str, Option(help="The node's data endpoint: ipc, ipc://PATH or tcp://HOST:PORT.")] = "ipc",
    status_endpoint: Status = "ipc",
    control: Control = "ipc",
    key_folder: KeyFolder = None,
    node_key: NodeKey = None,
    show: Annotated[bool, Option("--open", help="Open the page in a browser, where there is a screen.")] = False,
    ends_with_stdin: Annotated[bool, Option("--ends-with-stdin", hidden=True)] = False,
) -> None:
    """Serve the page for a running node; ends with Ctrl-C."""
    from gcd_node.viewer.feed import NodeEndpoints  # the server's libraries: the tables need none
    from gcd_node.viewer.server import ViewerServer

    ended, keys = threading.Event(), client_keys(key_folder, node_key)
    if ends_with_stdin:
        threading.Thread(target=lambda: (sys.stdin.buffer.read(), ended.set()), daemon=True).start()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: ended.set())
    control_endpoint = None if control == "none" else control
    node = NodeEndpoints(data=data, status=status_endpoint, control=control_endpoint, keys=keys)
    with ViewerServer(http, node) as server:
        typer.echo(f"page {server.operator_url}", err=True)  # nowhere else is the token shown
        if show and any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")):
            webbrowser.open(server.operator_url)
        ended.wait()


class ViewTable:
    """The newest message of each topic, and what it adds up to. Times are monotonic seconds, given by the caller."""

    def __init__(self) -> None:
        self._newest: dict[str, ReceivedView] = {}
        self._arrivals: dict[str, deque[float]] = {}
        self._missed: dict[str, int] = {}
        self._bytes: dict[str, int] = {}

    def add(self, view: ReceivedView, now_s: float) -> None:
        """A message that arrived now."""
        topic = view.message.topic
        self._newest[topic] = view
        self._arrivals.setdefault(topic, deque(maxlen=_RATE_SPAN)).append(now_s)
        self._missed[topic] = self._missed.get(topic, 0) + view.skipped
        self._bytes[topic] = self._bytes.get(topic, 0) + len(view.message.payload)

    def rows(self, now_s: float, *, ended: bool = False) -> list[tuple[str, ...]]:
        """By topic: window, shape, age in ms, messages a second, messages missed, MB received, and the state, with what
        lies outside the model's training."""
        rows: list[tuple[str, ...]] = []
        for topic, newest in sorted(self._newest.items()):
            header, arrivals = newest.header, self._arrivals[topic]
            since_ms = (now_s - arrivals[-1]) * 1000
            expired = newest.expired or since_ms > header.valid_for_ms
            span_s = arrivals[-1] - arrivals[0]
            rate_hz = (len(arrivals) - 1) / span_s if span_s > 0 else 0.0
            numbers = (f"{newest.age_ms + since_ms:.0f}", f"{rate_hz:.2f}", str(self._missed[topic]))
            shape, megabytes = "x".join(map(str, header.shape)), f"{self._bytes[topic] / 1e6:.1f}"
            state = "ended" if ended else "expired" if expired else "live"
            state = ", ".join((state, *header.quality.ood))
            rows.append((topic, str(header.window_id), shape, *numbers, megabytes, state))
        return rows

    def render(self, now_s: float, *, ended: bool = False, endpoint: str = "") -> Table | Text:
        """For rich. endpoint: named while nothing has come."""
        rows = self.rows(now_s, ended=ended)
        if not rows and not ended:
            return Text(f"no view yet from {_shown(resolve_endpoint(endpoint, 'data'))}: is the node running?")
        table = Table(title=_TITLE, title_style="dim", box=box.SIMPLE_HEAD, show_edge=False, min_width=len(_TITLE))
        table.padding = (0, 1, 0, 0)
        for name in ("topic", "window", "shape", "age ms", "rate Hz", "missed", "MB", "state"):
            left = name in ("topic", "state")
            table.add_column(
                name, justify="left" if left else "right", no_wrap=name not in ("topic", "state"), overflow="fold"
            )
        for row in rows:
            table.add_row(*row[:-1], Text(row[-1], style=_VIEW_STYLES.get(row[-1], "yellow")))
        return table


class StatusBoard:
    """The last status and the latest events of one node. Times are monotonic seconds, given by the caller. What a note
    holds was written by others: fields may be missing or of any type."""

    def __init__(self, stale_after_s: float = STALE_AFTER_S) -> None:
        self._stale_after_s, self._heard_s, self._boot_id = stale_after_s, 0.0, ""
        self._status: StatusMessage | None = None
        self._events: deque[tuple[float, Mapping[str, Any]]] = deque(maxlen=_EVENTS)
        self.restarts = 0

    def add(self, note: StatusMessage, now_s: float, wall_ns: int) -> None:
        """A note arrived. wall_ns: the wall clock now; the first status may be one that was kept for late readers, and
        is as old as its stamp says."""
        if self._boot_id not in ("", note.header.boot_id):
            self._status, self.restarts = None, self.restarts + 1
        self._boot_id = note.header.boot_id
        if note.topic == "status":
            kept_s = 0.0 if self._status is not None else max(0.0, (wall_ns - note.header.t_publish_ns) / 1e9)
            self._status, self._heard_s = note, now_s - kept_s
        elif note.topic == "event":
            self._events.append((now_s, note.fields))

    def silent_s(self, now_s: float) -> float | None:
        """Since the last status; None before the first."""
        return None if self._status is None else max(0.0, now_s - self._heard_s)

    def stale(self, now_s: float) -> bool:
        """Whether the node has been silent for too long, or was never heard."""
        silent_s = self.silent_s(now_s)
        return silent_s is None or silent_s > self._stale_after_s

    def level(self, now_s: float) -> Level:
        """As the node said, or STALE."""
        return Level.STALE if self._status is None or self.stale(now_s) else _level(self._status.fields.get("level"))

    def record(self, now_s: float) -> dict[str, Any]:
        """The last status for a program: as it came, with the node's name, its age in ms, and STALE where it is."""
        now = {"level": int(self.level(now_s)), "stale": self.stale(now_s)}
        if self._status is None:
            return now
        header, age_ms = self._status.header, round(1000 * (self.silent_s(now_s) or 0.0))
        return {**self._status.fields, "node_id": header.node_id, "boot_id": header.boot_id, "age_ms": age_ms, **now}

    def render(self, now_s: float, endpoint: str = "") -> Group:
        """For rich: a headline, the sections, the stages and the latest events; dim where they no longer hold.
        endpoint: named while nothing has come."""
        fields = {} if self._status is None else self._status.fields
        parts = [_sections(fields), *([_stages(stages)] if (stages := _mapping(fields.get("stages"))) else [])]
        if self._events:
            parts.append(self._event_table(now_s))
        dim = "dim" if self.stale(now_s) else ""
        return Group(self._headline(now_s, endpoint), *(Styled(part, dim) for part in parts if part.row_count))

    def _headline(self, now_s: float, endpoint: str) -> Text:
        level = self.level(now_s)
        line = Text.assemble((f" {level.name} ", f"reverse {_STYLES[level]}"))
        if self._status is None:
            where = f" from {_shown(endpoint)}" if endpoint else ""
            return line.append(f" no status yet{where}: is the node running?")
        fields = self._status.fields
        state, reasons = _shown(fields.get("state", "?")), _shown(", ".join(_codes(fields.get("reasons"))))
        line.append(f" {_shown(self._status.header.node_id)}", style="bold")
        if self.stale(now_s):
            line.append(f"  silent for {self.silent_s(now_s) or 0.0:.0f} s", style=_STYLES[level])
            line.append(f"  before: {state}{f', {reasons}' if reasons else ''}", style="dim")
        else:
            missing = _shown(", ".join(_codes(fields.get("not_ready"))))
            line.append(f"  {state}")
            line.append("  ready" if fields.get("ready") is True else f"  not ready: {missing}", style="dim")
            line.append(f"  {reasons}" if reasons else "", style=_STYLES[level])
        return line.append(f"  restarted {self.restarts} times" if self.restarts else "", style="dim")

    def _event_table(self, now_s: float) -> Table:
        table = Table.grid(padding=(0, 2))
        for heard_s, fields in reversed(self._events):
            code, style = _shown(fields.get("code", "?")), _STYLES[_level(fields.get("level"))]
            details = {key: value for key, value in fields.items() if key not in ("code", "level")}
            table.add_row(Text(f"{now_s - heard_s:.0f} s ago", style="dim"), Text(code, style=style), _pairs(details))
        return table


def _silence(board: StatusBoard, now_s: float, where: str, timeout_s: float) -> str:
    silent_s = board.silent_s(now_s)
    last = "" if silent_s is None else f"; its last one is {silent_s:.0f} s old"
    question = "is the node running, and is this the status endpoint of its [publish]?"
    return f"no status from {where} within {timeout_s:g} s{last}: {question}"


def _sections(fields: Mapping[str, Any]) -> Table:
    table = Table.grid(padding=(0, 2))
    for name, columns in _SECTIONS.items():
        section, keys = _mapping(fields.get(name)), (column.partition(" ") for column in columns.split(", "))
        shown = [f"{_shown(section[key])}{space}{unit}" for key, space, unit in keys if section.get(key) is not None]
        if shown:
            table.add_row(Text(name, style="bold"), Text(", ".join(shown)))
    last_ms = {name: _mapping(view).get("last_ms") for name, view in _mapping(fields.get("views")).items()}
    views = {name: "never" if ms is None else f"{_shown(ms)} ms ago" for name, ms in last_ms.items()}
    faults = _mapping(_mapping(fields.get("window")).get("reason_counts"))
    for name, pairs in (("faults", faults), ("views", views), ("drops", _mapping(fields.get("drops")))):
        if pairs:
            table.add_row(Text(name, style="bold"), _pairs(pairs))
    return table


def _stages(stages: Mapping[str, Any]) -> Table:
    table = Table(title="how long each stage takes, last minute", title_style="dim", title_justify="left")
    for name in ("stage", "p50 ms", "p99 ms", "count"):
        table.add_column(name, justify="left" if name == "stage" else "right", no_wrap=True)
    for name, stage in stages.items():
        figures = (_mapping(stage).get(key, "-") for key in ("p50_ms", "p99_ms", "count"))
        table.add_row(Text(_shown(name)), *(Text(_shown(figure)) for figure in figures))
    return table


def _pairs(pairs: Mapping[str, Any]) -> Text:
    return Text(", ".join(f"{_shown(key)} {_shown(value)}" for key, value in pairs.items()))


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _codes(value: object) -> list[str]:
    return [each for each in value if isinstance(each, str)] if isinstance(value, list) else []


def _level(value: object) -> Level:
    """A level as a node wrote it; anything else counts as an error."""
    try:
        return Level(value)  # pyright: ignore[reportArgumentType]  whatever came
    except ValueError:
        return Level.ERROR


def _shown(value: object) -> str:
    """A foreign value on one line: no control characters, not too long."""
    text = f"{value:.1f}" if isinstance(value, float) else str(value)
    text = "".join(char if char.isprintable() else "?" for char in text)
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."
