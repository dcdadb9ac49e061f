"""Where noise is drawn from: the same in every run of a configuration, whatever the timing."""

import hashlib


def window_seed(config_digest: str, window_id: int, attempt: int) -> int:
    """Of the noise that sampling starts from, below 2^48 so that JSON holds it.

    attempt: 0, or 1 for a window that is rendered once more.
    """
    return _seed(f"{config_digest}/{window_id}/{attempt}")


def frame_seed(config_digest: str, seq: int) -> int:
    """Of the noise that is added to one frame before it is encoded, below 2^48.

    It knows nothing of the window, so that windows that share a frame share what was encoded of it. Nor of the stamp:
    a recording of a camera has other stamps, and the same sequence numbers.
    """
    return _seed(f"{config_digest}/frame/{seq}")


def _seed(text: str) -> int:
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:6], "big")
