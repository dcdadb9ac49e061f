"""The demo: the packaged drive through the model, over ZeroMQ into a second process, and pictures of what arrived."""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeAlias

import numpy as np
from msgspec.structs import replace

from gcd_client.protocol import ClassRecord
from gcd_model import Traits, hatched
from gcd_node.config import ControlConfig, ModelSection, NodeConfig, PublishConfig, ViewerConfig
from gcd_node.errors import NodeError
from gcd_node.frame import Image
from gcd_node.image_io import enlarged, make_folder, sheet, spread, strip, write_png, write_video
from gcd_node.messages import ontology
from gcd_node.pipeline import Summary
from gcd_node.publisher import Publisher
from gcd_node.session import open_session, run_until_signal
from gcd_node.sources import FileSource, SourcePose
from gcd_node.sources.files import read_picture
from gcd_node.view_config import ViewConfig
from gcd_node.work import WindowReport

VIEW_ID = "topdown"
WEIGHTS = "package:live-small"
HEADINGS = ("input: the packaged drive", "view from above", "the same: what is painted is hatched", "its class map")
"""Columns of the demo's pictures."""

_MOUNT = SourcePose(height_m=1.55, forward_m=1.6, left_m=0.0, tilt_deg=0.0)
_RECEIVER_TIMEOUT_S = 60.0
Moment: TypeAlias = tuple[Image, Image, Image, Image]
"""One moment: the camera's picture, the view made of it, the same with what is painted hatched, and its class map."""


def demo_config(folder: Path) -> NodeConfig:
    """The demo's launch file, with sockets in a folder of its own so that it never meets a running node."""
    return NodeConfig(
        source=FileSource(path="package:drive.mp4", pace="realtime", hfov_deg=85.0, pose=_MOUNT),
        model=ModelSection(weights=WEIGHTS),
        view={VIEW_ID: ViewConfig(kind="fixed")},
        publish=PublishConfig(data=f"ipc://{folder}/data", status=f"ipc://{folder}/status"),
        control=ControlConfig(endpoint=None),
        node_id="demo",
    )


def run_open_demo() -> Summary:
    """Run the drive in a loop, in real time, until SIGINT or SIGTERM; its viewer opens the page, which can steer it."""
    with tempfile.TemporaryDirectory(prefix="gcd-demo-") as folder:
        config = demo_config(Path(folder))
        config = replace(
            config,
            source=replace(config.source, loop=True),
            control=ControlConfig(endpoint=f"ipc://{folder}/control"),
            viewer=ViewerConfig(http="127.0.0.1:0"),
        )
        with open_session(config, once=True, viewer=True, show_page=True) as (node, publisher, _):
            return run_until_signal(node, publisher)


def run_demo(out: Path, on_window: Callable[[WindowReport], None]) -> tuple[Summary, Traits, int]:
    """Run it all; writes side_by_side.mp4 and .png into `out`.

    Returns:
        How it went, the model, and how many pictures arrived in the other process.
    Raises:
        NodeError: the second process did not come up, or nothing arrived in it.
    """
    make_folder(out)  # to know at once
    inputs: dict[int, Sequence[Image]] = {}
    models: list[Traits] = []

    def remember(report: WindowReport) -> None:
        inputs[report.window.window_id] = list(report.window.images)
        on_window(report)

    with tempfile.TemporaryDirectory(prefix="gcd-demo-") as name:
        received = Path(name) / "received"
        session = open_session(demo_config(Path(name)), once=True, on_configured=models.append, on_window=remember)
        with session as (node, publisher, _), _receiver(publisher, received) as receiver:
            summary = run_until_signal(node, publisher)
            publisher.close()
            try:
                receiver.wait(_RECEIVER_TIMEOUT_S)  # it ends by itself after the stream, with everything saved
            except subprocess.TimeoutExpired as error:
                hint = "try `gcd-node view` by hand to see why"
                raise NodeError(f"the receiving process outlives the stream by {error.timeout:g} s; {hint}") from error
        shown = list(moments(inputs, received / VIEW_ID))
    if not shown:
        raise NodeError("nothing arrived in the receiving process; run `gcd-node -v demo` to see why")
    classes = ontology(models[0])
    write_video(out / "side_by_side.mp4", [comparison([moment], classes) for moment in shown], summary.fps)
    write_png(out / "side_by_side.png", comparison([shown[i] for i in spread(len(shown), 4)], classes))
    return summary, models[0], len(shown)


@contextmanager
def _receiver(publisher: Publisher, folder: Path) -> Generator[subprocess.Popen[bytes]]:
    """`gcd-node view` in a process of its own, subscribed before this returns."""
    command = [sys.executable, "-m", "gcd_node", "view", publisher.endpoint, "--view", VIEW_ID, "--kind", "all"]
    command += ["--save", str(folder), "--timeout", str(_RECEIVER_TIMEOUT_S)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)  # noqa: S603
    try:
        until_s = time.monotonic() + _RECEIVER_TIMEOUT_S
        while publisher.stats.subscribers == 0:
            if process.poll() is not None or time.monotonic() > until_s:
                raise NodeError("the receiving process did not subscribe; try `gcd-node view` by hand to see why")
            time.sleep(0.02)
        yield process
    finally:
        process.terminate()
        process.wait()


def moments(inputs: Mapping[int, Sequence[Image]], folder: Path) -> Iterator[Moment]:
    """Input by window beside what `gcd-node view` saved of it; what did not arrive whole is left out."""
    for window, images in sorted(inputs.items()):
        for i, image in enumerate(images):
            name, seen = f"{window:06d}_{i:02d}.png", folder / "vis" / f"{window:06d}.npy"
            pictures = folder / name, folder / "cls" / name
            if all(path.is_file() for path in (*pictures, seen)):
                view, painted = map(read_picture, pictures)
                yield image, view, hatched(view, np.load(seen)[i]), painted


def comparison(shown: Sequence[Moment], classes: Sequence[ClassRecord]) -> Image:
    """A row for each moment under headings, and what the colours mean; photographs are enlarged smoothly, maps without
    new colours."""
    rows = [[enlarged(each, smooth=column < 2) for column, each in enumerate(moment)] for moment in shown]
    return sheet(strip(rows), HEADINGS, classes)
