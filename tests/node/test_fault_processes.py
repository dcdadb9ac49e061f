"""Rows of the failure table as a shell sees them, exit code and line; and those in which processes meet: a reader that
sleeps, SIGTERM. See test_faults.py for the others."""

import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from cameras import environment
from fakes import LOCKSTEP, FakeSource, FakeSynthesizer, Steady, traits, write_tiny
from mcap.reader import make_reader
from rig import Rig, launch_file
from safetensors import safe_open
from safetensors.torch import save_file
from wire_messages import start_reader

from gcd_client.subscriber import ViewSubscriber
from gcd_node import session
from gcd_node.cli.main import run_app

FRAMES = f"{LOCKSTEP}\nframes = 30"
REALTIME = 'kind = "synthetic"\npace = "realtime"'
SLACK_S = 10.0  # what a machine that does other things may add
START_S = 300.0  # the same for starting a process; shorter than a model hangs
END_S = 5.0 + 30.0  # and for ending one

pytestmark = pytest.mark.timeout(2 * START_S)
Outcome = Callable[..., tuple[int, str]]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Outcome:
    """Runs a launch file with this source as the command line does; gives its exit code and what it said."""

    def ran(opened: FakeSource, **launch: str) -> tuple[int, str]:
        monkeypatch.setattr(session, "open_source", lambda *_: opened)
        return run_app(["run", str(launch_file(tmp_path, FRAMES, **launch))]), capsys.readouterr().err

    return ran


def test_f5_a_file_that_ends_is_exit_0_and_one_that_is_too_short_65(
    run: Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "load_model", lambda _: FakeSynthesizer(traits()))
    for frames, code, words in ((30, 0, "windows rendered"), (13, 65, "TOO_SHORT n=13")):
        ended, told = run(FakeSource(frames))
        assert (ended, words in told) == (code, True)


@pytest.mark.parametrize("damage", ["missing", "misshapen"])
def test_f25_weights_that_do_not_fit_are_exit_65_and_five_are_named(run: Outcome, damage: str, tmp_path: Path) -> None:
    with safe_open(write_tiny(tmp_path), "pt") as whole:
        weights = {name: whole.get_tensor(name) for name in whole.keys()}  # noqa: SIM118  it is no dict
        card = whole.metadata()
    count = len(weights)
    spoilt = [name for name in weights if name.endswith(".weight")][:7]
    for name in spoilt:
        weights[name] = torch.zeros(5)
        if damage == "missing":
            del weights[name]
    save_file(weights, tmp_path / "bad.safetensors", card)
    code, told = run(FakeSource(14), weights=f"{tmp_path}/bad.safetensors")
    assert code == 65
    assert f"7 of {count} weights are {damage}" in told
    assert sum(name in told for name in spoilt) == 5


def test_f9_a_stalled_reader_disturbs_nobody(tmp_path: Path) -> None:
    model = FakeSynthesizer(traits(), lambda _: model.clips.clear())  # keeps none: memory is measured
    with Rig(tmp_path, lambda _: Steady(), model, config=REALTIME) as rig:
        reader = start_reader(f"ipc://{tmp_path}/data", "main")
        try:
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


@pytest.mark.slow
def test_f23_sigterm_ends_every_view_and_the_process_with_0(tmp_path: Path) -> None:
    recordings = tmp_path / "recordings"
    more = f'min_subscribers = 1\n[record]\nfolder = "{recordings}"\nkeep_free_mb = 0\nautostart = true'
    command = [sys.executable, "-m", "gcd_node", "run", str(launch_file(tmp_path, FRAMES, more=more))]
    with ViewSubscriber(f"ipc://{tmp_path}/data", "main", conflate=False) as views:
        node = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        try:
            assert views.receive(1000 * START_S) is not None
            node.send_signal(signal.SIGTERM)
            while views.receive(1000 * START_S) is not None:
                pass
            assert views.ended
            views.close()
            assert node.wait(END_S) == 0
            (recording,) = recordings.rglob("*.mcap")
            with recording.open("rb") as file:
                found = make_reader(file).get_summary()
            assert found.chunk_indexes  # it was finished
            assert "/view/main/image" in {each.topic for each in found.channels.values()}
        finally:
            node.kill()
            node.communicate()


@pytest.fixture(scope="module")
def hung(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, "subprocess.Popen[str]"]]:
    """Nodes that hang, begun all at once: each takes its time to start and to end."""
    script, begun = str(Path(__file__).with_name("node_process.py")), {}
    for phase in ("load", "render"):
        command = [sys.executable, script, str(tmp_path_factory.mktemp(phase)), phase]
        begun[phase] = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment())
    yield begun
    for node in begun.values():
        node.kill()
        node.communicate()


@pytest.mark.slow
@pytest.mark.parametrize("phase", ["load", "render"])
def test_f23_a_model_that_hears_nothing_does_not_hold_up_the_end_and_a_second_sigterm_ends_at_once(
    hung: dict[str, "subprocess.Popen[str]"], phase: str
) -> None:
    node = hung[phase]
    assert node.stdout.readline() == "hangs\n"
    node.send_signal(signal.SIGTERM)
    if phase == "render":
        time.sleep(0.3)
        node.send_signal(signal.SIGTERM)
    assert node.wait(END_S) == (0 if phase == "load" else -signal.SIGTERM)
    assert ("left behind" in node.stdout.read()) == (phase == "load")
