"""What a whole node did with a stream, as it goes into JSON and comes back."""

import msgspec


class Ages(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Of the newest input frame when its view arrived in another process, ms."""

    p50_ms: float
    p95_ms: float
    p99_ms: float
    most_ms: float


class StreamBench(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="stream", tag_field="kind"
):
    """A node in a process of its own, a reader in another.

    source, fps, seconds: what it was given, and for how long it was watched after its first view.
    frames: of a window. new_s: of the stream that each window brings: its stride.
    windows, missed: that came, and that should have come beside them.
    work_p50_s, work_p95_s: from when the model took a window until its view was there.
    real_time_factor: new_s over work_p95_s; 1 or more keeps up.
    first_view_s: from the start of the process. cores: that the process used, on average.
    resident_mb, private_mb: of its memory, MiB, at most; private without pages of files.
    arrivals: when each view came, seconds after the first, and its age, ms.
    """

    model: str
    precision: str
    device: str
    steps: int
    source: str
    fps: float
    seconds: float
    frames: int
    new_s: float
    windows: int
    missed: int
    ages: Ages
    work_p50_s: float
    work_p95_s: float
    real_time_factor: float
    first_view_s: float
    cores: float
    resident_mb: float
    private_mb: float
    arrivals: tuple[tuple[float, float], ...]
