"""Eight nodes and a service on a Ray cluster of two machines that loses a replica, its network, and a machine.

`pytest -m slow -s tests/node/test_fleet.py` prints what docs/log/fleet.md quotes.
"""

import itertools
import os
import shutil
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import torch
from cameras import until
from fakes import TINY, Box, FakeSource, FakeSynthesizer, fake_config, live_traits
from msgspec.structs import replace as struct_replace

from gcd_client.images import images
from gcd_client.protocol import ViewHeader, ViewMessage
from gcd_model import Augmentation, Card, Clip, RenderOptions, ViewSynthesizer, load_synthesizer
from gcd_model.networks import random_networks
from gcd_model.weights.card import FAMILIES
from gcd_model.weights.load import save_weights
from gcd_node.config import ModelSection
from gcd_node.encoded_frames import frame_seed
from gcd_node.errors import ConfigError
from gcd_node.fleet import ServeSection, _require_endpoint, deployed, service_config
from gcd_node.frame import Frame
from gcd_node.lifecycle import Parts
from gcd_node.node import Node
from gcd_node.preprocess import to_clip_tensor
from gcd_node.remote import RemoteSynthesizer, open_remote

STREAMS, FPS, DEADLINE_S, MOST_SILENCE_S = 8, 5.0, 1.5, 5.0
STALL_S = 6.0
SMALLEST = struct_replace(TINY, height=32, width=64)
FALLBACK = replace(live_traits(), name="stand-in", config=struct_replace(live_traits().config, height=32, width=64))
"""Of what draws where the service does not: eight live models are too much for the machine of a test."""


