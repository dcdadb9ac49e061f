"""How long a process takes from its start to the first view of the packaged model, as a planner sees it."""

import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from msgspec.structs import replace

from gcd_node.config import NodeConfig
from gcd_node.config_text import to_toml
from gcd_node.demo import VIEW_ID, demo_config
from gcd_node.errors import NodeError
from gcd_node.load.meter import percentile
from gcd_node.subscriber import ViewSubscriber

_PATIENCE_S = 120.0
_END_S = 20.0


@dataclass(frozen=True, kw_only=True, slots=True)
class FirstView:
    """count: processes started. median_s, most_s: from the start of one to its first view here."""

    count: int
    median_s: float
    most_s: float


def first_view(starts: int) -> FirstView:
    """Start `gcd-node run` on the packaged drive in realtime, one process after another.

    Raises:
        NodeError: no view came.
    """
    took_s = [_first_view_s() for _ in range(starts)]
    return FirstView(count=starts, median_s=percentile(took_s, 50), most_s=max(took_s))


def _first_view_s() -> float:
    with tempfile.TemporaryDirectory(prefix="gcd-first-") as name:
        config = _config(Path(name))
        launch = Path(name) / "launch.toml"
        launch.write_text(to_toml(config))
        with ViewSubscriber(config.publish.data, VIEW_ID) as views:
            started_s = time.monotonic()
            process = subprocess.Popen(  # noqa: S603
                [sys.executable, "-m", "gcd_node", "run", str(launch)],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            try:
                received = views.receive(1000 * _PATIENCE_S)
                took_s = time.monotonic() - started_s
            finally:
                end_process(process)
    if received is None:
        raise NodeError(f"no first view within {_PATIENCE_S:g} s; see what `gcd-node demo` says")
    return took_s


def _config(folder: Path) -> NodeConfig:
    """launch/demo.toml, with sockets in a folder of its own."""
    config = demo_config(folder)
    return replace(config, source=replace(config.source, pace="realtime"), model=replace(config.model, threads=1))


def end_process(process: "subprocess.Popen[bytes]") -> None:
    """Ask it to end, and make it end if it does not within 20 s."""
    process.terminate()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
