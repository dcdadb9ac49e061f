"""A health report as Prometheus metrics. The only file that needs the extra `metrics`; import it where it is used."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, get_args

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.exposition import choose_encoder
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric, SummaryMetricFamily
from prometheus_client.registry import Collector

from gcd_node.health.monitor import Health
from gcd_node.health.report import HealthReport, ModelState, SourceState, Stage
from gcd_node.health.stage_times import StageSummary
from gcd_node.life.lifecycle import State

_OPEN_METRICS = "application/openmetrics-text"


class NodeMetrics:
    """The node's metrics in a registry of its own, together with this process's memory, CPU time and open files."""

    def __init__(self, health: Health) -> None:
        self._registry = CollectorRegistry()
        self._registry.register(_HealthCollector(health))
        ProcessCollector(registry=self._registry)

    def exposition(self, accept: str) -> tuple[bytes, str]:
        """The metrics now, and their content type: OpenMetrics if `accept` asks for it, else Prometheus text."""
        encode, content_type = choose_encoder(_OPEN_METRICS if _OPEN_METRICS in accept else "")
        return encode(self._registry), content_type


class _HealthCollector(Collector):
    """Asks for a report whenever somebody scrapes."""

    def __init__(self, health: Health) -> None:
        self._health = health

    def collect(self) -> Iterator[Metric]:
        report = self._health.snapshot()
        yield from _states(report)
        yield from _source(report)
        yield from _model(report)
        yield from _windows(report)
        yield from _publish(report)
        yield _stages(report.stages)


def _states(report: HealthReport) -> Iterator[Metric]:
    yield GaugeMetricFamily("gcd_level", "0 OK, 1 WARN, 2 ERROR; the worst of gcd_reason_level.", int(report.level))
    yield GaugeMetricFamily("gcd_ready", "1 if views come, or would if somebody subscribed.", int(report.ready))
    reasons = {code: int(level) for code, level in report.findings.items()}
    yield _gauge("gcd_reason_level", "Level of each reason there is now.", "code", reasons)
    for name, known, now in (
        ("node", tuple(state.label for state in State), report.state),
        ("source", get_args(SourceState), report.source.state),
        ("model", get_args(ModelState), report.model.state),
    ):
        values = {state: int(state == now) for state in known}
        yield _gauge(f"gcd_{name}_state", f"1 for the state of the {name}, 0 for the others.", "state", values)


def _source(report: HealthReport) -> Iterator[Metric]:
    source = report.source
    yield _optional("gcd_source_fps", "Frames a second by the latest stamps.", source.fps)
    age_s = None if source.last_frame_age_ms is None else source.last_frame_age_ms / 1000
    yield _optional("gcd_source_last_frame_age_seconds", "Since a frame arrived.", age_s)
    yield CounterMetricFamily("gcd_source_frames", "Frames that arrived whole.", source.frames)
    yield CounterMetricFamily("gcd_source_corrupt_frames", "Frames that arrived damaged.", source.corrupt)
    yield CounterMetricFamily("gcd_source_reconnects", "Times the source came back.", source.reconnects)


def _model(report: HealthReport) -> Iterator[Metric]:
    model = report.model
    yield CounterMetricFamily("gcd_model_out_of_memory", "Windows the model found no memory for.", model.ooms)
    yield CounterMetricFamily("gcd_model_nan_windows", "Windows that came out with NaN.", model.nan_windows)
    yield GaugeMetricFamily("gcd_model_backoff_seconds", "Until the model is tried again.", model.backoff_s)
    memory = None if model.gpu_mem_mb is None else model.gpu_mem_mb * 1e6
    yield _optional("gcd_model_gpu_memory_bytes", "Device memory in use.", memory)


def _windows(report: HealthReport) -> Iterator[Metric]:
    yield CounterMetricFamily("gcd_windows_built", "Windows of frames.", report.built)
    yield _counter("gcd_window_faults", "What spoilt windows.", "reason", report.reason_counts)
    yield _counter("gcd_dropped", "Frames, windows or messages given up.", "hop", report.drops)
    ages = {view_id: ago / 1000 for view_id, ago in report.views.items() if ago is not None}
    yield _gauge("gcd_view_last_published_seconds", "Since a window of the view was published.", "view", ages)


def _publish(report: HealthReport) -> Iterator[Metric]:
    publish = report.publish
    yield CounterMetricFamily("gcd_messages_sent", "Messages that left on the data socket.", publish.sent)
    yield CounterMetricFamily("gcd_bytes_sent", "Bytes that left on the data socket.", publish.bytes)
    yield GaugeMetricFamily("gcd_subscriptions", "Subscriptions on the data socket.", publish.subscribers)


def _stages(stages: Mapping[Stage, StageSummary]) -> Metric:
    """A summary: quantiles of the last minute, count and sum since the start."""
    family = SummaryMetricFamily("gcd_stage_seconds", "How long each stage takes.", labels=["stage"])
    for name, stage in stages.items():
        for part, seconds in (("0.5", stage.p50_s), ("0.99", stage.p99_s)):
            family.add_sample("gcd_stage_seconds", {"stage": name, "quantile": part}, seconds)
        family.add_metric([name], stage.count, stage.total_s)
    return family


def _gauge(name: str, text: str, label: str, values: Mapping[Any, float]) -> Metric:
    return _filled(GaugeMetricFamily(name, text, labels=[label]), values.items())


def _counter(name: str, text: str, label: str, values: Mapping[Any, float]) -> Metric:
    return _filled(CounterMetricFamily(name, text, labels=[label]), values.items())


def _optional(name: str, text: str, value: float | None) -> Metric:
    """A gauge without a sample while there is nothing to say."""
    family = GaugeMetricFamily(name, text, labels=[])
    if value is not None:
        family.add_metric([], value)
    return family


def _filled(
    family: GaugeMetricFamily | CounterMetricFamily, values: Iterable[tuple[object, float]]
) -> GaugeMetricFamily | CounterMetricFamily:
    for label, number in values:
        family.add_metric([str(label)], number)
    return family
