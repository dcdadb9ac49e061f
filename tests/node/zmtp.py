"""Just enough of ZMTP 3.0, the protocol below ZeroMQ, to break it: bytes of a greeting, a handshake and frames.

Source: ZeroMQ RFC 23, "ZMTP 3.0".
"""

GREETING = b"\xff" + bytes(8) + b"\x7f" + b"\3\0" + b"NULL".ljust(20, b"\0") + bytes(32)
"""64 bytes: signature, version 3.0, no security, filler."""

_LONG, _COMMAND = 2, 4


def ready(socket_type: str) -> bytes:
    """The handshake after the greeting: a READY command that names our socket's type, such as "DEALER"."""
    name, value = b"Socket-Type", socket_type.encode()
    body = b"\x05READY" + bytes([len(name)]) + name + len(value).to_bytes(4, "big") + value
    return bytes([_COMMAND, len(body)]) + body


def message(body: bytes) -> bytes:
    """A message of one frame."""
    if len(body) < 256:
        return bytes([0, len(body)]) + body
    return announced(len(body)) + body


def announced(size: int) -> bytes:
    """The head of a frame that claims to have so many bytes."""
    return bytes([_LONG]) + size.to_bytes(8, "big")
