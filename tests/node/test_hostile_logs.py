"""Logs and runs made to keep their reader busy for ever, or to fill its memory: each ends in one line, in time."""

import bz2
import json
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import lz4.frame
import pytest
import zstandard
from media import ramp
from robot_logs import COMPRESSED, at, compressed, write_bag, write_log
from rosbags.rosbag2 import CompressionMode
from runs import copied, made_run

from gcd_node.errors import DamagedRunError, SourceError
from gcd_node.replay.compare import compare
from gcd_node.replay.run import MANIFEST, open_run
from gcd_node.sources import log_reader, logs
from gcd_node.sources.log_reader import unfolded
from gcd_node.sources.logs import LogSource

MOST_BYTES = 2**31  # of a process that meets such a log
BIG = 200 * 2**20


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(body)) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def channel(topic: str = "/x", number: int = 1, encoding: str = "json", schema: int = 0) -> bytes:
    return record(4, struct.pack("<HH", number, schema) + text(topic) + text(encoding) + struct.pack("<I", 0))


def message(number: int = 1) -> bytes:
    return record(5, struct.pack("<HIQQ", number, 0, 0, 0))


def chunk(records: bytes, compression: str = "zstd", states: int | None = None) -> bytes:
    folded = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "": bytes}[compression](records)
    head = struct.pack("<QQQI", 0, 0, len(records) if states is None else states, 0)
    return record(6, head + text(compression) + struct.pack("<Q", len(folded)) + folded)


