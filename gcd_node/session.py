"""A whole node in this process: everything a launch file names, opened in the order that fails fastest."""

import logging
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Generator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from types import FrameType

import cv2
import torch

from gcd_client.endpoints import read_key_pair
from gcd_model import OptionError, Traits, ViewSynthesizer, load_synthesizer
from gcd_node.auth import ServerSecurity, load_server_security, log_event
from gcd_node.config import ModelSection, NodeConfig, ViewerConfig
from gcd_node.control import ControlServer
from gcd_node.errors import ConfigError
from gcd_node.health import Health, Level
from gcd_node.lifecycle import Parts
from gcd_node.node import Node
from gcd_node.pipeline import Summary
from gcd_node.publisher import Publisher
from gcd_node.remote import open_remote
from gcd_node.service import ServiceManager, listen
from gcd_node.sources import LIVE_KINDS, open_source
from gcd_node.work import WindowReport

_LOG = logging.getLogger(__name__)


def model_threads(section: ModelSection) -> int:
    """CPU threads of a network: as stated, else half of what this process may use. The live model has two networks at
    work side by side, and the robot has work of its own."""
    return section.threads or max(1, len(os.sched_getaffinity(0)) // 2)


def load_model(section: ModelSection) -> ViewSynthesizer:
    """The model of a launch file, on as many threads as model_threads() says; OpenCV gets no more for its pictures.

    Raises:
        CheckpointError: see load_synthesizer(). ConfigError: options the checkpoint cannot have. RemoteError: see
            open_remote().
    """
    threads = model_threads(section)
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    if section.engine == "remote":
        return open_remote(section)
    try:
        return load_synthesizer(
            section.weights,
            family=section.family,
            device=section.device,
            dtype=section.dtype,
            head_width=section.head_width,
            image_heads=section.image_heads,
            adapter=section.adapter,
            engine=section.engine,
            providers=section.providers,
        )
    except OptionError as error:
        raise ConfigError(f"[model]: {error}") from error


@contextmanager
def open_session(
    config: NodeConfig,
    *,
    once: bool | None = None,
    on_configured: Callable[[Traits], None] | None = None,
    on_window: Callable[[WindowReport], None] | None = None,
    service: ServiceManager | None = None,
    viewer: bool = False,
    show_page: bool = False,
    parts: Parts | None = None,
) -> Generator[tuple[Node, Publisher, ControlServer | None]]:
    """A node ready to run, its publisher and its control server, already bound; its health socket too, if it has any.

    once, on_configured, on_window, service: see Node; once is left out: recordings that start by themselves end the
        node, cameras and commands go on.
    viewer: start `gcd-node viewer` beside the node, if its launch file has a [viewer]; else that is only checked.
    show_page: let it open its page in a browser. parts: others than those that the launch file names.
    Raises:
        EndpointError, ConfigError: see Publisher, ControlServer, metrics_server(), Recorder, ViewerConfig. Nothing
            stays open.
    """
    node: Node | None = None  # what publishes its events is made before it

    def emit(code: str, level: Level, fields: Mapping[str, object]) -> None:
        (log_event if node is None else node.event)(code, level, fields)

    security = load_server_security(config.security, emit)
    with ExitStack() as stack:
        is_lockstep = config.source.pace == "lockstep"
        publisher = stack.enter_context(Publisher(config.publish, emit, lockstep=is_lockstep, security=security))
        node = Node(
            config,
            parts or Parts(open_source=lambda each: open_source(each, security, emit), load_model=load_model),
            publisher,
            once=config.source.kind not in LIVE_KINDS and config.life.autostart if once is None else once,
            on_configured=on_configured,
            on_window=on_window,
            service=service,
        )
        node.needed += publisher.guard.threads
        control: ControlServer | None = None
        if config.control.endpoint is not None:
            control = ControlServer(
                config.control.endpoint,
                node.commands.handle,
                state=lambda: node.state.label,
                on_event=emit,
                on_answer=node.recorder.command,
                security=security,
            )
            stack.callback(control.close)
            node.needed += [control.thread, *control.guard.threads]
        if config.health.http is not None:
            stack.enter_context(metrics_server(config.health.http, node.health))
        if config.viewer.http is not None:
            arguments = _viewer_arguments(config.viewer, publisher, control, security)
            listen(config.viewer.http, "[viewer] http").close()  # to know at once whether it is free
            if viewer:
                stack.enter_context(_viewer_process([*arguments, *(["--open"] if show_page else [])]))
        yield node, publisher, control


def _viewer_arguments(
    config: ViewerConfig, publisher: Publisher, control: ControlServer | None, security: ServerSecurity | None
) -> list[str]:
    """What `gcd-node viewer` is given. The page is a client like others: without keys ConfigError, where the node asks
    for them."""
    arguments = ["--http", config.http or "", "--data", publisher.endpoint, "--status", publisher.status_endpoint]
    arguments += ["--control", "none" if control is None else control.endpoint]
    if security is None or not any(each.startswith("tcp://") for each in arguments):
        return arguments
    if config.keys is None:
        raise ConfigError(
            "this node asks its clients for keys, and the page is one of them: make a pair with `gcd-node keys new`, "
            "name its folder in [viewer] keys, and put its public key on the list in [security] allow"
        )
    folder = Path(config.keys).expanduser()
    read_key_pair(folder)
    return [*arguments, "--keys", str(folder), "--node-key", security.keys.public]


@contextmanager
def _viewer_process(arguments: list[str]) -> Generator[None]:
    """The viewer costs the node nothing: it reads the sockets as any client, in a process that ends with this one."""
    command = [sys.executable, "-m", "gcd_node", "viewer", *arguments, "--ends-with-stdin"]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as process:  # noqa: S603
        try:
            yield
        finally:
            process.communicate()


def metrics_server(address: str, health: Health) -> AbstractContextManager[object]:
    """The pages of a node's health. Raises ConfigError, EndpointError: see MetricsServer; or without the extra."""
    try:
        from gcd_node.metrics import MetricsServer  # needs prometheus_client, which not every node has
    except ImportError as error:
        raise ConfigError(
            f"[health] http needs the package {error.name}: pip install 'gcd-node[metrics]', or leave http out"
        ) from error
    return MetricsServer(address, health)


def run_until_signal(node: Node, publisher: Publisher) -> Summary:
    """Run a node; the first SIGINT or SIGTERM ends it in order, the second at once. Main thread only.

    Raises: as Node.run; what was announced before has left by then.
    """
    previous = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def stop(number: int, _: FrameType | None) -> None:
        _LOG.warning("%s: ending in order; once more ends at once", signal.Signals(number).name)
        for each in previous:
            signal.signal(each, signal.SIG_DFL)
        node.stop()

    for number in previous:
        signal.signal(number, stop)
    try:
        return node.run()
    except Exception:
        publisher.close()  # in order: what was announced, the end of every view included, still leaves
        raise
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
