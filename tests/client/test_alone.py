"""The client installed alone, in a fresh environment, against a node's publisher and control socket."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from fakes import FakeNode
from wire_messages import end, window

from gcd_node.config import PublishConfig
from gcd_node.publisher import Publisher

CLIENT = Path(__file__).parents[2] / "client"
PROGRAM = """
import importlib.util, sys
from gcd_client import ControlClient, ViewSubscriber
assert not {"numpy", "asyncio", "cv2"} & sys.modules.keys()  # numpy alone takes longer to import than all the rest
data, control = sys.argv[1:]
assert not any(importlib.util.find_spec(name) for name in ("torch", "cv2", "gcd_node", "gcd_model"))
with ViewSubscriber(data, "top", conflate=False) as views:
    print([(view.header.window_id, view.images.shape, int(view.images.sum())) for view in views])
with ControlClient(control) as node:
    print(node.call("views"))
"""


@pytest.mark.slow
def test_the_client_alone_reads_views_and_commands(tmp_path: Path) -> None:
    python, clean = tmp_path / "venv" / "bin" / "python", {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True, timeout=100)
    subprocess.run([python, "-m", "pip", "install", "-q", CLIENT], check=True, timeout=300, env=clean)
    endpoints = PublishConfig(data=f"ipc://{tmp_path}/d", status=f"ipc://{tmp_path}/status", min_subscribers=1)
    with FakeNode().serve(f"ipc://{tmp_path}/c") as server, Publisher(endpoints, lockstep=True) as publisher:
        command = [python, "-c", PROGRAM, publisher.endpoint, server.endpoint]
        reader = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=clean, cwd=tmp_path)
        message = window(4)
        publisher.send(message)
        publisher.end(end(window_id=4))
        out, _ = reader.communicate(timeout=60)
    assert out.splitlines() == [f"[(4, (2, 4, 6, 3), {sum(bytes(message.payload))})]", "{'role': 'operator'}"]