HEAD = b"\x89MCAP0\r\n" + record(1, text("") + text(""))
IMAGES = record(3, struct.pack("<H", 1) + text("sensor_msgs/msg/CompressedImage") + text("ros2msg") + bytes(4))
HOSTILE: dict[str, Callable[[], bytes]] = {
    "a billion tiny records": lambda: chunk(record(200, b"") * (BIG // 9)) * 45,
    "a million empty messages": lambda: channel() + chunk(message() * 1_000_000) * 9,
    "a million empty pictures": lambda: IMAGES + channel("/x", 1, "cdr", 1) + chunk(message() * 1_000_000),
    "a chunk that is larger than it states": lambda: chunk(bytes(2**30), states=1000) * 9,
    "a chunk that is larger than it states, in lz4": lambda: chunk(bytes(2**28), "lz4", states=1000) * 9,
    "a chunk that states a gigabyte": lambda: chunk(bytes(2**30)) * 9,
    "an index without end": lambda: chunk(record(7, struct.pack("<HI", 0, 0xFFFFFFF0)) + bytes(BIG)) * 9,
    "names that unfold to gigabytes": lambda: (
        chunk(b"".join(channel("n" * 60_000 + str(i), i) for i in range(4000))) * 9
    ),
    "notes about itself that unfold to gigabytes": lambda: (
        chunk(record(12, text("gcd-node") + struct.pack("<I", 8 + BIG) + text("") + text("v" * BIG))) * 20
    ),
    "a length of gigabytes": lambda: struct.pack("<BQ", 12, 20) + struct.pack("<I", 0xFFFFFFF0) + bytes(1000),
    "records without end that were never sent": lambda: record(200, b"") * 3_000_000,
    "a summary that points backwards": lambda: channel() + message() + record(2, struct.pack("<QQI", 8, 8, 0)),
}


READER = """
import json, pathlib, sys, time
from gcd_node.sources import logs
logs._SEARCH_S = 0.4
for path in sys.argv[1:]:
    begun = time.monotonic()
    try: logs.LogSource(pathlib.Path(path))
    except logs.SourceError as error: line = str(error)
    taken = next(int(each.split()[1]) for each in open("/proc/self/status") if each.startswith("VmHWM"))
    print(json.dumps([line, time.monotonic() - begun, 1024 * taken]))
"""


def test_hostile_logs_are_refused_in_one_line_in_time_and_memory(tmp_path: Path) -> None:
    paths = [tmp_path / f"{number}.mcap" for number in range(len(HOSTILE))]
    for path, content in zip(paths, HOSTILE.values(), strict=True):
        path.write_bytes(HEAD + content())
    command = [sys.executable, "-c", READER, *map(str, paths)]  # in a process of its own, for its memory
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    for kind, answer in zip(HOSTILE, done.stdout.splitlines(), strict=True):
        line, seconds, most_bytes = json.loads(answer)
        assert "no picture" in line, kind
        assert "\n" not in line, kind
        assert len(line) < 2000, kind
        assert seconds < 15, kind
        assert most_bytes < MOST_BYTES, kind  # so far


def endless(path: Path) -> Path:
    """Three pictures, and then records without end, as time goes here."""
    data = write_log(path, ramp(3)).read_bytes()
    path.write_bytes(data[: data.rindex(struct.pack("<BQ", 15, 4))] + chunk(record(200, b"") * 10_000_000))
    return path


def test_a_log_whose_pictures_never_come_again_plays_and_then_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logs, "_SEARCH_S", 0.5)
    log = LogSource(endless(tmp_path / "log.mcap"))  # what is known of them is enough to open it
    frames = log.frames()
    assert len(list(islice(frames, 3))) == 3
    with pytest.raises(SourceError):
        next(frames)
    frames = log.frames()
    next(frames)
    log.close()
    assert list(frames) == []


def test_what_a_strange_run_states_takes_neither_time_nor_memory(tmp_path: Path) -> None:
    golden = made_run(tmp_path / "golden")
    lies = {"config": "a" + ".a" * 20_000 + "=1", "size": {"frames": 14, "height": 10**6, "width": 10**6}}
    for key, value in lies.items():
        run = copied(golden, tmp_path / key)
        manifest = json.loads((run / MANIFEST).read_text())
        (run / MANIFEST).write_text(json.dumps(manifest | {key: value}))
        with pytest.raises(DamagedRunError):
            compare(golden, open_run(run))
    with (tmp_path / "config" / MANIFEST).open("r+b") as file:
        file.truncate(2**30)  # a sparse file
    with pytest.raises(DamagedRunError):
        open_run(tmp_path / "config")


def test_a_play_list_in_the_place_of_a_video_is_not_followed(tmp_path: Path) -> None:
    golden = made_run(tmp_path / "golden")
    run = copied(golden, tmp_path / "run")
    (run / "main.mkv").write_text("#EXTM3U\n#EXTINF:10,\nhttp://127.0.0.1:1/video.ts\n")
    with pytest.raises(DamagedRunError):
        compare(golden, open_run(run))


@pytest.mark.parametrize("kind", ["zstd", "lz4", "bz2"])
def test_what_is_packed_unfolds_to_so_much_and_no_more(kind: str) -> None:
    fold = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "bz2": bz2.compress}[kind]
    assert unfolded(fold(bytes(1000)), kind, 1000) == bytes(1000)
    with pytest.raises(SourceError):
        unfolded(fold(bytes(1001)), kind, 1000)
    if kind == "zstd":  # a second frame behind the first
        with pytest.raises(SourceError):
            unfolded(fold(bytes(600)) + fold(bytes(600)), kind, 1000)


@pytest.mark.parametrize("name", ["log.bag", "message", "file"])
def test_a_bag_that_unfolds_to_more_than_it_may_is_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = [("/front/image", COMPRESSED, compressed(image, at(i))) for i, image in enumerate(ramp(3))]
    mode = {"message": CompressionMode.MESSAGE, "file": CompressionMode.FILE}.get(name, CompressionMode.NONE)
    path = write_bag(tmp_path / name, sent, compression=mode, folded=True)
    assert len(list(LogSource(path).frames())) == 3
    monkeypatch.setattr(log_reader, "MAX_BYTES", 500)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    with pytest.raises(SourceError):
        list(LogSource(path).frames())
