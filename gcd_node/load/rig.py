"""A whole node in this process, over real sockets in a folder of its own, with a scripted camera and a stand-in."""

import tempfile
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

from gcd_node.config import (
    ControlConfig,
    ModelSection,
    NodeConfig,
    PublishConfig,
    SourceConfig,
    ViewConfig,
    WindowConfig,
)
from gcd_node.control.server import ControlOptions, ControlServer
from gcd_node.errors import NodeError
from gcd_node.life.machinery import Parts
from gcd_node.life.memory import settle_process
from gcd_node.load.scripted_camera import CameraScript
from gcd_node.load.stand_in import StandInModel
from gcd_node.node import Node, NodeOptions
from gcd_node.publisher import Publisher
from gcd_node.rendering.model_worker import WindowReport
from gcd_node.session import publisher_options

VIEW = "load"
"""The view a rig always has."""

_PATIENCE_S = 60.0
_LOOK_S = 0.01
_END_S = 20.0


class Rig:
    """A node that runs in a thread until the rig is closed; see running_node()."""

    def __init__(self, node: Node, publisher: Publisher, control: str) -> None:
        self.node, self.publisher, self.control = node, publisher, control
        self.failure: Exception | None = None
        """What the node ended with, None while it runs."""
        self._thread = threading.Thread(target=self._run, name="node", daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether the node lives."""
        return self._thread.is_alive()

    def wait_for(self, condition: Callable[[], bool], what: str) -> None:
        """Wait until something holds. Raises NodeError if it does not within a minute, or the node ends."""
        until_s = time.monotonic() + _PATIENCE_S
        while not condition():
            if not self.running or time.monotonic() > until_s:
                reason = "" if self.failure is None else f": {self.failure}"
                raise NodeError(f"{what} did not come about in {_PATIENCE_S:g} s{reason}; run with -v to see why")
            time.sleep(_LOOK_S)

    def close(self) -> None:
        """End the node in order. Raises NodeError if it does not end."""
        self.node.stop()
        self._thread.join(_END_S)
        if self._thread.is_alive():
            raise NodeError(f"the node did not end within {_END_S:g} s after it was told to")

    def _run(self) -> None:
        try:
            self.node.run()
        except Exception as error:  # the end of a thread: whoever drives the load looks at it
            self.failure = error


@contextmanager
def running_node(
    script: CameraScript,
    model: StandInModel,
    *,
    stride: int | None = None,
    on_window: Callable[[WindowReport], None] | None = None,
) -> Generator[Rig]:
    """A node that is active, or about to be. stride: see [window].

    Raises:
        EndpointError: its sockets cannot be bound. NodeError: at the end, if the node does not end.
    """
    settle_process()
    with tempfile.TemporaryDirectory(prefix="gcd-load-") as name:
        config = rig_config(Path(name), stride)
        parts = Parts(open_source=lambda _: script.open(), load_model=lambda _: model)
        with Publisher(publisher_options(config)) as publisher:
            node = Node(config, parts, publisher, NodeOptions(once=False, on_window=on_window))
            options = ControlOptions(endpoint=f"ipc://{name}/control")
            with ControlServer(options, node, lambda: node.state.label, node.event) as control:
                rig = Rig(node, publisher, control.endpoint)
                try:
                    yield rig
                finally:
                    rig.close()


def rig_config(folder: Path, stride: int | None) -> NodeConfig:
    """The launch file of a rig."""
    return NodeConfig(
        source=SourceConfig(kind="v4l2"),
        model=ModelSection(weights="stand-in"),
        view={VIEW: ViewConfig(azimuth_deg=10.0)},
        window=WindowConfig(stride=stride),
        publish=PublishConfig(data=f"ipc://{folder}/data", status=f"ipc://{folder}/status"),
        control=ControlConfig(endpoint=f"ipc://{folder}/control"),
        node_id="load",
    )
