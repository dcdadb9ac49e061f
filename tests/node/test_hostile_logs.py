"""Logs and runs made to keep their reader busy for ever: each ends in an error that says what was looked for."""

import json
import struct
import threading
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import pytest
import zstandard
from media import ramp
from robot_logs import write_log
from runs import copied, made_run

from gcd_node.cli.main import run_app
from gcd_node.errors import DamagedRunError, SourceError
from gcd_node.replay.run_diff import compare
from gcd_node.replay.run_folder import MANIFEST, open_run
from gcd_node.sources import mcap_log, mcap_survey, own_recording
from gcd_node.sources.log_patience import LogPatience, TiredError
from gcd_node.sources.mcap_container import MAGIC
from gcd_node.sources.mcap_log import McapLog

RECORDS = 1000
"""What may be gone through here."""


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(body)) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def channel(topic: str = "/x", number: int = 1) -> bytes:
    return record(4, struct.pack("<HH", number, 0) + text(topic) + text("json") + struct.pack("<I", 0))


def message(number: int = 1) -> bytes:
    return record(5, struct.pack("<HIQQ", number, 0, 0, 0))


def chunk(records: bytes, compression: str = "zstd") -> bytes:
    folded = zstandard.compress(records) if compression else records
    head = struct.pack("<QQQI", 0, 0, len(records), 0)
    return record(6, head + text(compression) + struct.pack("<Q", len(folded)) + folded)


ENDLESS: dict[str, Callable[[], bytes]] = {
    "messages of another topic": lambda: channel() + chunk(message() * 10 * RECORDS),
    "messages of no channel": lambda: chunk(message(9) * 10 * RECORDS),
    "records nobody wants": lambda: chunk(record(7, b"") * 10 * RECORDS),
    "channels of long names": lambda: chunk(channel("x" * 1000) * 3 * RECORDS),
    "chunks": lambda: chunk(message(9), "") * 2 * RECORDS,
    "notes about itself": lambda: record(12, text("n") + struct.pack("<I", 0)) * 3 * RECORDS,
    "private records": lambda: record(200, b"") * 3 * RECORDS,
}


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (mcap_survey, mcap_log, own_recording):
        monkeypatch.setattr(module, "_MOST_RECORDS", RECORDS)


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("kind", ENDLESS)
def test_a_log_of_endless_nothing_is_given_up(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(MAGIC + ENDLESS[kind]())
    with pytest.raises(SourceError, match=f"no pictures that can be played were found in the first {RECORDS} records"):
        McapLog(path)
    with pytest.raises(SourceError, match="no pictures on '/front' that can be played") as caught:
        McapLog(path, topic="/front")
    assert "mcap filter LOG -y TOPIC" in str(caught.value)
    assert len(str(caught.value)) < 2000


def test_a_summary_that_points_backwards_is_not_followed(tmp_path: Path) -> None:
    footer = record(2, struct.pack("<QQI", len(MAGIC), len(MAGIC), 0))
    (tmp_path / "log.mcap").write_bytes(MAGIC + channel() + message() + footer + MAGIC)
    with pytest.raises(SourceError, match="holds no pictures; its topics are /x"):
        McapLog(tmp_path / "log.mcap")


@pytest.mark.usefixtures("impatient")
def test_a_folder_of_such_logs_is_given_up_as_one(tmp_path: Path) -> None:
    for number in range(3):
        (tmp_path / f"{number}.mcap").write_bytes(MAGIC + ENDLESS["private records"]())
    with pytest.raises(SourceError, match="is a folder"):
        McapLog(tmp_path)


def pictures_then_nothing(path: Path, count: int = 3) -> Path:
    """Pictures, and then records without end, by the measure of `impatient`."""
    data = write_log(path, ramp(count)).read_bytes()
    path.write_bytes(data[: data.rindex(struct.pack("<BQ", 15, 4))] + ENDLESS["records nobody wants"]())
    return path


@pytest.mark.usefixtures("impatient")
def test_a_log_whose_pictures_never_come_again_plays_and_then_fails(tmp_path: Path) -> None:
    log = McapLog(pictures_then_nothing(tmp_path / "log.mcap"))  # what is known of them is enough to open it
    frames = log.frames()
    assert len(list(islice(frames, 3))) == 3
    with pytest.raises(SourceError, match=f"after 3 pictures on .* none came in {RECORDS} records") as caught:
        next(frames)
    assert "mcap filter LOG -y" in str(caught.value)


def test_a_log_can_be_closed_while_it_gives_nothing(tmp_path: Path) -> None:
    log = McapLog(pictures_then_nothing(tmp_path / "log.mcap"))
    frames = log.frames()
    next(frames)
    log.close()
    assert list(frames) == []
    stopped = threading.Event()
    patience = LogPatience(records=10**9, seconds=1e9, stopped=stopped.is_set)
    for _ in range(50):
        patience.spend()
    stopped.set()
    with pytest.raises(TiredError):
        patience.spend()


def test_patience_ends_by_records_or_by_time_and_begins_anew_with_each_find() -> None:
    now = [0.0]
    patience = LogPatience(records=3, seconds=10.0, clock=lambda: now[0])
    for _ in range(2):
        for _ in range(3):
            patience.spend()
        with pytest.raises(TiredError, match=r"^3 records in 0 s$"):
            patience.spend()
        patience.renew()
    patience.spend()
    now[0] = 10.5
    with pytest.raises(TiredError, match=r"^1 records in 10 s$"):
        patience.spend()


@pytest.mark.usefixtures("impatient")
def test_the_replay_of_such_a_log_fails_with_its_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "log.mcap").write_bytes(MAGIC + ENDLESS["messages of another topic"]())
    launch = tmp_path / "launch.toml"
    launch.write_text(
        f'[source]\nkind = "mcap"\npath = "{tmp_path}/log.mcap"\n[model]\nweights = "none"\n[view.main]\n'
    )
    assert run_app(["replay", str(launch), "--out", str(tmp_path / "run")]) == 66
    assert "no pictures that can be played" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_what_a_strange_run_states_takes_neither_time_nor_memory(tmp_path: Path) -> None:
    golden = made_run(tmp_path / "golden")
    lies: dict[str, tuple[str, object, str]] = {
        "a name of a million parts": ("config", "a" + ".a" * 20_000 + "=1", "names of more than 200 parts"),
        "a window of terabytes": ("size", {"frames": 14, "height": 10**6, "width": 10**6}, "takes more than"),
    }
    for key, value, reason in lies.values():
        run = copied(golden, tmp_path / key)
        manifest = json.loads((run / MANIFEST).read_text())
        (run / MANIFEST).write_text(json.dumps(manifest | {key: value}))
        with pytest.raises(DamagedRunError, match=reason):
            compare(golden, open_run(run))
    with (tmp_path / "config" / MANIFEST).open("r+b") as file:
        file.truncate(2**30)  # a sparse file
    with pytest.raises(DamagedRunError, match="more than 67108864"):
        open_run(tmp_path / "config")


def test_a_play_list_in_the_place_of_a_video_is_not_followed(tmp_path: Path) -> None:
    golden = made_run(tmp_path / "golden")
    run = copied(golden, tmp_path / "run")
    (run / "main.mkv").write_text("#EXTM3U\n#EXTINF:10,\nhttp://127.0.0.1:1/video.ts\n")
    with pytest.raises(DamagedRunError, match="it is no Matroska video"):
        compare(golden, open_run(run))
