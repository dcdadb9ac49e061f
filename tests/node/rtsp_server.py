"""A real RTSP server on loopback: one MPEG-TS recording, played in time, over RTP interleaved in the TCP connection.

It can fall silent, die and come back on the same port, ask for a password, and begin with pictures that piled up.
"""

import base64
import socket
import struct
import threading
import time
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2

from gcd_node.frame import Image

TS_BYTES = 188
_PACKETS_PER_RTP = 7
_MPEG_TS = 33  # static RTP payload type
_CLOCK_HZ = 90_000


def write_transport_stream(path: Path, images: Iterable[Image], fps: float = 25.0) -> Path:
    """RGB pictures as MPEG-2 in a transport stream."""
    images = list(images)
    height, width = images[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mpg2"), fps, (width, height))
    assert writer.isOpened(), "OpenCV cannot write MPEG-2"
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    writer.release()
    return path


def split_pictures(stream: bytes) -> list[bytes]:
    """The stream in pieces of whole packets, each with one picture. The tables belong to the picture after them."""
    packets = [stream[i : i + TS_BYTES] for i in range(0, len(stream), TS_BYTES)]
    pieces: list[list[bytes]] = [[]]
    seen_video = False
    for packet in packets:
        starts = bool(packet[1] & 0x40)
        is_video = starts and b"\x00\x00\x01\xe0" in packet[4:]
        is_table = starts and not is_video
        if seen_video and (is_video or is_table):
            pieces.append([])
            seen_video = False
        seen_video = seen_video or is_video
        pieces[-1].append(packet)
    return [b"".join(piece) for piece in pieces]


class RtspServer:
    """Serves rtsp://127.0.0.1:PORT/live to any number of clients; every one sees the recording from its beginning."""

    def __init__(self, path: Path, *, fps: float = 25.0, burst: int = 0, password: str | None = None) -> None:
        """burst: so many pictures are sent at once at the start, as a server with a store of them does."""
        self._pictures = split_pictures(path.read_bytes())
        self._fps = fps
        self._burst = burst
        self._password = password
        self._port = 0
        self._silent = threading.Event()
        self._listener: socket.socket | None = None
        self._clients: list[socket.socket] = []
        self.start()

    @property
    def url(self) -> str:
        return f"rtsp://127.0.0.1:{self._port}/live"

    def start(self) -> None:
        """Come (back) to life, on the port of the first time."""
        self._listener = socket.create_server(("127.0.0.1", self._port))
        self._port = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, args=(self._listener,), daemon=True).start()

    def stall(self) -> None:
        """Send no more pictures, but keep every connection."""
        self._silent.set()

    def resume(self) -> None:
        """Go on where it fell silent; what piled up meanwhile is sent at once."""
        self._silent.clear()

    def die(self) -> None:
        """Drop every connection, and refuse new ones until `start`."""
        sockets = [*([self._listener] if self._listener else []), *self._clients]
        self._listener, self._clients = None, []
        for sock in sockets:
            with suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)
            sock.close()

    def _accept(self, listener: socket.socket) -> None:
        with suppress(OSError):
            while True:
                client, _ = listener.accept()
                self._clients.append(client)
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        requests = client.makefile("rb")
        playing = False
        with suppress(OSError, ValueError):
            for method, headers in _requests(requests):
                client.sendall(self._reply(method, headers))
                if method == "PLAY" and not playing:
                    playing = True
                    threading.Thread(target=self._play, args=(client,), daemon=True).start()
                if method == "TEARDOWN":
                    return

    def _reply(self, method: str, headers: dict[str, str]) -> bytes:
        lines = [f"CSeq: {headers.get('cseq', '0')}"]
        if not self._allowed(headers):
            return _message(401, [*lines, 'WWW-Authenticate: Basic realm="camera"'])
        if method == "OPTIONS":
            lines.append("Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN")
        if method == "DESCRIBE":
            return _message(200, [*lines, "Content-Type: application/sdp", f"Content-Base: {self.url}/"], _SDP)
        if method == "SETUP":
            lines += ["Transport: RTP/AVP/TCP;unicast;interleaved=0-1", "Session: 1;timeout=60"]
        if method == "PLAY":
            lines += ["Session: 1", "Range: npt=0.000-"]
        return _message(200, lines)

    def _allowed(self, headers: dict[str, str]) -> bool:
        if self._password is None:
            return True
        scheme, _, given = headers.get("authorization", "").partition(" ")
        with suppress(ValueError):
            return scheme == "Basic" and base64.b64decode(given).decode().partition(":")[2] == self._password
        return False

    def _play(self, client: socket.socket) -> None:
        began, number = time.monotonic(), 0
        with suppress(OSError):
            for index, picture in enumerate(self._pictures):
                due = began + max(0, index - self._burst) / self._fps
                while time.monotonic() < due or self._silent.is_set():
                    time.sleep(0.002)
                for packet in _rtp_packets(picture, number, round(index / self._fps * _CLOCK_HZ)):
                    client.sendall(packet)
                    number += 1


_SDP = "\r\n".join(
    [
        *("v=0", "o=- 0 0 IN IP4 127.0.0.1", "s=test", "c=IN IP4 0.0.0.0", "t=0 0"),
        *(f"m=video 0 RTP/AVP {_MPEG_TS}", f"a=rtpmap:{_MPEG_TS} MP2T/{_CLOCK_HZ}", "a=control:stream0", ""),
    ]
)


def _message(code: int, lines: list[str], body: str = "") -> bytes:
    reason = {200: "OK", 401: "Unauthorized"}[code]
    length = [f"Content-Length: {len(body)}"] if body else []
    return "\r\n".join([f"RTSP/1.0 {code} {reason}", *lines, *length, "", body]).encode()


def _requests(stream: Iterable[bytes]) -> Iterator[tuple[str, dict[str, str]]]:
    """Method and headers of each request. What a client sends of RTCP has no line that looks like one."""
    method, headers = "", {}
    for line in stream:
        text = line.decode("latin-1").strip()
        if not text and method:
            yield method, headers
            method, headers = "", {}
        elif text.endswith("RTSP/1.0"):
            method = text.split(" ", 1)[0].split("$")[-1]
        elif method:
            name, _, value = text.partition(":")
            headers[name.lower()] = value.strip()


def _rtp_packets(picture: bytes, number: int, stamp: int) -> Iterator[bytes]:
    size = TS_BYTES * _PACKETS_PER_RTP
    pieces = [picture[i : i + size] for i in range(0, len(picture), size)]
    for offset, piece in enumerate(pieces):
        marker = 0x80 if offset == len(pieces) - 1 else 0
        head = struct.pack(">BBHII", 0x80, marker | _MPEG_TS, (number + offset) & 0xFFFF, stamp & 0xFFFFFFFF, 7)
        yield struct.pack(">cBH", b"$", 0, len(head) + len(piece)) + head + piece


@contextmanager
def serving(path: Path, *, fps: float = 25.0, burst: int = 0, password: str | None = None) -> Generator[RtspServer]:
    """A server for the length of a block."""
    server = RtspServer(path, fps=fps, burst=burst, password=password)
    try:
        yield server
    finally:
        server.die()
