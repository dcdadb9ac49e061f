"""A model that computes elsewhere: windows go to a service (fleet.py) over HTTP, views come back within a deadline.

    GET /     what the model is, JSON: ModelReply
    POST /    a window -> its views, see remote_messages.py

A request has a connection of its own, so that none is found dead when a window is due.
"""

import http.client
import socket
import ssl
import threading
import time
import uuid
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import msgspec
import torch

from gcd_client.protocol import MAX_HEADER, MAX_PAYLOAD, PREFIX, MessageError
from gcd_model import (
    Augmentation,
    Cancelled,
    Card,
    Clip,
    FileError,
    ModelError,
    OptionError,
    RenderOptions,
    SourceFeatures,
    Traits,
    Trajectory,
    View,
    ViewSynthesizer,
    load_synthesizer,
    read_small,
)
from gcd_node.config import ModelSection
from gcd_node.errors import ConfigError, RemoteError
from gcd_node.remote_messages import Drawing, ModelReply, RemoteFeatures, WindowHeader, read_views, window_message

_TRAITS_S, _MOST_TRAITS = 5.0, 1 << 20
_LOOK_S = 0.05  # how often a waiting thread looks whether it is to stop
_LONGEST_WORD = 300


# The connection.


@dataclass(frozen=True, kw_only=True, slots=True)
class Service:
    """Where a service is. address: http:// or https://. token: what it asks for, "" for nothing."""

    address: str
    token: str = ""

    def exchange(self, deadline_s: float, most: int, body: bytes | None = None, stream: str = "") -> "Exchange":
        """Begin a request. most: bytes that the reply may have. stream: whose windows go to one replica."""
        headers = {"x-session-id": stream} if stream else {}
        if self.token:
            headers["authorization"] = f"Bearer {self.token}"
        started = Exchange(self.address, headers, body, deadline_s, most)
        started.start()
        return started


class Exchange(threading.Thread):
    """One request and its reply. A thread, so that neither a name that does not resolve nor a network that stands still
    holds up who waits for it; it ends soon after its deadline."""

    def __init__(
        self, address: str, headers: Mapping[str, str], body: bytes | None, deadline_s: float, most: int
    ) -> None:
        super().__init__(name="exchange", daemon=True)
        self.until_s = time.monotonic() + deadline_s
        self._url, self._headers, self._body, self._most = urlsplit(address), dict(headers), body, most
        self._deadline_s, self._ended_s = deadline_s, 0.0
        self._socket: socket.socket | None = None
        self._reply: bytes | None = None
        self._problem = ""

    def run(self) -> None:
        """Ask."""
        host, port, timeout_s = self._url.hostname or "", self._url.port, self._deadline_s
        if self._url.scheme == "https":
            context = ssl.create_default_context()
            link = http.client.HTTPSConnection(host, port, timeout=timeout_s, context=context)
        else:
            link = http.client.HTTPConnection(host, port, timeout=timeout_s)
        try:
            link.connect()
            self._socket = link.sock
            link.request("GET" if self._body is None else "POST", self._url.path or "/", self._body, self._headers)
            with link.getresponse() as response:
                content = response.read(self._most + 1)
            if response.status != http.HTTPStatus.OK:
                self._problem = f"{response.status} {content[:_LONGEST_WORD].decode(errors='replace')!a}"
            elif len(content) > self._most:
                self._problem = f"a reply of more than {self._most} bytes"
            else:
                self._reply = content
        except (OSError, http.client.HTTPException, ValueError) as error:
            word = f"{type(error).__name__}: {str(error)[:_LONGEST_WORD]}"
            self._problem = f"{word}; does `gcd-node serve` run there, and is [model] weights its address?"
        finally:
            link.close()
            self._ended_s = time.monotonic()

    def result(self, cancel: threading.Event | None = None) -> bytes:
        """The reply, if it came by the deadline. Raises RemoteError: none, late, or a refusal; Cancelled."""
        where = f"the service at {self._url.scheme}://{self._url.netloc}"
        while self.is_alive() and (left_s := self.until_s - time.monotonic()) > 0:
            if cancel is not None and cancel.is_set():
                self._abandon()
                raise Cancelled(f"cancelled before {where} answered")
            self.join(min(left_s, _LOOK_S))
        if self.is_alive() or self._ended_s > self.until_s:
            self._abandon()
            raise RemoteError(f"{where} did not answer within {self._deadline_s:g} s")
        if self._reply is None:
            raise RemoteError(f"{where}: {self._problem}")
        return self._reply

    def _abandon(self) -> None:
        """Nobody waits any more: the service sees the connection end."""
        if self._socket is not None:
            with suppress(OSError, ValueError):
                socket.socket.shutdown(self._socket, socket.SHUT_RDWR)  # TLS's own would let the thread go on in clear


