"""A real RTSP server on loopback: one MPEG-TS recording, played in time, over RTP interleaved in the TCP connection.

It can fall silent, ask for a password, and begin with pictures that piled up.
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
FPS = 25.0
_PACKETS_PER_RTP = 7
_MPEG_TS = 33  # static RTP payload type
_CLOCK_HZ = 90_000
_SDP = "\r\n".join(
    [
        *("v=0", "o=- 0 0 IN IP4 127.0.0.1", "s=test", "c=IN IP4 0.0.0.0", "t=0 0"),
        *(f"m=video 0 RTP/AVP {_MPEG_TS}", f"a=rtpmap:{_MPEG_TS} MP2T/{_CLOCK_HZ}", "a=control:stream0", ""),
    ]
)
_HEADERS = {
    "OPTIONS": "Public: OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN",
    "DESCRIBE": f"Content-Type: application/sdp\r\nContent-Length: {len(_SDP)}",
    "SETUP": "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1;timeout=60",
    "PLAY": "Session: 1\r\nRange: npt=0.000-",
}


def write_transport_stream(path: Path, images: Iterable[Image]) -> Path:
    """RGB pictures as MPEG-2 in a transport stream."""
    images = list(images)
    height, width = images[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mpg2"), FPS, (width, height))
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
        if seen_video and starts:
            pieces.append([])
            seen_video = False
        seen_video = seen_video or is_video
        pieces[-1].append(packet)
    return [b"".join(piece) for piece in pieces]


class RtspServer:
    """Serves `url` to any number of clients; every one sees the recording from its beginning."""

    def __init__(self, path: Path, *, burst: int, password: str | None) -> None:
        """burst: so many pictures are sent at once at the start, as a server with a store of them does."""
        self._pictures, self._burst = split_pictures(path.read_bytes()), burst
        self._secret = password and "Basic " + base64.b64encode(f"admin:{password}".encode()).decode()
        self._silent = threading.Event()
        self._sockets = [socket.create_server(("127.0.0.1", 0))]
        self.url = f"rtsp://127.0.0.1:{self._sockets[0].getsockname()[1]}/live"
        threading.Thread(target=self._accept, daemon=True).start()

    def stall(self) -> None:
        """Send no more pictures, but keep every connection."""
        self._silent.set()

    def resume(self) -> None:
        """Go on where it fell silent; what piled up meanwhile is sent at once."""
        self._silent.clear()

    def close(self) -> None:
        for each in self._sockets:
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._sockets[0].accept()
                self._sockets.append(client)
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with suppress(OSError, ValueError):
            for method, headers in _requests(client.makefile("rb")):
                line, more, body = "200 OK", _HEADERS.get(method, "Session: 1"), _SDP if method == "DESCRIBE" else ""
                if self._secret and headers.get("authorization") != self._secret:
                    line, more, body = "401 Unauthorized", 'WWW-Authenticate: Basic realm="camera"', ""
                client.sendall(f"RTSP/1.0 {line}\r\nCSeq: {headers.get('cseq', '0')}\r\n{more}\r\n\r\n{body}".encode())
                if method == "PLAY" and line == "200 OK":
                    threading.Thread(target=self._play, args=(client,), daemon=True).start()

    def _play(self, client: socket.socket) -> None:
        began, number = time.monotonic(), 0
        with suppress(OSError):
            for index, picture in enumerate(self._pictures):
                due = began + max(0, index - self._burst) / FPS
                while time.monotonic() < due or self._silent.is_set():
                    time.sleep(0.002)
                for packet in _rtp_packets(picture, number, round(index / FPS * _CLOCK_HZ)):
                    client.sendall(packet)
                    number += 1


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
def serving(path: Path, *, burst: int = 40, password: str | None = None) -> Generator[RtspServer]:
    """A server for the length of a block."""
    server = RtspServer(path, burst=burst, password=password)
    try:
        yield server
    finally:
        server.close()
