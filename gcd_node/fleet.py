"""The other end of engine "remote": a model behind Ray Serve, for many nodes (docs/deploy.md).

A replica holds one model, and renders one window at a time. Of each stream the newest window counts: an older one that
waits or is in work is given up, as is one whose deadline has passed, or whose node has hung up.
"""

import asyncio
import contextlib
import hmac
import math
import os
import socket
import threading
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from gcd_client.protocol import MAX_HEADER, PREFIX, MessageError
from gcd_model import (
    Augmentation,
    Cancelled,
    Clip,
    FileError,
    Intrinsics,
    ModelError,
    RenderOptions,
    Trajectory,
    ViewSynthesizer,
    decode_toml,
    explain_settings_error,
    read_small,
)
from gcd_node.auth import is_loopback
from gcd_node.config import ModelSection
from gcd_node.errors import ConfigError
from gcd_node.model import render_grey
from gcd_node.preprocess import to_clip_tensor
from gcd_node.remote_messages import ModelReply, WindowHeader, model_digest, read_window, views_message
from gcd_node.session import load_model
from gcd_node.sources import Count

if TYPE_CHECKING:
    from ray.serve import Application
    from ray.serve.config import HTTPOptions
    from starlette.requests import Request
    from starlette.responses import Response

_APP = "gcd"
_AT_ONCE = 16  # requests that a replica takes, one in work and the others waiting; more go to the next replica
_LONGEST_REQUEST_S = 30.0
_STUCK_S = 2 * _LONGEST_REQUEST_S  # a window is given up by its deadline, between two steps
_MOST_VIEWS = 64
_USED = 0.8  # of the time until a deadline; the way back takes some, too
_ROUTER: Any = "ray.serve.experimental.consistent_hash_router.ConsistentHashRouter"


