"""The C++ subscriber, built with the address and undefined-behaviour sanitizers, against a live node and worse.

GCD_MUTATIONS=100000 sends it as many mutated messages.
"""

import json
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count, islice
from pathlib import Path

import numpy as np
import pytest
import zmq
from cameras import until, write_video
from fakes import HEIGHT, WIDTH, FakeSynthesizer, traits
from msgspec.structs import replace
from mutations import BYTE_PIECES, ROUNDS, TEXT_PIECES, Mutator
from numpy.typing import NDArray
from rig import Rig
from wire_messages import OTHER_BOOT, class_map, depth, end, jpeg_window, visibility, window

from gcd_client.images import inverse_depth
from gcd_client.protocol import MAGIC, PREFIX, MessageError, ViewMessage, decode, encode
from gcd_client.subscriber import ReceivedView
from gcd_node.sources import open_source

SOURCE = Path(__file__).parents[2] / "launch" / "clients" / "subscriber.cpp"
FLAGS = ["-std=c++17", "-g", "-Wall", "-Wextra", "-Werror", "-fsanitize=address,undefined"]
FLAGS += ["-fno-sanitize-recover=undefined"]
PATIENCE_S = max(60, ROUNDS // 50)
pytestmark = [pytest.mark.slow, pytest.mark.timeout(2 * PATIENCE_S)]
TOPIC = b"view/top/win".ljust(32, b"\0")


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    look = ["g++", "-E", "-x", "c++", "-include", "zmq.h", "/dev/null"]
    if shutil.which("g++") is None or subprocess.run(look, capture_output=True, check=False).returncode:
        pytest.skip("needs g++ and libzmq3-dev: apt install g++ libzmq3-dev")
    built = tmp_path_factory.mktemp("cpp") / "gcd-subscriber"
    command = ["g++", *FLAGS, str(SOURCE), "-lzmq", "-o", str(built)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    return built


@dataclass
class Client:
    """The program, and a socket that publishes whatever bytes it is told to, and loses none."""

    program: Path
    endpoint: str
    socket: "zmq.Socket[bytes]"

    def start(self, *options: str, endpoint: str = "") -> "subprocess.Popen[str]":
        """Its two outputs in one; every line leaves at once, so that their order is kept."""
        command = [str(self.program), "--endpoint", endpoint or self.endpoint, "--view", "top", *options]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def wait_for(self, topic: bytes = TOPIC) -> None:
        heard = b""
        while heard != b"\1" + topic:  # a reader before may be leaving
            assert self.socket.poll(1000 * PATIENCE_S), "nobody subscribed"
            heard = self.socket.recv()

    def send(self, *parts: bytes) -> None:
        for part in parts:
            self.socket.send(part)

    def told_of(self, *parts: bytes, options: Sequence[str] = ()) -> list[str]:
        """What it says of all these messages, the end of the stream left out."""
        process = self.start("--every", *options)
        self.wait_for()
        self.send(*parts, ENDING)
        *lines, last = lines_of(process)
        assert last == "end view=top kind=win window=0"
        return lines

    def told_of_map(self, message: ViewMessage, folder: Path) -> str:
        """What it says of one message of its kind."""
        kind = message.topic.rpartition("/")[2]
        process = self.start("--every", "--kind", kind, "--timeout", "1", "--ppm", str(folder))
        self.wait_for(message.topic.encode().ljust(32, b"\0"))
        self.send(encode(message))
        return lines_of(process, 69)[0]


@pytest.fixture
def client(program: Path, tmp_path: Path) -> Iterator[Client]:
    context = zmq.Context()
    socket = context.socket(zmq.XPUB)
    socket.set(zmq.SNDHWM, 0)
    socket.set(zmq.XPUB_VERBOSE, 1)
    socket.bind(f"ipc://{tmp_path}/sent")
    yield Client(program, f"ipc://{tmp_path}/sent", socket)
    context.destroy(linger=0)


def lines_of(process: "subprocess.Popen[str]", code: int = 0) -> list[str]:
    out, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == code, out  # a sanitizer ends with a report and a code of its own
    return out.splitlines()


def fields_of(line: str) -> dict[str, str]:
    return dict(word.partition("=")[::2] for word in line.split())


def sent(message: ViewMessage, sequence: int) -> bytes:
    return encode(replace(message, sequence=sequence))


ENDING = encode(replace(end(), sequence=1000))


def fnv(image: NDArray[np.uint8]) -> str:
    number = 0xCBF29CE484222325
    for byte in image.tobytes():
        number = (number ^ byte) * 0x100000001B3 % 2**64
    return f"{number:016x}"


def test_both_languages_read_the_same_from_a_live_node(client: Client, tmp_path: Path) -> None:
    frames = [np.random.default_rng(i).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8) for i in range(86)]
    write_video(tmp_path / "v.mkv", frames, 10.0)
    (tmp_path / "pictures").mkdir()
    source, endpoint = f'path = "{tmp_path}/v.mkv"\npace = "lockstep"', f"ipc://{tmp_path}/data"
    # valid for 8 s: a slow machine must not let them expire
    more = "window = {fps = 5.0, stride = 20}\npublish = {min_subscribers = 3}"
    model = FakeSynthesizer(traits("driving"))
    with Rig(tmp_path, open_source, model, config=source, views="[view.top]", more=more, once=True) as rig:
        every = client.start("--every", "--ppm", str(tmp_path / "pictures"), endpoint=endpoint)
        newest = client.start(endpoint=endpoint)
        until(lambda: rig.ended)
    views = rig.of("top")
    assert len(views) == 2
    *lines, last = lines_of(every)
    assert [fields_of(line) | {"age_ms": ""} for line in lines] == [expected(view) for view in views]
    for line, view in zip(lines, views, strict=True):
        assert float(fields_of(line)["age_ms"]) >= view.header.age_ms - 0.1
        for number, image in enumerate(view.images):
            path = tmp_path / "pictures" / f"top_win_{view.header.window_id:06}_{number:02}.ppm"
            assert path.read_bytes() == b"P6\n%d %d\n255\n" % (WIDTH, HEIGHT) + image.tobytes()
    assert last == "end view=top kind=win window=1"
    *_, newest_view, newest_end = lines_of(newest)
    assert newest_end == last
    assert fields_of(newest_view)["hash"] == fnv(views[-1].images[-1])  # a conflated reader has the last window


def expected(view: ReceivedView) -> dict[str, str]:
    """What the client must say of a view that Python has received; without the age."""
    header = view.header
    told = {"view": "top", "kind": "win", "window": header.window_id, "seq": view.message.sequence, "skipped": 0}
    told |= {"rev": header.view_rev, "age_ms": "", "shape": "x".join(map(str, header.shape)), "encoding": "rgb8"}
    told["mean"] = ",".join(f"{level:.2f}" for level in view.images.mean(axis=(0, 1, 2)))
    told |= {"hash": fnv(view.images[-1]), "roles": "in_transit*13,at_goal*1", "synthetic": "true"}
    return {key: str(value) for key, value in told.items()}


def test_gaps_restarts_old_revisions_and_old_views_are_noticed(client: Client) -> None:
    parts = [
        sent(window(0, view_rev=3), 10),
        sent(window(1, view_rev=3), 14),
        sent(window(1, view_rev=3), 14),
        sent(window(2, view_rev=2), 15),
        sent(window(3, boot_id=OTHER_BOOT), 0),
    ]
    lines = client.told_of(*parts)
    assert [line.split()[0] for line in lines] == [*["view=top"] * 2, *["dropped"] * 2, "restarted", "view=top"]
    assert [fields_of(lines[i])["skipped"] for i in (0, 1, 5)] == ["0", "3", "0"]
    ahead, long_ago = window(1, age_ms=5000.0), window(2)  # a clock ahead makes nothing younger
    ahead = replace(ahead, header=replace(ahead.header, t_publish_ns=ahead.header.t_publish_ns + 3_600_000_000_000))
    long_ago = replace(long_ago, header=replace(long_ago.header, t_publish_ns=1_700_000_000_000_000_000))
    lines = client.told_of(sent(ahead, 1), sent(long_ago, 2), sent(window(3, age_ms=50_000_000.0), 3))
    assert fields_of(lines[0])["age_ms"] == "5000.0"
    assert lines[1].startswith("dropped")
    assert float(fields_of(lines[2])["age_ms"]) >= 50_000_000
    (line,) = client.told_of(sent(window(4, age_ms=50_000_000.0), 4), options=["--max-age-ms", "40000000"])
    assert line.startswith("dropped")


def test_jpeg_is_written_as_it_came_and_maps_as_grey(client: Client, tmp_path: Path) -> None:
    message = jpeg_window()
    told = fields_of(client.told_of(sent(message, 0), options=["--ppm", str(tmp_path)])[0])
    assert (told["encoding"], told["mean"], told["hash"]) == ("jpeg", "-", "-")
    written = b"".join((tmp_path / f"top_win_000000_0{i}.jpg").read_bytes() for i in range(2))
    assert written == message.payload
    for kind, made in (("cls", class_map), ("vis", visibility)):
        message = made(5)
        told = fields_of(client.told_of_map(message, tmp_path))
        assert (told["kind"], told["shape"], told["encoding"]) == (kind, "2x4x6x1", "class8")
        assert (tmp_path / f"top_{kind}_000005_01.pgm").read_bytes() == b"P5\n6 4\n255\n" + bytes(message.payload[24:])


def test_every_depth_is_read_as_in_python_and_one_that_is_none_dropped(client: Client, tmp_path: Path) -> None:
    every = np.arange(0x7C00, dtype="<u2").view("<f2").reshape(2, 128, 124)  # all halves that are finite and positive
    message = depth(5, inverse=every)
    told = fields_of(client.told_of_map(message, tmp_path))
    assert float(told["mean"]) == pytest.approx(inverse_depth(message).mean(dtype=np.float64), abs=1e-5)
    for index in range(2):
        head, pixels = (tmp_path / f"top_depth_000005_0{index}.pfm").read_bytes().split(b"-1.0\n", 1)
        assert head == b"Pf\n124 128\n"
        assert np.array_equal(np.frombuffer(pixels, "<f4").reshape(128, 124)[::-1], inverse_depth(message)[index])
    for value in (-0.5, np.nan, np.inf):
        wrong = depth(inverse=np.array([[[0.5, value]]], "<f2"))
        assert client.told_of_map(wrong, tmp_path).endswith("rule=7: inverse depth is negative or not finite")


def header_of(part: bytes) -> bytes:
    return part[64 : 64 + 16 * int.from_bytes(part[36:38], "little")]


def joined(header: bytes, payload: bytes, *, flags: int = 5, sequence: int = 0) -> bytes:
    """A message whose sizes are right, whatever the header says; without a checksum."""
    padded = header.ljust(-(-len(header) // 16) * 16)
    return PREFIX.pack(TOPIC, MAGIC, len(padded) // 16, flags, len(payload), sequence, 0, 0) + padded + payload


FRESH = window()  # for as long as the tests may take
GOOD = encode(replace(FRESH, header=replace(FRESH.header, valid_for_ms=3_600_000)))
PIXELS = GOOD[64 + len(header_of(GOOD)) :]


def edited(changes: dict[str, object], *, without: str = "", flags: int = 5) -> bytes:
    header = {key: value for key, value in json.loads(header_of(GOOD)).items() if key != without}
    return joined(json.dumps(header | changes).encode(), PIXELS, flags=flags)


BROKEN = [  # by the first rule of the protocol that it breaks
    (1, GOOD[:63]),
    (1, GOOD[:32] + b"GCD2" + GOOD[36:]),
    (2, GOOD + b"x"),
    (2, GOOD[:40] + b"\xff" * 8 + GOOD[48:]),
    (3, GOOD[:-1] + bytes([GOOD[-1] ^ 1])),
    (5, joined(b"{]", b"")),
    (5, joined(b"{}{}", b"")),
    (5, joined(b'{"a":' + b"[" * 1000 + b"]" * 1000 + b"}", b"")),
    (6, edited({}, without="age_ms")),
    (6, joined(header_of(GOOD).replace(b"40.5", b"1e999"), PIXELS)),
    *((7, edited({}, flags=flags)) for flags in (1, 6, 7)),
    *((7, edited({"encoding": "jpeg", "offsets": offsets})) for offsets in ([0, 144, 144], [1, 10, 144])),
]
WRONG_VALUES = {  # of header keys, as JSON, by the same
    5: '{"proto": "gcd/2.0"}',
    6: '{"age_ms": "40", "view_rev": 1.5, "window_id": 9007199254740992, "boot_id": "0123", "t_publish": [1, -1],'
    '"shape": [0, 4, 6, 3], "encoding": "png", "frame_role": ["at_goal", "lost"], "layout": "TCHW", "dtype": "f16"}',
    7: '{"view_id": "other", "shape": [65535, 65535, 65535, 3], "frame_role": ["at_goal"], "offsets": [0, 10, 144],'
    '"encoding": "mono8"}',
}
for rule, values in WRONG_VALUES.items():
    BROKEN += [(rule, edited({key: value})) for key, value in json.loads(values).items()]


def test_each_rule_of_the_protocol_drops_its_message_in_both_languages(client: Client) -> None:
    *lines, last = client.told_of(*(part for _, part in BROKEN), GOOD)
    for line, (rule, part) in zip(lines, BROKEN, strict=True):
        assert f"rule={rule}: " in line
        with pytest.raises(MessageError):
            decode(part)
    assert last.startswith("view=top")
    process = client.start("--every")
    client.wait_for()
    client.socket.send_multipart([GOOD, sent(window(1), 1)])  # in parts it is none
    client.send(sent(window(2), 2), ENDING)
    lines = lines_of(process)
    assert ["rule=1: " in line for line in lines[:3]] == [True, True, False]
    assert fields_of(lines[2])["window"] == "2"


def test_hundreds_of_mutated_messages_crash_nothing_and_what_python_accepts_is_accepted(client: Client) -> None:
    parts = [*islice(mutated_messages(), ROUNDS // 2), *islice(mutated_headers(), ROUNDS // 2)]
    lines = [line for line in client.told_of(*parts) if not line.startswith("restarted")]
    accepted = 0
    for part, line in zip(parts, lines, strict=True):
        dropped = line.partition("rule=")[2][:2] in {f"{rule}:" for rule in range(1, 8)}
        try:
            known = isinstance(decode(part), ViewMessage)
        except MessageError:
            known = False
        accepted += known
        if known or part[56:60] != b"\0\0\0\0":  # with a checksum, both look at the same bytes
            assert dropped != known, (line, part)
    assert accepted > ROUNDS // 20


def mutated_messages() -> Iterator[bytes]:
    """Changed anywhere; only those that reach a subscriber of the topic, and none that may end the stream."""
    inputs = Mutator(1, [GOOD, encode(jpeg_window())], BYTE_PIECES)
    while True:
        part = inputs.next()
        if part[:32] == TOPIC and not (part[38:39] or b"\0")[0] & 2:
            yield part


def mutated_headers() -> Iterator[bytes]:
    """Changed in the header alone; sizes are right, so that it is read."""
    examples = [GOOD, encode(jpeg_window())]
    inputs = Mutator(2, [header_of(part) for part in examples], TEXT_PIECES)
    for sequence in count():
        header = inputs.next()
        nearest = min(examples, key=lambda part: abs(len(header_of(part)) - len(header)))
        yield joined(header, nearest[64 + len(header_of(nearest)) :], sequence=sequence)


def test_silence_ends_it_if_wanted_and_a_signal_and_the_runtime_folder_is_found(client: Client, tmp_path: Path) -> None:
    environment = os.environ | {"RUNTIME_DIRECTORY": f"{tmp_path}:/other"}
    command = [client.program, "--timeout", "0.2"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, env=environment, check=False)
    assert (done.returncode, f"ipc://{tmp_path}/data" in done.stderr) == (69, True)
    for number in (signal.SIGINT, signal.SIGTERM):
        process = client.start()
        client.wait_for()
        process.send_signal(number)
        assert lines_of(process) == []
