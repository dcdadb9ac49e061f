"""Rows of the failure table in which processes meet: a reader that sleeps, SIGTERM.

See test_faults.py for the others.
"""

import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fakes import FakeSynthesizer, Steady, traits
from media import environment
from recordings import files, of, said, summary
from rig import Rig
from wire_messages import start_reader

from gcd_client.subscriber import ViewSubscriber

REALTIME = 'kind = "synthetic"\npace = "realtime"'
SLACK_S = 3.0  # what a machine that does other things may add
START_S = 300.0  # the same for starting a process; shorter than a model hangs
END_S = 5.0 + 30.0  # and for ending one

pytestmark = pytest.mark.timeout(2 * START_S)


def test_f9_a_stalled_reader_disturbs_nobody(tmp_path: Path) -> None:
    model = FakeSynthesizer(traits(), lambda _: model.clips.clear())  # keeps none: memory is measured
    with Rig(tmp_path, lambda _: Steady(), model, config=REALTIME) as rig:
        reader = start_reader(f"ipc://{tmp_path}/data", "main")
        try:
            assert reader.stdout is not None
            assert reader.stdout.readline()
            reader.send_signal(signal.SIGSTOP)
            begun, before_kb = len(rig.of()), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            rig.await_views(begun + 60)  # 15 MB
            after_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            reader.send_signal(signal.SIGCONT)
            newest = rig.of()[-1].header.window_id
            seen: list[int] = []  # what it printed before it was stopped comes first
            while not seen or seen[-1] < newest:
                seen.append(int(reader.stdout.readline().split()[0]))
        finally:
            reader.kill()
            reader.communicate()
        healthy = rig.of()[begun : begun + 60]
    assert sum(view.skipped for view in healthy) == 0
    assert sorted(view.age_ms for view in healthy)[30] < 50 + 1000 * SLACK_S
    assert after_kb - before_kb < 64 * 1024
    assert sum(begun < window_id < newest for window_id in seen) <= 10  # of 60 it slept through


def test_f23_sigterm_ends_every_view_and_the_process_with_0(tmp_path: Path) -> None:
    launch = tmp_path / "launch.toml"
    launch.write_text(f"""
        [source]
        kind = "synthetic"
        pace = "lockstep"
        [model]
        weights = "random:driving"
        steps = 1
        [view.main]
        [publish]
        data = "ipc://{tmp_path}/data"
        status = "ipc://{tmp_path}/status"
        min_subscribers = 1
        [control]
        endpoint = "ipc://{tmp_path}/control"
        [record]
        folder = "{tmp_path}/recordings"
        keep_free_mb = 0
        autostart = true
    """)
    with ViewSubscriber(f"ipc://{tmp_path}/data", "main", conflate=False) as views:
        command = [sys.executable, "-m", "gcd_node", "run", str(launch)]
        node = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        try:
            assert views.receive(1000 * START_S) is not None
            node.send_signal(signal.SIGTERM)
            while views.receive(1000 * START_S) is not None:
                pass
            assert views.ended
            views.close()
            assert node.wait(END_S) == 0
            (recording,) = files(tmp_path / "recordings")
            assert summary(recording).chunk_indexes  # it was finished
            assert of(said(recording), "/view/main/image")
        finally:
            node.kill()
            node.communicate()


@pytest.fixture(scope="module")
def hung(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, "subprocess.Popen[str]"]]:
    """Nodes that hang, begun all at once: each takes its time to start and to end."""
    script, begun = str(Path(__file__).with_name("hung_process.py")), {}
    for phase in ("load", "render"):
        command = [sys.executable, script, str(tmp_path_factory.mktemp(phase)), phase]
        begun[phase] = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment())
    yield begun
    for node in begun.values():
        node.kill()
        node.communicate()


def test_f23_a_model_that_hears_nothing_does_not_hold_up_the_end(hung: dict[str, "subprocess.Popen[str]"]) -> None:
    node = hung["load"]
    assert node.stdout is not None
    assert node.stdout.readline() == "hangs\n"
    node.send_signal(signal.SIGTERM)
    assert node.wait(END_S) == 0
    assert "left behind" in node.stdout.read()


def test_f23_a_second_sigterm_ends_the_process_at_once(hung: dict[str, "subprocess.Popen[str]"]) -> None:
    node = hung["render"]
    assert node.stdout is not None
    assert node.stdout.readline() == "hangs\n"
    node.send_signal(signal.SIGTERM)
    time.sleep(0.3)
    node.send_signal(signal.SIGTERM)
    assert node.wait(END_S) == -signal.SIGTERM
    assert "left behind" not in node.stdout.read()
