"""A short soak, and what a soak would call a leak."""

import json
import socket
import threading
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from cameras import until

from gcd_node.cli import soak as cli_soak
from gcd_node.cli.main import run_app
from gcd_node.load.clients import hostile, reader
from gcd_node.load.hostile import Attacker
from gcd_node.load.meter import holding, memory_mb, open_files, percentile
from gcd_node.load.soak import Sample, SoakOptions, run_soak
from gcd_node.load.soak_report import Growth, SoakLimits, SoakReport, findings, growth, spread
from gcd_node.load.zmtp import GREETING, message, ready
from gcd_node.publisher import Publisher
from gcd_node.publishing.options import PublisherOptions
from gcd_node.subscriber import ViewSubscriber

SECONDS = 12.0
FLAT = Growth(first=10.0, last=10.0, peak=12.0)
GOOD = SoakReport(
    seconds=3600.0,
    memory_mb=Growth(first=400.0, last=410.0, peak=450.0),
    threads=FLAT,
    files=FLAT,
    subscriptions=FLAT,
    median_age_ms=FLAT,
    age_ms=spread([10.0, 12.0]),
    reply_ms=spread([1.0]),
    backlog_windows=1,
    windows=2,
    arrived=2,
    skipped=0,
    silent_s=10.0,
    openings=1,
    restarts=0,
    unanswered=0,
    refused=0,
    acts={},
    codes={"OK": 5, "WRONG_STATE": 3},
    attacks={},
    left=(),
    failures=(),
)


# --- a short one -------------------------------------------------------------------------------------------------


@pytest.mark.timeout(600)
def test_a_short_soak_leaves_nothing_behind_and_the_node_alive() -> None:
    seen: list[Sample] = []
    report = run_soak(SoakOptions(hours=SECONDS / 3600, width=96, height=64, seed=1), seen.append)
    assert (report.failures, report.left) == ((), ())
    assert report.seconds >= SECONDS
    assert len(seen) > 10
    assert report.arrived > 0
    assert report.windows >= report.arrived
    assert sum(report.acts.values()) > 3
    assert sum(report.attacks.values()) > 10
    assert report.codes["OK"] > 0
    assert report.restarts > 0
    assert "INTERNAL" not in report.codes
    assert report.memory_mb.peak > 50
    assert report.memory_mb.growth < 100
    assert report.threads.growth < 8
    assert report.subscriptions.growth == 0
    assert report.files.growth < 40


# --- what a leak is ----------------------------------------------------------------------------------------------


def test_a_good_soak_has_no_findings() -> None:
    assert findings(GOOD, SoakLimits()) == ()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"memory_mb": Growth(first=400.0, last=425.0, peak=425.0)}, "memory grew by 25.0 MiB, from 400.0 to 425.0"),
        ({"threads": Growth(first=10.0, last=13.0, peak=13.0)}, "threads grew by 3.0"),
        ({"files": Growth(first=40.0, last=90.0, peak=90.0)}, "open files grew by 50.0"),
        ({"subscriptions": Growth(first=3.0, last=4.0, peak=9.0)}, "subscriptions grew by 1.0"),
        ({"subscriptions": Growth(first=3.0, last=1.0, peak=9.0)}, "subscriptions fell by 2"),
        ({"median_age_ms": Growth(first=20.0, last=2000.0, peak=2000.0)}, "the median age grew by 1980.0 ms"),
        ({"memory_mb": Growth(first=float("nan"), last=float("nan"), peak=0.0)}, "memory grew by nan"),
        ({"backlog_windows": 2}, "a window waited for 2 windows' time"),
        ({"silent_s": 100.0}, "no view for 100 s"),
        ({"unanswered": 1}, "1 requests stayed without a reply"),
        ({"codes": {"INTERNAL": 2}}, "2 requests ended as INTERNAL"),
        ({"left": ("thread 'x'",)}, "left after the end: thread 'x'"),
        ({"failures": ("the node ended",)}, "the node ended"),
    ],
)
def test_what_is_not_as_it_should_be_is_a_finding(changes: dict[str, object], words: str) -> None:
    (found,) = findings(replace(GOOD, **changes), SoakLimits())  # type: ignore[arg-type]
    assert words in found


def test_growth_is_measured_once_things_have_settled() -> None:
    at_s = [float(i) for i in range(100)]
    begins = [500.0] * 10 + [100.0] * 80 + [110.0] * 10
    assert growth(at_s, begins, share=0) == Growth(first=100.0, last=100.0, peak=500.0)
    leaks = [100.0 + i for i in range(100)]
    assert growth(at_s, leaks, share=50).growth == pytest.approx(60.0, abs=1.0)


