"""A whole node over real sockets in a folder of its own: its cameras and its model do what a test tells them."""

import contextlib
import gc
import socket
import threading
from collections.abc import Callable, Generator, Iterator, Mapping
from pathlib import Path
from typing import Any

from cameras import Bench, until
from fakes import FakeSynthesizer, traits

from gcd_client.control import ControlClient, Reply
from gcd_client.subscriber import ReceivedView, StatusSubscriber, ViewSubscriber
from gcd_model import ViewSynthesizer
from gcd_node.config import ModelSection, NodeConfig, parse_config
from gcd_node.frame import FrameSource
from gcd_node.lifecycle import Parts
from gcd_node.pipeline import Summary
from gcd_node.service import ServiceManager
from gcd_node.session import open_session
from gcd_node.sources import SourceConfig

CAMERA = 'kind = "v4l2"'
_LOOK_MS, _SILENT_LOOKS = 50, 6
"""How long a reader waits for more, and how often in vain once the node is done: once, after a last word."""


def rig_config(folder: Path, source: str, views: str, more: str) -> NodeConfig:
    text = f"""
        {more}
        [source]
        {source}
        [model]
        weights = "fake"
        {views}
    """
    endpoints = [f"{name}=ipc://{folder}/{name.split('.')[-1]}" for name in ("publish.data", "publish.status")]
    return parse_config(text.encode(), "test", [*endpoints, f"control.endpoint=ipc://{folder}/control"])


def launch_file(folder: Path, source: str, *, weights: str = "random:driving", more: str = "") -> Path:
    """A launch file of one view, with its endpoints in its folder. more: of [publish], and what comes after."""
    (folder / "launch.toml").write_text(f"""
        [source]
        {source}
        [model]
        weights = "{weights}"
        steps = 1
        [view.main]
        [control]
        endpoint = "ipc://{folder}/control"
        [publish]
        data = "ipc://{folder}/data"
        status = "ipc://{folder}/status"
        {more}
    """)
    return folder / "launch.toml"


@contextlib.contextmanager
def service_manager(address: str) -> Generator[Callable[[], list[str]]]:
    """Listens as systemd does; calling it gives the lines that have arrived since."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.bind(address)
        link.setblocking(False)

        def receive() -> list[str]:
            lines: list[str] = []
            with contextlib.suppress(BlockingIOError):
                while True:
                    lines += link.recv(4096).decode().splitlines()
            return lines

        yield receive


class Rig:
    """Use it as a context manager; at its end the node was shut down, and everything it said is still here."""

    def __init__(
        self,
        folder: Path,
        source: Bench | Callable[[SourceConfig], FrameSource],
        model: ViewSynthesizer | Callable[[ModelSection], ViewSynthesizer] | None = None,
        *,
        config: str = CAMERA,
        views: str = "[view.main]\nazimuth_deg = 10.0",
        more: str = "",
        once: bool = False,
        service: ServiceManager | None = None,
        watched: bool = True,
    ) -> None:
        """watched: somebody reads the views."""
        self.config = rig_config(folder, config, views, more)
        self.model = FakeSynthesizer(traits()) if model is None else model
        loaded = self.model
        parts = Parts(
            open_source=(lambda _: source.open()) if isinstance(source, Bench) else source,
            load_model=(lambda _: loaded) if hasattr(loaded, "traits") else loaded,  # type: ignore[arg-type,return-value]
        )
        self._session = contextlib.ExitStack()
        opened = open_session(self.config, parts=parts, once=once, service=service)
        self.node, self.publisher, self.control = self._session.enter_context(opened)
        self.folder = folder
        self.notes: list[tuple[str, Mapping[str, Any]]] = []
        self.views: list[ReceivedView] = []
        self.ended = False
        self.summary: Summary | None = None
        self.failure: Exception | None = None
        self._done, self._watched, self._froze = threading.Event(), watched, False
        targets = [self._hear, *([self._see] if watched else []), self._live]
        self._threads = [threading.Thread(target=target, daemon=True) for target in targets]

    def __enter__(self) -> "Rig":
        self._froze = gc.get_freeze_count() == 0
        if self._froze:  # a node's own process holds no thousand tests: looking through these would take it seconds
            gc.freeze()
        self.client = ControlClient(f"ipc://{self.folder}/control", timeout_s=20.0, attempts=1)
        for thread in self._threads[:-1]:
            thread.start()
        until(lambda: self.publisher.stats.subscribers >= self._watched)
        self._threads[-1].start()
        return self

    def __exit__(self, *_: object) -> None:
        self.node.stop()
        self._threads[-1].join(20)
        alive = self._threads[-1].is_alive()
        self._done.set()
        self._session.close()  # waits until the readers have heard everything and left
        for thread in self._threads[:-1]:
            thread.join(10)
        self.client.close()
        if self._froze:
            gc.unfreeze()
        assert not alive, "the node did not end"

    def _live(self) -> None:
        try:
            self.summary = self.node.run()
        except Exception as error:
            self.failure = error

    def _hear(self) -> None:
        def is_over() -> bool:
            return bool(self.notes) and self.notes[-1][1].get("state") == "finalized"

        with StatusSubscriber(f"ipc://{self.folder}/status") as notes:
            for note in self._received(notes, is_over):
                self.notes.append((note.topic, note.fields))

    def _see(self) -> None:
        with ViewSubscriber(f"ipc://{self.folder}/data", None, "win", conflate=False) as views:
            for view in self._received(views, lambda: self.ended):
                self.views.append(view)

    def _received(self, reader: StatusSubscriber | ViewSubscriber, is_over: Callable[[], bool]) -> Iterator[Any]:
        silent = 0
        while silent < (1 if is_over() else _SILENT_LOOKS):
            done, found = self._done.is_set(), reader.receive(_LOOK_MS)
            silent = silent + 1 if done and found is None else 0
            if found is not None:
                yield found
            elif reader.ended:
                self.ended = True

    # What it said.

    def events(self, code: str | None = None) -> list[Mapping[str, Any]]:
        return [fields for fields in self.told("event") if code in (None, fields["code"])]

    def told(self, topic: str) -> list[Mapping[str, Any]]:
        return [fields for each, fields in list(self.notes) if each == topic]

    def statuses(self) -> list[Mapping[str, Any]]:
        return self.told("status")

    def of(self, view: str = "main") -> list[ReceivedView]:
        return [each for each in list(self.views) if each.header.view_id == view]

    def await_event(self, code: str, count: int = 1) -> Mapping[str, Any]:
        until(lambda: len(self.events(code)) >= count)
        return self.events(code)[count - 1]

    def await_state(self, state: str) -> None:
        until(lambda: self.node.state.label == state)

    def await_status(self, holds: Callable[[Mapping[str, Any]], bool]) -> Mapping[str, Any]:
        until(lambda: any(holds(status) for status in self.statuses()))
        return next(status for status in self.statuses() if holds(status))

    def await_views(self, count: int, view: str = "main") -> list[ReceivedView]:
        until(lambda: len(self.of(view)) >= count)
        return self.of(view)

    def ask(self, verb: str, args: Mapping[str, object] | None = None, **more: object) -> Reply:
        return self.client.request(verb, {**(args or {}), **more})
