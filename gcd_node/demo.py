"""The demo: the packaged drive through the model, over ZeroMQ into a second process, and pictures of what arrived."""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from gcd_node.config import ModelSection, NodeConfig, PublishConfig, SourceConfig, ViewConfig
from gcd_node.errors import NodeError
from gcd_node.frame import Image
from gcd_node.model_worker import WindowReport
from gcd_node.node import Summary
from gcd_node.pictures import make_folder, side_by_side, spread, strip, write_png, write_video
from gcd_node.publisher import Publisher
from gcd_node.session import open_session, run_until_signal
from gcd_node.sources import read_picture

VIEW_ID = "topdown"
_RECEIVER_TIMEOUT_S = 60.0
_STRIP_FRAMES = 7


@dataclass(frozen=True, kw_only=True, slots=True)
class DemoReport:
    """How the demo went. received: windows that arrived in the other process. noise: the weights are random."""

    summary: Summary
    received: int
    noise: bool
    video: Path
    strip: Path


def demo_config(folder: Path) -> NodeConfig:
    """The demo's launch file, with sockets in a folder of its own so that it never meets a running node."""
    return NodeConfig(
        source=SourceConfig(kind="file", path="package:drive.mp4", pace="realtime", hfov_deg=85.0),
        model=ModelSection(weights="random:driving"),
        view={VIEW_ID: ViewConfig(kind="fixed")},
        publish=PublishConfig(data=f"ipc://{folder}/data", status=f"ipc://{folder}/status"),
        node_id="demo",
    )


def run_demo(out: Path, on_window: Callable[[WindowReport], None]) -> DemoReport:
    """Run it all; writes side_by_side.mp4 and strip.png into `out`.

    Raises:
        NodeError: the second process did not come up, or nothing arrived in it.
    """
    make_folder(out)  # to know at once
    inputs: dict[int, Image] = {}

    def remember(report: WindowReport) -> None:
        inputs[report.window.window_id] = report.window.images
        on_window(report)

    with tempfile.TemporaryDirectory(prefix="gcd-demo-") as name:
        folder = Path(name)
        config = demo_config(folder)
        with open_session(config, remember) as (node, publisher), _receiver(publisher, folder / "received") as receiver:
            noise = not node.traits.trained
            summary = run_until_signal(node, publisher)
            publisher.close()
            receiver.wait(_RECEIVER_TIMEOUT_S)
        arrived = _arrived(folder / "received" / VIEW_ID)
    video, still = _write_pictures(out, inputs, arrived, summary.fps)
    return DemoReport(summary=summary, received=len(arrived), noise=noise, video=video, strip=still)


@contextmanager
def _receiver(publisher: Publisher, folder: Path) -> Generator[subprocess.Popen[bytes]]:
    """`gcd-node view` in a process of its own, subscribed before this returns."""
    command = [sys.executable, "-m", "gcd_node", "view", publisher.endpoint, "--view", VIEW_ID, "--save", str(folder)]
    process = subprocess.Popen([*command, "--timeout", str(_RECEIVER_TIMEOUT_S)], stdout=subprocess.DEVNULL)  # noqa: S603
    try:
        deadline = time.monotonic() + _RECEIVER_TIMEOUT_S
        while publisher.stats.subscribers == 0:
            if process.poll() is not None or time.monotonic() > deadline:
                raise NodeError("the receiving process did not subscribe; try `gcd-node view` by hand to see why")
            time.sleep(0.02)
        yield process
    finally:
        process.terminate()
        process.wait()


def _arrived(folder: Path) -> dict[int, list[Image]]:
    """Frames by window, from the pictures the receiver saved as WINDOW_FRAME.png."""
    windows: dict[int, list[Image]] = {}
    for path in sorted(folder.glob("*_*.png")):
        windows.setdefault(int(path.stem.split("_")[0]), []).append(read_picture(path))
    if not windows:
        raise NodeError("no window arrived in the receiving process; run `gcd-node -v demo` to see why")
    return windows


def _write_pictures(
    out: Path, inputs: dict[int, Image], arrived: dict[int, list[Image]], fps: float
) -> tuple[Path, Path]:
    """The video of all windows, and a strip of the last one."""
    video, still = out / "side_by_side.mp4", out / "strip.png"
    pairs = [pair for window in sorted(arrived) for pair in zip(inputs[window], arrived[window], strict=True)]
    write_video(video, [side_by_side(source, view) for source, view in pairs], fps)
    last = pairs[-len(inputs[max(arrived)]) :]
    chosen = [last[i] for i in spread(len(last), _STRIP_FRAMES)]
    write_png(still, strip([[source for source, _ in chosen], [view for _, view in chosen]]))
    return video, still