class Network:
    """Carries bytes between the nodes and the service, unless it stands still."""

    def __init__(self, port: int) -> None:
        self.flows = threading.Event()
        self.flows.set()
        self._to, self._server = port, socket.create_server(("127.0.0.1", 0))
        self.address = f"http://127.0.0.1:{self._server.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._server.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near = self._server.accept()[0]
                try:
                    far = socket.create_connection(("127.0.0.1", self._to))
                except OSError:
                    near.close()
                    continue
                for ends in ((near, far), (far, near)):
                    threading.Thread(target=self._carry, args=ends, daemon=True).start()

    def _carry(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while content := source.recv(1 << 16):
                self.flows.wait()
                target.sendall(content)
        with suppress(OSError):
            target.shutdown(socket.SHUT_RDWR)


def marked(stream: int) -> Callable[[Frame], Frame]:
    """Pictures that no other stream has: noise of its own, that moves."""
    noise = np.random.default_rng(stream).integers(0, 256, (32, 64, 3), np.uint8)
    return lambda frame: Frame(image=np.roll(noise, frame.seq, 1), stamp_ns=frame.stamp_ns, seq=frame.seq)


@dataclass
class Stream(Box):
    """A node whose windows come back, and when."""

    number: int = 0
    arrivals: list[tuple[float, ViewHeader, ViewMessage]] = field(default_factory=list)

    def start(self, address: str) -> None:
        def load(section: ModelSection) -> RemoteSynthesizer:
            made = open_remote(section)
            made.fallback = FakeSynthesizer(FALLBACK)
            return made

        keys = {"weights": address, "engine": "remote", "deadline_s": DEADLINE_S, "steps": 1}
        changes = [f"model.{key}={value!r}".replace("'", '"') for key, value in keys.items()]
        source = FakeSource(1_000_000, fps=FPS, size=(64, 32), period_s=1 / FPS, edit=marked(self.number))
        parts = Parts(open_source=lambda _: source, load_model=load)
        config = fake_config(*changes, source='kind = "synthetic"\npace = "realtime"')
        self.node = Node(config, parts, self)
        self.thread = threading.Thread(target=self.node.run, daemon=True)
        self.thread.start()

    def send(self, message: ViewMessage) -> bool:
        if message.topic.endswith("/win"):
            self.arrivals.append((time.monotonic(), message.header, message))
        return True

    def by(self, name: str, since_s: float) -> int:
        return sum(header.model.name == name and at_s > since_s for at_s, header, _ in self.arrivals)


def is_its_own(stream: Stream, message: ViewMessage, model: ViewSynthesizer) -> bool:
    """Whether the same weights here make the same picture of this stream's frames and of no other's."""
    header, blank = message.header, np.zeros((32, 64, 3), np.uint8)
    edit = marked(stream.number)
    first, *others = (
        model.encode(
            Clip(
                video=torch.from_numpy(to_clip_tensor(edit(Frame(image=blank, stamp_ns=0, seq=seq)).image[None])),
                fps=FPS,
            ),
            Augmentation(seed=frame_seed(header.cfg_digest, seq)),
        )
        for seq in header.src.seq
    )
    options = RenderOptions(seed=header.quality.seed, steps=1, whole_levels=True)
    view = model.render(first.followed_by(*others), [model.traits.plan_view()], options)[0]
    here = view.video.permute(0, 2, 3, 1).numpy().astype(int)
    return int(np.abs(here - images(message)).max()) <= 2


def free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        found = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [each.getsockname()[1] for each in found]


@contextmanager
def two_machines(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A Ray cluster whose second machine may be killed."""
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join(["", *(str(Path(each).resolve()) for each in (".", "model", "client"))])
    )
    monkeypatch.setenv("RAY_agent_register_timeout_ms", "120000")
    monkeypatch.setenv("RAY_TMPDIR", str(folder))  # it notes its address there, in a folder that must exist
    (folder / "ray").mkdir(parents=True)

    def machine(**more: Any) -> dict[str, Any]:
        """Ports are given: a raylet waits 15 s at most for those that its agents find, too short on a busy machine."""
        names = ("metrics_agent", "runtime_env_agent", "metrics_export", "dashboard_agent_listen")
        ports = {f"{name}_port": port for name, port in zip(names, free_ports(4), strict=True)}
        return {"num_cpus": 1, "object_store_memory": 100 << 20, **ports, **more}

    cluster = Cluster(initialize_head=True, head_node_args=machine(include_dashboard=False, temp_dir=str(folder)))
    try:
        cluster.add_node(**machine())
        monkeypatch.setenv("RAY_ADDRESS", cluster.address)
        yield cluster
    finally:
        cluster.shutdown()
        shutil.rmtree(folder, ignore_errors=True)


def replicas(machine: Any) -> list[psutil.Process]:
    raylet = psutil.Process(machine.all_processes["raylet"][0].process.pid)
    return [each for each in raylet.children(recursive=True) if "ServeReplica" in " ".join(each.cmdline())]


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_no_stream_of_a_fleet_stops_or_gets_anothers_views_whatever_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("ray.serve")
    weights = tmp_path / "tiny.safetensors"
    card = Card(name="tiny", config=SMALLEST, family=FAMILIES["driving-semantic"], move_time=13, trained=False)
    save_weights(random_networks(SMALLEST, seed=0), weights, card)
    (port,) = free_ports(1)
    service = {
        "model": {"weights": str(weights), "device": "cpu", "threads": 1},
        "serve": {"http": f"127.0.0.1:{port}"},
    }
    streams = [Stream(number=number) for number in range(STREAMS)]
    short = Path("/tmp") / f"gcd-ray-{os.getpid()}"  # a socket's path has at most 107 characters
    with ExitStack() as stack:
        cluster = stack.enter_context(two_machines(short, monkeypatch))
        lost = {"model": {**service["model"], "weights": str(tmp_path / "lost.safetensors")}, "serve": service["serve"]}
        with (
            pytest.raises(ConfigError, match=r"cannot be deployed: .*lost\.safetensors"),
            deployed(service_config(lost)),
        ):
            pass
        stack.enter_context(deployed(service_config(service)))
        _require_endpoint(service_config(service).serve)
        with pytest.raises(ConfigError, match="already"):
            _require_endpoint(ServeSection(http="127.0.0.1:1"))
        (worker,) = cluster.worker_nodes
        until(lambda: all(len(replicas(each)) == 1 for each in (cluster.head_node, worker)), 60)
        network = Network(port)
        begun_s = time.monotonic()
        for stream in streams:
            stream.start(network.address)
            time.sleep(14 / FPS / STREAMS)  # robots are not in step
        phases: dict[str, float] = {}

        def all_served(name: str, seconds: float = 90.0) -> None:
            """Begin of a phase: every stream has two windows from the service from here on."""
            since_s = time.monotonic()
            until(lambda: all(stream.by("tiny", since_s) >= 2 for stream in streams), seconds)
            phases[name] = since_s

        all_served("all is well")
        replicas(cluster.head_node)[0].kill()
        all_served("a replica is killed")
        stalled_s = phases["the network stands still"] = time.monotonic()
        network.flows.clear()
        until(lambda: all(stream.by("stand-in", stalled_s) >= 2 for stream in streams), 30)
        time.sleep(max(0.0, STALL_S - (time.monotonic() - stalled_s)))
        network.flows.set()
        all_served("the network flows again")
        cluster.remove_node(worker, allow_graceful=False)
        all_served("a machine is killed")
        ended_s = time.monotonic()
        for stream in streams:
            stream.node.stop()
        for stream in streams:
            stream.thread.join(10)
        network.close()
    model = load_synthesizer(weights, device="cpu")
    report(streams, [*phases.items()], ended_s, begun_s)
    for stream in streams:
        times = [at_s for at_s, _, _ in stream.arrivals] + [ended_s]
        assert max(b - a for a, b in itertools.pairwise(times)) < MOST_SILENCE_S
        assert {header.model.name for _, header, _ in stream.arrivals} == {"tiny", "stand-in"}
        served = [(header, message) for _, header, message in stream.arrivals if header.model.name == "tiny"]
        assert all((header.t_infer_end_ns - header.t_infer_start_ns) / 1e9 < DEADLINE_S + 0.3 for header, _ in served)
        assert all(is_its_own(stream, message, model) for _, message in served)
        other = streams[(stream.number + 1) % STREAMS]
        assert not is_its_own(other, served[0][1], model)
        ids = [header.window_id for _, header, _ in stream.arrivals]
        assert ids == sorted(set(ids))


def report(streams: list[Stream], phases: list[tuple[str, float]], ended_s: float, begun_s: float) -> None:
    """What docs/log/fleet.md quotes."""
    ends = [since_s for _, since_s in phases[1:]] + [ended_s]
    for (name, since_s), until_s in zip(phases, ends, strict=True):
        drawn: Counter[str] = Counter()
        gaps, renders, ages = [0.0], [0.0], [0.0]
        for stream in streams:
            times = [at_s for at_s, _, _ in stream.arrivals]
            gaps += [b - a for a, b in itertools.pairwise(times) if since_s <= b <= until_s]
            for at_s, header, _ in stream.arrivals:
                if since_s <= at_s <= until_s:
                    drawn[header.model.name] += 1
                    ages.append(header.age_ms / 1000)
                    if header.model.name == "tiny":
                        renders.append((header.t_infer_end_ns - header.t_infer_start_ns) / 1e9)
        print(
            f"{name:26} {until_s - since_s:5.1f} s  service {drawn['tiny']:4}  fallback {drawn['stand-in']:4}  "
            f"longest gap {max(gaps):4.2f} s  slowest of the service {max(renders):4.2f} s  oldest {max(ages):4.2f} s"
        )
