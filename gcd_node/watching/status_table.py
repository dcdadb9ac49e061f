"""Watches a node's status socket and draws what it says. What `gcd-node status` does between its options and its
screen; nothing here prints."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from rich.console import Group
from rich.styled import Styled
from rich.table import Table
from rich.text import Text

from gcd_client.endpoints import ClientKeys, resolve_endpoint
from gcd_client.protocol import StatusMessage
from gcd_client.subscriber import StatusSubscriber
from gcd_node.errors import StaleError
from gcd_node.health import Level
from gcd_node.watching.status_board import STALE_AFTER_S, StatusBoard

_REFRESH_MS = 250
_LONGEST = 60
_STYLES = {Level.OK: "green", Level.WARN: "yellow", Level.ERROR: "bold red", Level.STALE: "magenta"}

_SECTIONS: tuple[tuple[str, tuple[tuple[str, str], ...]], ...] = (
    (
        "source",
        (
            ("state", ""),
            ("fps", " FPS"),
            ("last_frame_age_ms", " ms ago"),
            ("reconnects", " reconnects"),
            ("corrupt", " corrupt"),
            ("dropped", " dropped"),
        ),
    ),
    ("window", (("built", " built"), ("rejected", " rejected"), ("skipped", " skipped"))),
    (
        "model",
        (
            ("state", ""),
            ("ms_p50", " ms p50"),
            ("ms_p99", " ms p99"),
            ("gpu_mem_mb", " MB"),
            ("oom_count", " out of memory"),
            ("nan_windows", " NaN"),
        ),
    ),
    ("publish", (("sent", " sent"), ("subs", " subscribed"), ("bytes", " B"), ("dropped", " dropped"))),
    ("rec", (("state", ""), ("file", ""), ("bytes", " B"))),
)


@dataclass(frozen=True, kw_only=True, slots=True)
class StatusRequest:
    """What to watch. once: end with the first status. timeout_s: a node silent for so long is stale. keys: for a node
    that asks for them."""

    endpoint: str = "ipc"
    once: bool = False
    timeout_s: float = STALE_AFTER_S
    keys: ClientKeys | None = None


def watch_status(
    request: StatusRequest, on_change: Callable[[StatusBoard], None], on_note: Callable[[StatusMessage], None]
) -> None:
    """Receive notes, for ever or until the first fresh status; `on_note` gets each, `on_change` the board after each
    and four times a second in between, so that ages grow on the screen.

    Raises:
        SetupError: no such endpoint. StaleError: `once`, and no status came in time. AuthError: the node does not
            let us in.
    """
    board = StatusBoard(request.timeout_s)
    until_s = time.monotonic() + request.timeout_s
    with StatusSubscriber(request.endpoint, keys=request.keys) as notes:
        while True:
            note = notes.receive(_REFRESH_MS)
            now_s = time.monotonic()
            if note is not None:
                board.add(note, now_s, time.time_ns())
                on_note(note)
            if not request.once:
                on_change(board)
            elif not board.stale(now_s):
                on_change(board)
                return
            elif now_s > until_s:
                raise StaleError(_silence(request, board, now_s))


def render_status(board: StatusBoard, now_s: float, endpoint: str = "") -> Group:
    """The board for rich: a headline, the sections, the stages and the latest events; dim where it no longer holds.

    endpoint: named while nothing has come.
    """
    parts: list[Text | Table] = [_headline(board, now_s, endpoint)]
    if board.known:
        parts.append(_sections(board))
    if stages := board.section("stages"):
        parts.append(_stages(stages))
    if board.events:
        parts.append(_events(board, now_s))
    stale = "dim" if board.stale(now_s) else ""
    return Group(parts[0], *(Styled(part, stale) for part in parts[1:]))


def _silence(request: StatusRequest, board: StatusBoard, now_s: float) -> str:
    silent_s = board.silent_s(now_s)
    last = "" if silent_s is None else f"; its last one is {silent_s:.0f} s old"
    endpoint = resolve_endpoint(request.endpoint, "status")
    return (
        f"no status from {endpoint} within {request.timeout_s:g} s{last}: is the node running, and is this "
        "the status endpoint of its [publish]?"
    )


def _headline(board: StatusBoard, now_s: float, endpoint: str) -> Text:
    level = board.level(now_s)
    line = Text()
    line.append(f" {level.name} ", style=f"reverse {_STYLES[level]}")
    if not board.known:
        where = f" from {_shown(endpoint)}" if endpoint else ""
        return line.append(f" no status yet{where}: is the node running?")
    line.append(f" {_shown(board.node_id)}", style="bold")
    state, ready = _shown(board.fields.get("state", "?")), board.fields.get("ready") is True
    reasons = _shown(", ".join(board.reasons()))
    if board.stale(now_s):
        line.append(f"  silent for {board.silent_s(now_s) or 0.0:.0f} s", style=_STYLES[level])
        line.append(f"  before: {state}{f', {reasons}' if reasons else ''}", style="dim")
    else:
        line.append(f"  {state}")
        line.append("  ready" if ready else f"  not ready: {_shown(', '.join(board.missing()))}", style="dim")
        line.append(f"  {reasons}" if reasons else "", style=_STYLES[level])
    if board.restarts:
        line.append(f"  restarted {board.restarts} times", style="dim")
    return line


def _sections(board: StatusBoard) -> Table:
    table = Table.grid(padding=(0, 2))
    for name, columns in _SECTIONS:
        section = board.section(name)
        shown = [f"{_shown(section[key])}{unit}" for key, unit in columns if section.get(key) is not None]
        if shown:
            table.add_row(Text(name, style="bold"), Text(", ".join(shown)))
    faults = board.section("window").get("reason_counts")
    if isinstance(faults, Mapping) and faults:
        counts = ", ".join(f"{_shown(code)} {_shown(count)}" for code, count in faults.items())
        table.add_row(Text("faults", style="bold"), Text(counts))
    if views := board.section("views"):
        table.add_row(Text("views", style="bold"), Text(", ".join(_view(name, each) for name, each in views.items())))
    if drops := board.section("drops"):
        shown = [f"{_shown(hop)} {_shown(count)}" for hop, count in drops.items()]
        table.add_row(Text("drops", style="bold"), Text(", ".join(shown)))
    return table


def _view(name: str, told: object) -> str:
    last = told.get("last_ms") if isinstance(told, Mapping) else None
    return f"{_shown(name)} {'never' if last is None else _shown(last) + ' ms ago'}"


def _stages(stages: Mapping[str, Any]) -> Table:
    table = Table(title="how long each stage takes, last minute", title_style="dim", title_justify="left")
    for name in ("stage", "p50 ms", "p99 ms", "count"):
        table.add_column(name, justify="left" if name == "stage" else "right", no_wrap=True)
    for name, stage in stages.items():
        told = stage if isinstance(stage, Mapping) else {}
        table.add_row(Text(_shown(name)), *(Text(_shown(told.get(key, "-"))) for key in ("p50_ms", "p99_ms", "count")))
    return table


def _events(board: StatusBoard, now_s: float) -> Table:
    table = Table.grid(padding=(0, 2))
    for event in reversed(board.events):
        details = ", ".join(f"{_shown(key)} {_shown(value)}" for key, value in event.details.items())
        ago = Text(f"{now_s - event.heard_s:.0f} s ago", style="dim")
        table.add_row(ago, Text(_shown(event.code), style=_STYLES[event.level]), Text(details))
    return table


def _shown(value: object) -> str:
    """A foreign value on one line: no control characters, not too long."""
    text = f"{value:.1f}" if isinstance(value, float) else str(value)
    text = "".join(char if char.isprintable() else "?" for char in text)
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."