def test_a_floor_does_not_see_what_comes_and_goes() -> None:
    at_s = [float(i) for i in range(100)]
    busy = [5.0 + 7 * (i % 3) for i in range(100)]
    assert growth(at_s, busy, share=0).growth == 0
    assert growth([], [], share=0) == Growth(first=0.0, last=0.0, peak=0.0)


def test_figures_of_nothing_are_no_numbers() -> None:
    none = spread([])
    assert none.count == 0
    assert none.p50 != none.p50
    assert percentile([3.0, 1.0, 2.0], 99) == 3.0


# --- the meter ---------------------------------------------------------------------------------------------------


def test_the_meter_sees_threads_files_and_memory() -> None:
    before, release = holding(), threading.Event()
    thread = threading.Thread(target=release.wait)
    thread.start()
    with socket.socket() as opened:
        now = holding()
        assert open_files()[opened.fileno()].startswith("socket:")
    grown = bytearray(50_000_000)
    grown[::4096] = b"x" * len(grown[::4096])
    assert memory_mb() > now.memory_mb + 30
    release.set()
    thread.join()
    assert (now.threads, now.files) == (before.threads + 1, before.files + 1)


# --- clients -----------------------------------------------------------------------------------------------------


@contextmanager
def deaf_server(path: Path) -> Generator[str]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as server:
        server.bind(str(path))
        server.listen()
        yield f"ipc://{path}"


def test_every_attack_survives_a_server_that_is_not_there(tmp_path: Path) -> None:
    nobody = [f"ipc://{tmp_path}/{name}" for name in ("data", "status", "control")]
    attacker = Attacker(*nobody, seed=1)
    for _ in range(100):
        attacker.attack()
    assert attacker.refused == attacker.done.total() == 100
    assert len(attacker.done) == 10


@pytest.mark.timeout(600)
def test_a_client_ends_with_whoever_started_it(tmp_path: Path) -> None:
    with deaf_server(tmp_path / "s") as endpoint, reader(endpoint, "top") as client:
        assert client.alive
        assert client.last is None
    assert not client.alive
    nobody = f"ipc://{tmp_path}/nobody"
    with hostile(nobody, nobody, nobody, 0) as attacker:
        assert attacker.alive
    assert not attacker.alive


def test_who_takes_back_what_nobody_asked_for_makes_no_reader_disappear(tmp_path: Path) -> None:
    options = PublisherOptions(data=f"ipc://{tmp_path}/data", status=None, linger_ms=0)
    with Publisher(options) as publisher, ViewSubscriber(publisher.endpoint, "top"):
        until(lambda: publisher.stats.subscribers == 1)
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
            link.connect(f"{tmp_path}/data")
            link.sendall(GREETING)
            link.recv(len(GREETING), socket.MSG_WAITALL)
            link.sendall(ready("SUB"))
            link.sendall(3 * message(b"\0never") + message(b"\1once") + message(b"\1then"))
            until(lambda: publisher.stats.subscribers == 3)
        until(lambda: publisher.stats.subscribers == 1)


# --- the command -------------------------------------------------------------------------------------------------


def test_the_command_writes_the_figures_and_ends_with_1_if_something_leaks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    leaky = replace(GOOD, memory_mb=Growth(first=400.0, last=500.0, peak=500.0), age_ms=spread([]))
    asked: list[SoakOptions] = []
    for report, code in ((GOOD, 0), (leaky, 1)):

        def soaked(options: SoakOptions, tell: object, report: SoakReport = report) -> SoakReport:
            asked.append(options)
            return report

        monkeypatch.setattr(cli_soak, "run_soak", soaked)
        assert run_app(["soak", "--hours", "0.5", "--report", str(tmp_path / "soak.json")]) == code
    written = json.loads((tmp_path / "soak.json").read_text())
    out, err = capsys.readouterr()
    assert asked[0] == SoakOptions(hours=0.5)
    assert written["memory_mb"]["last"] == 500.0
    assert written["age_ms"]["p50"] is None
    assert written["findings"][0].startswith("memory grew by 100.0 MiB")
    assert "400.0 to 410.0 (+10.0)" in out
    assert "memory grew by 100.0 MiB" in err


def test_the_command_prints_json_and_refuses_a_file_it_cannot_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def soaked(options: SoakOptions, tell: object) -> SoakReport:
        return GOOD

    monkeypatch.setattr(cli_soak, "run_soak", soaked)
    assert run_app(["soak", "--hours", "0.5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["windows"] == 2
    assert run_app(["soak", "--report", str(tmp_path / "no" / "soak.json")]) == 73
    assert "cannot write" in capsys.readouterr().err
