"""The node of a soak, in this process and over real sockets: a camera that misbehaves, a model that only waits."""

import tempfile
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from itertools import chain, repeat

import numpy as np
import torch
from msgspec.structs import replace

from gcd_model import NonFiniteError, RenderOptions, SourceFeatures, Traits, View
from gcd_model.config import SVD_14
from gcd_model.weights.card import FAMILIES
from gcd_node.config import ControlConfig, ModelSection, NodeConfig, PublishConfig
from gcd_node.errors import NodeError, SourceAbsentError, SourceLostError
from gcd_node.frame import Frame, SourceInfo
from gcd_node.lifecycle import Parts
from gcd_node.node import Node
from gcd_node.publisher import Publisher
from gcd_node.session import open_session
from gcd_node.sources import V4l2Source
from gcd_node.sources.live import LiveCamera
from gcd_node.view_config import ViewConfig
from gcd_node.work import WindowReport

VIEW = "soak"
WIDTH, HEIGHT, FPS = 384, 256, 24.0
ACTS = (
    "steady", "drop", "repeat", "reverse", "clock_step", "damage", "stall", "silence", "deaf", "resize", "die"
)  # fmt: skip
"""What the camera does between two halves of a second of good frames. silence: until it is closed; deaf: the driver
does not even return when it is closed; die: gone for a second."""

_SECOND_NS = 1_000_000_000
_NAN_EVERY = 50
_REMEMBERED = 4096


