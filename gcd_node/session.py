"""A whole node in this process: everything a launch file names, opened in the order that fails fastest."""

import logging
import os
import signal
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from types import FrameType

import cv2
import torch

from gcd_model import OptionError, ViewSynthesizer, load_synthesizer
from gcd_node.config import LIVE_KINDS, ModelSection, NodeConfig
from gcd_node.control.server import ControlOptions, ControlServer
from gcd_node.errors import ConfigError
from gcd_node.health.metrics_server import MetricsServer
from gcd_node.life.machinery import Parts
from gcd_node.life.memory import settle_process
from gcd_node.life.stream import Summary
from gcd_node.node import Node, NodeOptions
from gcd_node.publisher import Publisher
from gcd_node.publishing.options import PublisherOptions
from gcd_node.rendering.model_worker import WindowReport
from gcd_node.security.allow_list import load_server_security
from gcd_node.security.gate import ServerSecurity
from gcd_node.sources import open_source
from gcd_node.viewer.hub import NodeEndpoints
from gcd_node.viewer.server import ViewerOptions, ViewerServer, own_keys

_LOG = logging.getLogger(__name__)


def publisher_options(config: NodeConfig, security: ServerSecurity | None = None) -> PublisherOptions:
    """The publisher's options for a launch file."""
    publish = config.publish
    return PublisherOptions(
        data=publish.data,
        status=publish.status,
        lockstep=config.source.pace == "lockstep",
        min_subscribers=publish.min_subscribers,
        end_delay_ms=publish.end_delay_ms,
        security=security,
    )


def model_threads(section: ModelSection) -> int:
    """CPU threads for the model: as stated, else one less than this process may use, for the rest of the robot."""
    return section.threads or max(1, len(os.sched_getaffinity(0)) - 1)


def load_model(section: ModelSection) -> ViewSynthesizer:
    """The model of a launch file, on as many threads as model_threads() says; OpenCV gets no more for its pictures.

    Raises:
        CheckpointError: see load_synthesizer(). ConfigError: options the checkpoint cannot have.
    """
    threads = model_threads(section)
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
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


def ends_by_itself(config: NodeConfig) -> bool:
    """Whether a run ends with its source when nobody says otherwise: recordings end, cameras and commands go on."""
    return config.source.kind not in LIVE_KINDS and config.life.autostart


@contextmanager
def open_session(
    config: NodeConfig,
    on_window: Callable[[WindowReport], None] | None = None,
    options: NodeOptions | None = None,
    on_viewer: Callable[[str], None] | None = None,
) -> Generator[tuple[Node, Publisher]]:
    """A node ready to run, and its publisher, already bound; its control and health sockets and its page too, if it
    has any. on_viewer: told the page's address, with the token that makes an operator.

    Raises:
        EndpointError, ConfigError: see Publisher, ControlServer, MetricsServer, Recorder, ViewerServer. Nothing stays
            open.
    """
    settle_process()
    options = replace(options or NodeOptions(once=ends_by_itself(config)), on_window=on_window)
    heard: list[Node] = []

    def tell(code: str, fields: dict[str, object]) -> None:
        for node in heard:
            node.event(code, fields)

    security = load_server_security(config.security, tell)
    with ExitStack() as stack:
        publisher = stack.enter_context(Publisher(publisher_options(config, security), tell))
        node = Node(config, Parts(open_source=open_source, load_model=load_model), publisher, options)
        heard.append(node)
        control: str | None = None
        if config.control.endpoint is not None:
            wanted = ControlOptions(endpoint=config.control.endpoint, security=security)
            control = stack.enter_context(
                ControlServer(wanted, node, lambda: node.state.label, tell, node.recorder.command)
            ).endpoint
        if config.health.http is not None:
            stack.enter_context(MetricsServer(config.health.http, node.health))
        if config.viewer.http is not None:
            viewer = stack.enter_context(_viewer(config, publisher, control, security))
            if on_viewer is not None:
                on_viewer(viewer.operator_url)
        yield node, publisher


def _viewer(
    config: NodeConfig, publisher: Publisher, control: str | None, security: ServerSecurity | None
) -> ViewerServer:
    """The page of a node whose sockets are bound; it reaches them from outside, as any client."""
    bound = (publisher.endpoint, publisher.status_endpoint or config.publish.status, control)
    secured = security is not None and any(each is not None and each.startswith("tcp://") for each in bound)
    node = NodeEndpoints(
        data=bound[0],
        status=bound[1],
        control=control,
        keys=own_keys(config.viewer.keys, security if secured else None),
    )
    return ViewerServer(ViewerOptions(http=config.viewer.http or "", node=node))


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
