"""What only a process of its own can show of the OAK source: aborts, signals, standard output."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gcd_node.errors import SourceError
from gcd_node.sources.oak import load_depthai

try:
    load_depthai()
except SourceError as missing:
    pytest.skip(str(missing), allow_module_level=True)

HERE = Path(__file__).parent


def in_a_process(script: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(HERE), *sys.path])
    return subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )


SIGNALS = """
import os, signal, sys, time
import gcd_node.sources
from gcd_node.sources import oak
assert "depthai" not in sys.modules, "imported before a camera was wanted"
got = []
for number in (signal.SIGTERM, signal.SIGINT):
    signal.signal(number, lambda number, _: got.append(number))

def ours():
    lines = open("/proc/self/status").read().splitlines()
    masks = {line.split(":")[0]: int(line.split()[1], 16) for line in lines if line.startswith(("SigCgt", "SigIgn"))}
    return masks["SigCgt"] & 0x7FFFFFFF, masks["SigIgn"]  # real-time signals are the C library's

before = ours()
import oak_pipelines as pipelines
from contextlib import closing
with closing(oak.open_pipeline(pipelines.Scripted(pipelines.steady()), open_timeout_s=30)) as camera:
    next(camera.frames())
    assert ours() == before, (ours(), before)
    for number in (signal.SIGTERM, signal.SIGINT):
        os.kill(os.getpid(), number)
    time.sleep(0.1)
assert got == [signal.SIGTERM, signal.SIGINT], got
"""


def test_depthai_comes_late_leaves_our_signal_handlers_alone_and_standard_output_clean() -> None:
    ended = in_a_process(SIGNALS)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout == ""