class CameraScript:
    """One camera over all its openings; frames are numbered through. From any thread."""

    def __init__(self, acts: Iterator[str], size: tuple[int, int]) -> None:
        self.size, self.larger = size, (size[0] * 4 // 3, size[1] * 3 // 2)
        self.done: Counter[str] = Counter()
        self.openings = 0
        chance = np.random.default_rng(0)
        self._pictures = {
            (width, height): [chance.integers(0, 256, (height, width, 3), np.uint8) for _ in range(4)]
            for width, height in (self.size, self.larger)
        }
        self._acts, self._lock = acts, threading.Lock()
        self._taken: OrderedDict[int, int] = OrderedDict()
        self._seq = self._back_ns = 0

    def open(self) -> LiveCamera:
        if time.monotonic_ns() < self._back_ns:
            raise SourceAbsentError("the scripted camera is gone; it comes back by itself")
        self.openings += 1
        return LiveCamera("the scripted camera", lambda: ScriptedDriver(self), open_timeout_s=5.0, hint="wait")

    def next_act(self) -> str:
        with self._lock:
            act = next(self._acts)
            self.done[act] += 1
            return act

    def unplug(self) -> None:
        self._back_ns = time.monotonic_ns() + _SECOND_NS

    def shoot(self, size: tuple[int, int], taken_ns: int, stamp_ns: int) -> Frame:
        with self._lock:
            seq, self._seq = self._seq, self._seq + 1
            self._taken[seq] = taken_ns
            if len(self._taken) > _REMEMBERED:
                self._taken.popitem(last=False)
        return Frame(image=self._pictures[size][seq % 4], stamp_ns=stamp_ns, seq=seq)

    def taken_ns(self, seq: int) -> int | None:
        """When a frame was taken, whatever its stamp says; None for one long gone."""
        with self._lock:
            return self._taken.get(seq)


class ScriptedDriver:
    """One opening of a CameraScript, as the Driver of a LiveCamera."""

    kind, id, fps = "v4l2", "scripted", FPS

    def __init__(self, script: CameraScript) -> None:
        self._script = script
        self._period_ns = round(_SECOND_NS / FPS)
        self._size, self._clock_ns, self._due_ns = script.size, 0, time.monotonic_ns()
        self._played = chain.from_iterable(self._play(script.next_act()) for _ in repeat(None))
        self.corrupt = 0

    def read(self) -> Frame | None:
        return next(self._played)

    def describe(self, info: SourceInfo) -> SourceInfo:
        return info

    def close(self) -> None:
        """It holds nothing."""

    def _play(self, act: str) -> Iterator[Frame | None]:
        half = round(FPS / 2)
        yield from self._take(half)
        if act == "deaf":
            time.sleep(3.0)
        elif act in ("stall", "silence"):
            for _ in range(6 if act == "stall" else 300):
                time.sleep(0.1)
                yield None
        elif act == "drop":
            self._due_ns += 3 * self._period_ns
        elif act in ("repeat", "reverse"):
            self._wait()
            late = 1 if act == "repeat" else 3
            yield self._frame(self._due_ns - late * self._period_ns)
        elif act == "damage":
            for _ in range(half // 2):
                self.corrupt += 1
                self._due_ns += self._period_ns
                yield from self._take(1)
        elif act == "die":
            self._script.unplug()
            raise SourceLostError("the scripted camera was unplugged")
        if act in ("stall", "silence", "deaf"):
            self._due_ns = time.monotonic_ns()
        self._clock_ns = -3 * _SECOND_NS if act == "clock_step" else 0
        self._size = self._script.larger if act == "resize" else self._script.size
        yield from self._take(2 * half if act in ("clock_step", "resize") else half)
        self._clock_ns, self._size = 0, self._script.size

    def _take(self, count: int) -> Iterator[Frame]:
        for _ in range(count):
            self._wait()
            yield self._frame(self._due_ns)
            self._due_ns += self._period_ns

    def _wait(self) -> None:
        """Until the next frame is due."""
        time.sleep(max(0.0, (self._due_ns - time.monotonic_ns()) / _SECOND_NS))

    def _frame(self, stamp_ns: int) -> Frame:
        return self._script.shoot(self._size, self._due_ns, stamp_ns + self._clock_ns)


class StandInModel:
    """A ViewSynthesizer with the published model's 14 frames that gives a ready picture; every 50th time it fails."""

    def __init__(self) -> None:
        config = replace(SVD_14, width=WIDTH, height=HEIGHT)
        self.traits = Traits(
            name="stand-in",
            config=config,
            family=FAMILIES["kubric90"],
            move_time=config.frames - 1,
            sha256_12="0" * 12,
            precision="float32",
            device="cpu",
            trained=False,
        )
        coarse = torch.rand(config.frames, 3, HEIGHT // 8, WIDTH // 8, generator=torch.Generator().manual_seed(0))
        smooth = torch.nn.functional.interpolate(coarse, size=(HEIGHT, WIDTH), mode="bilinear")
        levels = (smooth * 255).round().to(torch.uint8)
        self._samples = levels.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)[None]  # as it is sent
        self._rendered = 0
        self.taken_ns = 0
        """When it was last given something, monotonic clock."""

    def encode(self, clip, augmentation=None):
        self.taken_ns = time.monotonic_ns()
        latents = clip.video[:, :, ::8, ::8]
        return SourceFeatures(tokens=None, latents=latents, fps=clip.fps, augmentation=0.0)

    def render(self, features, trajectories, options=None):
        self.taken_ns = time.monotonic_ns()
        options = options or RenderOptions()
        if options.progress is not None:
            options.progress(1, 1)
        self._rendered += 1
        if self._rendered % _NAN_EVERY == 0:
            raise NonFiniteError("the stand-in pretends to have produced NaN; it will not do so the next time")
        samples = self._samples.expand(options.samples, -1, -1, -1, -1)
        return [
            View(samples=samples, latents=features.latents[None], trajectory=path, motion_bucket=127.0)
            for path in trajectories
        ]


class Rig:
    """A node that runs in a thread until it is closed. failure: what it ended with, None while it runs."""

    def __init__(self, node: Node, publisher: Publisher, control: str) -> None:
        self.node, self.publisher, self.control = node, publisher, control
        self.failure: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="node", daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        return self._thread.is_alive()

    def wait_for(self, condition: Callable[[], bool], what: str) -> None:
        until_s = time.monotonic() + 60.0
        while not condition():
            if not self.running or time.monotonic() > until_s:
                raise NodeError(f"{what} did not come about: {self.failure or 'within a minute'}")
            time.sleep(0.01)

    def close(self) -> None:
        self.node.stop()
        self._thread.join(20.0)
        if self._thread.is_alive():
            raise NodeError("the node did not end within 20 s after it was told to")

    def _run(self) -> None:
        try:
            self.node.run()
        except Exception as error:  # the end of a thread
            self.failure = error


@contextmanager
def running_node(
    script: CameraScript, model: StandInModel, on_window: Callable[[WindowReport], None]
) -> Generator[Rig, None, None]:
    """A node that is active, or about to be."""
    with tempfile.TemporaryDirectory(prefix="gcd-soak-") as folder:
        config = NodeConfig(
            source=V4l2Source(),
            model=ModelSection(weights="stand-in"),
            view={VIEW: ViewConfig(azimuth_deg=10.0)},
            publish=PublishConfig(data=f"ipc://{folder}/data", status=f"ipc://{folder}/status"),
            control=ControlConfig(endpoint=f"ipc://{folder}/control"),
            node_id="soak",
        )
        parts = Parts(open_source=lambda _: script.open(), load_model=lambda _: model)
        with open_session(config, parts=parts, once=False, on_window=on_window) as (node, publisher, control):
            assert control is not None
            rig = Rig(node, publisher, control.endpoint)
            try:
                yield rig
            finally:
                rig.close()