# The model.


class RemoteSynthesizer:
    """A ViewSynthesizer whose `encode` keeps the frames and whose `render` sends them.

    While the service does not answer in time and there is a `fallback`, nobody waits for it: a window now and then
    asks whether it is back, and the first after that is rendered there again.

    fallback: what renders the windows that the service does not; None: nothing does.
    """

    def __init__(
        self,
        service: Service,
        traits: Traits,
        model: str,
        *,
        deadline_s: float,
        fallback: ViewSynthesizer | None = None,
    ) -> None:
        """model: see ModelReply. deadline_s: from a window that is taken to its views."""
        self.traits, self.fallback = traits, fallback
        self._service, self._deadline_s, self._model = service, deadline_s, model
        self._stream, self._windows = uuid.uuid4().hex, 0
        self._late = ""  # why the last window was waited for in vain
        self._probe: Exchange | None = None

    def encode(self, clip: Clip, augmentation: Augmentation | None = None) -> RemoteFeatures:
        """See ViewSynthesizer."""
        augmentation = augmentation or Augmentation()
        default = self.traits.diffusion.sampling.augmentation
        return RemoteFeatures(
            tokens=None,
            latents=clip.video.new_zeros(clip.frames, 0, 1, 1),
            fps=clip.fps,
            augmentation=default if augmentation.strength is None else augmentation.strength,
            lens=clip.lens,
            video=clip.video,
            seeds=torch.full((clip.frames,), augmentation.seed),
        )

    def render(
        self, features: SourceFeatures, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        """See ViewSynthesizer. Raises RemoteError: the service does not answer in time, refuses, or sends what was not
        asked for; Cancelled."""
        options = RenderOptions() if options is None else options
        self.traits.check_lengths(features.frames, trajectories)
        assert isinstance(features, RemoteFeatures), "features are this model's"
        header = self._header(features, trajectories, options)
        body = window_message(header, features, trajectories)
        most = PREFIX.size + MAX_HEADER + header.views_size(classes=bool(self.traits.classes))
        if self._late and self.fallback is not None and not self._is_back():
            if self._probe is None:
                self._probe = self._service.exchange(self._deadline_s, most, body, self._stream)
            raise RemoteError(self._late)
        exchange = self._service.exchange(self._deadline_s, most, body, self._stream)
        try:
            views = read_views(exchange.result(options.cancel), header, trajectories, self.traits)
        except (RemoteError, MessageError) as error:
            is_quick = exchange.until_s - time.monotonic() > self._deadline_s / 2  # a refusal costs no wait: ask again
            self._late = "" if is_quick else str(error)
            raise RemoteError(str(error)) from error
        self._late = ""
        return views

    def _header(self, features: RemoteFeatures, paths: Sequence[Trajectory], options: RenderOptions) -> WindowHeader:
        self._windows += 1
        lens, config = features.lens, self.traits.config
        return WindowHeader(
            stream=self._stream,
            window=self._windows,
            model=self._model,
            deadline_ms=round(1000 * self._deadline_s),
            shape=(features.frames, config.height, config.width),
            on_sphere=tuple(path.delta is not None for path in paths),
            fps=features.fps,
            augmentation=features.augmentation,
            seeds=tuple(features.seeds.tolist()),
            lens=None if lens is None else (lens.fx, lens.fy, lens.cx, lens.cy),
            drawing=Drawing(**{name: getattr(options, name) for name in Drawing.__struct_fields__}),
        )

    def _is_back(self) -> bool:
        """Whether a window that was sent meanwhile was answered in time."""
        probe = self._probe
        if probe is None or (probe.is_alive() and time.monotonic() < probe.until_s):
            return False
        self._probe = None
        try:
            probe.result()
        except RemoteError as error:
            self._late = str(error)
            return False
        return True


def open_remote(section: ModelSection) -> RemoteSynthesizer:
    """The model of a launch file with engine = "remote": asks the service what it renders with, and loads what takes
    its place on this machine.

    Raises:
        RemoteError: no service answers there, or with nonsense. CheckpointError: the fallback cannot be loaded.
        ConfigError: an address, a token or a fallback that cannot be used; options for a model of this machine.
    """
    service = _service(section)
    content = service.exchange(_TRAITS_S, _MOST_TRAITS).result()
    try:
        reply = msgspec.json.decode(content, type=ModelReply)
        card, device = Card.from_metadata(reply.card), f"remote:{reply.device}"
        traits = Traits.of(card, sha256_12=reply.sha256_12, precision=reply.precision, device=device)
    except (msgspec.DecodeError, UnicodeDecodeError, ModelError) as error:
        raise RemoteError(
            f"{service.address} is no service of `gcd-node serve` ({error}); see [model] weights"
        ) from error
    config, words = traits.config, (traits.name, traits.precision, traits.device)
    if (
        traits.live
        or config.frames * config.height * config.width * 3 > MAX_PAYLOAD
        or not all(map(str.isprintable, words))
    ):
        raise RemoteError(f"{service.address} has a model that is not for windows of video; see `gcd-node serve`")
    fallback = _fallback(section, traits)
    return RemoteSynthesizer(service, traits, reply.model, deadline_s=section.deadline_s, fallback=fallback)


def _service(section: ModelSection) -> Service:
    local = ("adapter", "family", "providers", "head_width", "image_heads", "depth_model")
    if stated := [name for name in local if getattr(section, name)]:
        raise ConfigError(f"[model] {', '.join(stated)}: what the service renders with is its own; leave them out")
    try:
        url = urlsplit(section.weights)
        if not url.hostname or url.username is not None or url.port == 0:
            raise ValueError("a host and no password is due")
    except ValueError as error:
        raise ConfigError(f"[model] weights: no address of a service: {error}") from error
    try:
        token = "" if section.token is None else read_small(Path(section.token).expanduser()).strip()
        if not token.isascii() or not token.isprintable():
            raise ValueError("is not printable ASCII")
    except (ValueError, FileError) as error:
        raise ConfigError(f"[model] token: {section.token} {error}; a file that holds the token alone") from error
    return Service(address=section.weights, token=token)


def _fallback(section: ModelSection, remote: Traits) -> ViewSynthesizer | None:
    """Raises ConfigError, CheckpointError."""
    if section.fallback == "drop":
        return None
    config = remote.config
    try:
        loaded = load_synthesizer(section.fallback, device=section.device, dtype=section.dtype, frames=config.frames)
        loaded.traits.check_size(config.height, config.width)
    except OptionError as error:
        raise ConfigError(f"[model] fallback: {error}") from error
    if not loaded.traits.live:
        raise ConfigError(f'[model] fallback is the live model or "drop", got {loaded.traits.name}')
    if not remote.knows_camera:
        raise ConfigError(f'[model] fallback: nobody knows where the view of {remote.name} stands; leave "drop"')
    return loaded