class ServeSection(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a service listens, and on how many replicas of the model it runs.

    http: address on the head of the cluster. token: file of the password, the same on every machine; without one
        only a loopback address may be served.
    certificate, key: PEM files; with them it speaks https.
    replicas: left out, one for each GPU of the cluster, or without GPUs one for each machine.
    """

    http: str = "127.0.0.1:8000"
    token: str | None = None
    certificate: str | None = None
    key: str | None = None
    replicas: Count | None = None

    @property
    def url(self) -> str:
        """What nodes on this machine name."""
        return f"{'http' if self.certificate is None else 'https'}://{self.http}"

    def __post_init__(self) -> None:
        host, _, port = self.http.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 1 << 16:
            raise ValueError(f'http is "HOST:PORT", got {self.http[:80]!r}')
        if self.token is None and not is_loopback(self.http):
            raise ValueError(f"{self.http} can be reached from other machines: state token, a file with a password")
        if (self.certificate is None) != (self.key is None):
            raise ValueError("https takes certificate and key: state both, or neither")


class ServiceConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole file of `gcd-node serve`. model: as in a launch file; what is drawn how, the nodes say."""

    model: ModelSection
    serve: ServeSection = ServeSection()

    def __post_init__(self) -> None:
        if self.model.engine == "remote":
            raise ValueError("a service computes itself: name weights, and an engine of this machine")


class RefusedError(Exception):
    """A request that gets no views. status: of HTTP."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status = status


class Replica:
    """One model. Every method but `answer` is for its own use and for Ray."""

    def __init__(self, config: dict[str, Any], load: Callable[[ModelSection], ViewSynthesizer] = load_model) -> None:
        """config: of a ServiceConfig, as plain values. Raises as load_model(); ConfigError: the live model, or a token
        that cannot be read."""
        settings = service_config(config)
        self._token = read_token(settings.serve)
        self._synthesizer, traits = (model := load(settings.model)), model.traits
        if traits.live:
            raise ConfigError(f"[model] weights: {traits.name} is made for a robot's own machine; run it there")
        self._device, self._begun_s = asyncio.Lock(), math.inf  # when the window in work was begun
        self._queued, self._pace_s = 0, 0.0  # views in work or waiting; and how long one took last, seconds
        self._newest: dict[str, threading.Event] = {}  # what gives up each stream's newest window
        size = 3 * traits.config.frames * traits.config.height * traits.config.width
        self.most = PREFIX.size + MAX_HEADER + size + 152 * traits.config.frames * _MOST_VIEWS
        """Bytes of the largest window."""
        with torch.inference_mode():
            render_grey(self._synthesizer, [traits.plan_view()], None, RenderOptions(steps=1, motion_bucket=127.0))

    async def __call__(self, request: "Request") -> "Response":
        """Of Serve: GET says what the model is, POST renders a window."""
        from starlette.responses import Response

        try:
            self.admit(request.headers.get("authorization", ""))
            return Response(await self.answer(None if request.method == "GET" else await self._body(request)))
        except RefusedError as error:
            return Response(str(error), error.status, media_type="text/plain")

    def check_health(self) -> None:
        """Of Serve, which replaces a replica that raises: one whose device is stuck, or lost."""
        if time.monotonic() - self._begun_s > _STUCK_S:
            raise RuntimeError(f"a window has been in work for more than {_STUCK_S:g} s")
        if self._synthesizer.traits.device.startswith("cuda"):
            torch.cuda.current_stream().query()  # raises from the first error on that a process cannot recover from

    def admit(self, authorization: str) -> None:
        """Look at a request's header of that name before any of its body is read. Raises RefusedError."""
        if not hmac.compare_digest(authorization.encode(), f"Bearer {self._token}".encode() if self._token else b""):
            raise RefusedError(401, "wrong token: see [model] token")

    async def answer(self, body: bytes | None) -> bytes:
        """The reply to a request. body: None for what the model is. Raises RefusedError."""
        traits = self._synthesizer.traits
        if body is None:
            told = {name: getattr(traits, name) for name in ("sha256_12", "precision", "device")}
            return msgspec.json.encode(ModelReply(card=traits.to_metadata(), model=model_digest(traits), **told))
        try:
            header, pictures, paths = read_window(body, traits)
        except (MessageError, ModelError) as error:
            raise RefusedError(400, str(error)) from error
        return await self._newest_of_stream(header, pictures, paths)

    async def _body(self, request: "Request") -> bytes:
        content = bytearray()
        async for chunk in request.stream():
            content += chunk
            if len(content) > self.most:
                raise RefusedError(413, f"a window has at most {self.most} bytes")
        return bytes(content)

    async def _newest_of_stream(
        self, header: WindowHeader, pictures: NDArray[np.uint8], paths: list[Trajectory]
    ) -> bytes:
        """Its views, by its deadline and unless a newer one of its stream comes. Raises RefusedError."""
        views_due = header.drawing.samples * len(paths)
        self._require_time(header, views_due)
        give_up = threading.Event()
        if (older := self._newest.get(header.stream)) is not None:
            older.set()
        self._newest[header.stream] = give_up
        self._queued += views_due
        work = asyncio.create_task(self._in_turn(header, pictures, paths, give_up))

        def is_done(done: asyncio.Task[bytes]) -> None:
            self._queued -= views_due
            _ = done.cancelled() or done.exception()  # where nobody waits any more

        work.add_done_callback(is_done)
        try:
            return await asyncio.wait_for(asyncio.shield(work), header.deadline_ms / 1000)
        except TimeoutError as error:
            raise RefusedError(504, f"not rendered within {header.deadline_ms} ms") from error
        finally:  # also where the node has hung up
            give_up.set()
            if self._newest.get(header.stream) is give_up:
                del self._newest[header.stream]

    def _require_time(self, header: WindowHeader, views_due: int) -> None:
        """Refuse at once what would be late. Windows are rendered in the order in which they come: with more streams
        than a replica can serve each would be begun a little before its deadline, and none finished by it."""
        spent_s = max(0.0, time.monotonic() - self._begun_s)
        due_s = self._pace_s * (self._queued + views_due) - spent_s
        if self._queued and due_s > _USED * header.deadline_ms / 1000:
            raise RefusedError(503, f"too busy: it would take {due_s:.2f} s")

    async def _in_turn(
        self, header: WindowHeader, pictures: NDArray[np.uint8], paths: list[Trajectory], give_up: threading.Event
    ) -> bytes:
        """The device is the window's until its thread has ended, however that is given up."""
        async with self._device:
            if give_up.is_set():
                raise RefusedError(409, "given up for a newer window")
            self._begun_s = time.monotonic()
            try:
                return await asyncio.to_thread(self._rendered, header, pictures, paths, give_up)
            except Cancelled as error:
                raise RefusedError(409, "given up for a newer window") from error
            except ModelError as error:
                raise RefusedError(422, str(error)) from error
            finally:
                spent_s, self._begun_s = time.monotonic() - self._begun_s, math.inf
                pace_s = spent_s / (header.drawing.samples * len(paths))
                self._pace_s = max(pace_s, self._pace_s) if give_up.is_set() else pace_s  # given up before its end

    def _rendered(
        self, header: WindowHeader, pictures: NDArray[np.uint8], paths: list[Trajectory], give_up: threading.Event
    ) -> bytes:
        """Frames are encoded one by one, as a node does it: the views are the same to the last bit."""
        _, height, width = header.shape
        lens = None
        if header.lens is not None:
            fx, fy, cx, cy = header.lens
            lens = Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)
        first, *others = (
            self._synthesizer.encode(
                Clip(video=torch.from_numpy(to_clip_tensor(picture[None])), fps=header.fps, lens=lens),
                Augmentation(strength=header.augmentation, seed=seed),
            )
            for picture, seed in zip(pictures, header.seeds, strict=True)
        )
        drawing = msgspec.structs.asdict(header.drawing)
        options = RenderOptions(**drawing, whole_levels=True, cancel=give_up)
        return views_message(header, self._synthesizer.render(first.followed_by(*others), paths, options))


def load_service(path: Path) -> ServiceConfig:
    """A file of `gcd-node serve`. Raises ConfigError: missing, no TOML, an unknown key, a value out of range."""
    try:
        return service_config(decode_toml(read_small(path)), str(path))
    except FileError as error:
        raise ConfigError(f"{path} {error}; give the path of a TOML file") from error


