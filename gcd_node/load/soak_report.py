"""What a soak came to, and whether anything leaked. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass

from gcd_node.load.meter import percentile

_SETTLING = 0.2
_LONGEST_SETTLING_S = 600.0
_EDGE = 0.25


@dataclass(frozen=True, kw_only=True, slots=True)
class SoakLimits:
    """What a soak may come to; more is a finding.

    memory_mb, threads, files, subscriptions: growth. left: threads or sockets after the end. backlog_windows: how many
    windows' time a window may wait for the model. age_growth_ms: of the median age. silent_s: without a view.
    """

    memory_mb: float = 20.0
    threads: float = 2.0
    files: float = 4.0
    subscriptions: float = 0.0
    left: int = 0
    backlog_windows: int = 1
    age_growth_ms: float = 250.0
    silent_s: float = 60.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Growth:
    """How a quantity developed once the node had settled. first, last: its level in the first and the last quarter."""

    first: float
    last: float
    peak: float

    @property
    def growth(self) -> float:
        """From first to last."""
        return self.last - self.first


@dataclass(frozen=True, kw_only=True, slots=True)
class Spread:
    """count: how often it was measured. p50, p99, most: of all values, NaN without any."""

    count: int
    p50: float
    p99: float
    most: float


@dataclass(frozen=True, kw_only=True, slots=True)
class SoakReport:
    """A whole soak.

    seconds: how long it took. memory_mb, threads, files: of the node's process. subscriptions: on its data socket.
    age_ms: from a frame to its arrival at a healthy reader in another process, by the reader; median_age_ms: the same
    as it developed. reply_ms: of the control socket. windows: rendered. arrived, skipped: views at that reader.
    silent_s: longest time without a view there. openings, acts: of the camera. restarts: by commands.
    codes: of replies. unanswered: requests. attacks: by kind; refused: attacks the node cut short.
    left: threads and sockets after the end. failures: what went wrong outright.
    """

    seconds: float
    memory_mb: Growth
    threads: Growth
    files: Growth
    subscriptions: Growth
    median_age_ms: Growth
    age_ms: Spread
    reply_ms: Spread
    backlog_windows: int
    windows: int
    arrived: int
    skipped: int
    silent_s: float
    openings: int
    restarts: int
    unanswered: int
    refused: int
    acts: dict[str, int]
    codes: dict[str, int]
    attacks: dict[str, int]
    left: tuple[str, ...]
    failures: tuple[str, ...]


def findings(report: SoakReport, limits: SoakLimits) -> tuple[str, ...]:
    """Everything that is not as it should be, a sentence each; empty if all is well."""
    grown = (
        ("memory", report.memory_mb, limits.memory_mb, " MiB"),
        ("threads", report.threads, limits.threads, ""),
        ("open files", report.files, limits.files, ""),
        ("subscriptions", report.subscriptions, limits.subscriptions, ""),
        ("the median age", report.median_age_ms, limits.age_growth_ms, " ms"),
    )
    found = [
        f"{name} grew by {each.growth:.1f}{unit}, from {each.first:.1f} to {each.last:.1f}; at most {most:g} is wanted"
        for name, each, most, unit in grown
        if not each.growth <= most
    ]
    if report.subscriptions.growth < 0:
        found.append(f"subscriptions fell by {-report.subscriptions.growth:.0f}: the node counts readers that are gone")
    if report.backlog_windows > limits.backlog_windows:
        found.append(f"a window waited for {report.backlog_windows} windows' time; {limits.backlog_windows} is wanted")
    if report.silent_s > limits.silent_s:
        found.append(f"no view for {report.silent_s:.0f} s; at most {limits.silent_s:g} is wanted")
    if report.unanswered:
        found.append(f"{report.unanswered} requests stayed without a reply")
    if broken := report.codes.get("INTERNAL", 0):
        found.append(f"{broken} requests ended as INTERNAL")
    if len(report.left) > limits.left:
        found.append(f"left after the end: {', '.join(report.left)}")
    return (*found, *report.failures)


def growth(at_s: Sequence[float], values: Sequence[float], *, share: float) -> Growth:
    """How a quantity developed, the beginning left out while things settle.

    Args:
        at_s: when each value was measured, seconds from the start, rising.
        share: per cent of the values of a quarter that lie below its level: 50 is their median, 0 their floor.
    """
    if not values:
        return Growth(first=0.0, last=0.0, peak=0.0)
    begin_s = min(_SETTLING * at_s[-1], _LONGEST_SETTLING_S)
    edge_s = _EDGE * (at_s[-1] - begin_s)
    first = [value for at, value in zip(at_s, values, strict=True) if begin_s <= at <= begin_s + edge_s]
    last = [value for at, value in zip(at_s, values, strict=True) if at >= at_s[-1] - edge_s]
    first = first or [next(value for at, value in zip(at_s, values, strict=True) if at >= begin_s)]
    return Growth(first=percentile(first, share), last=percentile(last, share), peak=max(values))


def spread(values: Sequence[float]) -> Spread:
    """Of values measured; of none, only their count is a number."""
    most = max(values, default=float("nan"))
    return Spread(count=len(values), p50=percentile(values, 50), p99=percentile(values, 99), most=most)
