"""One run of a launch file: opens everything in the order that fails fastest, and closes it again."""

import logging
import signal
from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import FrameType

import torch

from gcd_model import OptionError, ViewSynthesizer, load_synthesizer
from gcd_node.config import ModelSection, NodeConfig, PublishConfig
from gcd_node.errors import ConfigError
from gcd_node.model_worker import WindowReport
from gcd_node.node import Node, Summary
from gcd_node.publisher import Publisher
from gcd_node.publisher_options import PublisherOptions
from gcd_node.sources import open_source

_LOG = logging.getLogger(__name__)


def publisher_options(config: PublishConfig, *, lockstep: bool) -> PublisherOptions:
    """The publisher's options for a launch file."""
    return PublisherOptions(
        data=config.data,
        status=config.status,
        lockstep=lockstep,
        min_subscribers=config.min_subscribers,
        end_delay_ms=config.end_delay_ms,
    )


def load_model(section: ModelSection) -> ViewSynthesizer:
    """The model of a launch file, on as many threads as it says.

    Raises:
        CheckpointError: see load_synthesizer(). ConfigError: options the checkpoint cannot have.
    """
    if section.threads is not None:
        torch.set_num_threads(section.threads)
    try:
        return load_synthesizer(
            section.weights,
            family=section.family,
            device=section.device,
            dtype=section.dtype,
            head_width=section.head_width,
            image_heads=section.image_heads,
        )
    except OptionError as error:
        raise ConfigError(f"[model]: {error}") from error


@contextmanager
def open_session(
    config: NodeConfig, on_window: Callable[[WindowReport], None] | None = None
) -> Generator[tuple[Node, Publisher]]:
    """A node ready to run, and its publisher, already bound.

    The source is opened first and the sockets are bound second: both fail within a second or two, before minutes
    may go into loading weights.

    Raises:
        SourceError, EndpointError, CheckpointError, ConfigError, PoseError: see there. Nothing stays open.
    """
    source = open_source(config.source)
    try:
        with Publisher(publisher_options(config.publish, lockstep=config.source.pace == "lockstep")) as publisher:
            yield Node(config, load_model(config.model), source, publisher, on_window), publisher
    finally:
        source.close()


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