def service_config(table: object, name: str = "settings of the service") -> ServiceConfig:
    """From plain values. Raises ConfigError."""
    try:
        return msgspec.convert(table, ServiceConfig, strict=True)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{name}: {explain_settings_error(str(error), ServiceConfig)}") from error


def read_token(section: ServeSection) -> str:
    """The password, "" for none. Raises ConfigError."""
    if section.token is None:
        return ""
    try:
        token = read_small(Path(section.token).expanduser()).strip()
    except FileError as error:
        raise ConfigError(f"[serve] token {section.token} {error}") from error
    if not token:
        raise ConfigError(f"[serve] token {section.token} is empty")
    return token


def app(config: dict[str, Any]) -> "Application":
    """The service as Serve deploys it; config files of Serve name this function, and the settings as its args.

    Raises ConfigError.
    """
    import ray
    from ray import serve
    from ray.serve.config import RequestRouterConfig

    settings = service_config(config)
    gpus = 0 if settings.model.device == "cpu" else int(ray.cluster_resources().get("GPU", 0))
    on_gpu = gpus > 0 or settings.model.device.startswith("cuda")
    machines = sum(bool(node["Alive"]) for node in ray.nodes())
    deployment: Any = serve.deployment(
        name="views",
        num_replicas=settings.serve.replicas or gpus or machines,
        max_ongoing_requests=_AT_ONCE,
        max_queued_requests=4 * _AT_ONCE,  # what waits longer is late
        ray_actor_options={"num_gpus": 1} if on_gpu else {"num_cpus": 1},
        request_router_config=RequestRouterConfig(request_router_class=_ROUTER),
        health_check_period_s=2.0,
        health_check_timeout_s=10.0,
        graceful_shutdown_timeout_s=5.0,
    )
    return deployment(Replica).bind(config)


@contextlib.contextmanager
def deployed(config: ServiceConfig) -> Generator[bool]:
    """The service on the cluster that runs here or that RAY_ADDRESS names, where it stays; else on a cluster of this
    machine alone, which ends with the block. Gives whether it is the latter.

    Raises ConfigError: without the extra, or without the cluster that is named; the model cannot be loaded there; Serve
    runs there with another endpoint.
    """
    read_token(config.serve)
    _require_cluster(os.environ.get("RAY_ADDRESS") or "auto")
    try:
        import ray
        from ray import serve
    except ImportError as error:
        raise ConfigError(f"a service needs the package {error.name}: pip install 'gcd-node[cluster]'") from error

    is_own = False
    try:
        ray.init(address="auto", log_to_driver=False)
    except ConnectionError:
        is_own = True
        ray.init(include_dashboard=False, log_to_driver=False)
    try:
        # With a proxy on every machine, one that dies holds up the replicas that answer it until its death is noticed.
        serve.start(proxy_location="HeadOnly", http_options=_http_options(config.serve))
        _require_endpoint(config.serve)
        try:
            serve.run(app(msgspec.to_builtins(config)), name=_APP, route_prefix="/")
        except RuntimeError as error:
            parts = serve.status().applications[_APP].deployments.values()
            why = next((lines[-1] for part in parts if (lines := part.message.strip(" .\n").splitlines())), str(error))
            raise ConfigError(f"the service cannot be deployed: {why}") from error
        yield is_own
    finally:
        if is_own:
            serve.shutdown()
        ray.shutdown()


def _require_cluster(address: str) -> None:
    """Ray waits for many minutes for one that is not there. Raises ConfigError."""
    host, _, port = address.rpartition(":")
    try:
        if address != "auto":
            socket.create_connection((host.strip("[]"), int(port)), timeout=5).close()
    except (OSError, ValueError) as error:
        raise ConfigError(f"RAY_ADDRESS is HOST:PORT of a running Ray cluster, got {address!r} ({error})") from error


def _http_options(section: ServeSection) -> "HTTPOptions":
    from ray.serve.config import HTTPOptions

    host, _, port = section.http.rpartition(":")
    return HTTPOptions(
        host=host.strip("[]"),
        port=int(port),
        request_timeout_s=_LONGEST_REQUEST_S,
        ssl_certfile=section.certificate,
        ssl_keyfile=section.key,
    )


def _require_endpoint(section: ServeSection) -> None:
    """Serve has one endpoint a cluster, and keeps the one it has. Raises ConfigError: that is another."""
    from ray.serve.context import _get_global_client as client  # pyright: ignore[reportPrivateUsage]  # alone tells

    serve = client()
    assert serve is not None, "it was started"
    now, due = serve.http_config, _http_options(section)
    names = ("host", "port", "ssl_certfile", "ssl_keyfile")
    if other := [f"{name} {getattr(now, name)}" for name in names if getattr(now, name) != getattr(due, name)]:
        raise ConfigError(
            f"[serve]: Serve runs on this cluster already, with {', '.join(other)}; state the same, or `serve shutdown`"
        )
