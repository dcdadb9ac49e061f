"""A model, a source, an outbox and a node behind a control socket that do what a test tells them."""

import functools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cameras import until
from msgspec.structs import replace as struct_replace

from gcd_client.control import Code
from gcd_client.protocol import DataMessage, EndMessage, OriginHeader, StatusTopic, ViewMessage
from gcd_model import (
    Augmentation,
    Clip,
    RenderOptions,
    SourceFeatures,
    Traits,
    Trajectory,
    View,
    ViewSynthesizer,
    load_synthesizer,
)
from gcd_model.config import DRIVING_CLASSES, PLAIN_SMALL, SMALL
from gcd_model.networks import random_networks
from gcd_model.weights.card import FAMILIES, Card
from gcd_model.weights.load import save_weights
from gcd_node.auth import Client, Role, ServerSecurity, new_key_pair
from gcd_node.config import NodeConfig, parse_config
from gcd_node.control import ControlServer
from gcd_node.errors import NodeError
from gcd_node.frame import Frame, FrameSource, SourceInfo
from gcd_node.lifecycle import Parts
from gcd_node.messages import MessageSink, PublisherStats
from gcd_node.node import Node
from gcd_node.verbs import Command, Outcome, RequestError
from gcd_node.work import WindowReport

HEIGHT, WIDTH = 64, 96


def traits(family: str = "kubric90", *, move_time: int = 13) -> Traits:
    camera = FAMILIES[family].camera
    unet = SMALL.unet if camera == "spherical" else struct_replace(SMALL.unet, camera_width=0)
    config = struct_replace(SMALL, camera=camera, unet=unet, height=HEIGHT, width=WIDTH)
    return Traits(
        name="fake",
        config=config,
        family=FAMILIES[family],
        move_time=move_time,
        sha256_12="0" * 12,
        precision="float32",
        device="cpu",
        trained=False,
    )


def painting_traits() -> Traits:
    """Of a model whose pictures are painted in class colours, so that it draws class maps."""
    config = struct_replace(PLAIN_SMALL, height=HEIGHT, width=WIDTH, semantic_classes=DRIVING_CLASSES)
    return replace(traits("driving-semantic"), config=config)


@functools.cache
def live_traits() -> Traits:
    """Of the live model, in windows: it uses its camera's mount and takes any pose."""
    made = load_synthesizer("random:live", device="cpu").traits
    return replace(made, config=struct_replace(made.config, height=HEIGHT, width=WIDTH))


def fake_classes(made: Traits, samples: int) -> torch.Tensor | None:
    """Class numbers u8 [S, T, H, W] that differ from sample to sample, frame to frame and column to column."""
    if not made.classes:
        return None
    sizes = (samples, made.config.frames, HEIGHT, WIDTH)
    s, t, _, x = torch.meshgrid(*(torch.arange(size) for size in sizes), indexing="ij")
    return ((s + t + x) % len(made.classes)).to(torch.uint8)


def fake_maps(frames: int = 14, height: int = HEIGHT, width: int = WIDTH) -> dict[str, torch.Tensor]:
    """What a view may hold beside its picture, [T, H, W]: every state, every depth from 0.3 to 200 m and none, a spread
    of a tenth."""
    numbers = torch.arange(frames * height * width).reshape(frames, height, width)
    depth_m = 0.3 * (200 / 0.3) ** (numbers / numbers.max())
    return {
        "visibility": (numbers % 3).to(torch.uint8),
        "inverse_depth": torch.where(numbers % 7 == 0, torch.zeros(()), 1 / depth_m),
        "log_variance": torch.full((frames, height, width), 2 * math.log(0.1)),
    }


class FakeSynthesizer:
    """Gives the source back, darker by the seed's last bits; `act` is called before every render. holds: the names of
    what its views hold, of fake_maps()."""

    def __init__(
        self, made: Traits, act: Callable[[RenderOptions], None] | None = None, holds: Sequence[str] = ()
    ) -> None:
        self.traits = made
        self.holds = holds
        self.asked: list[tuple[list[Trajectory], RenderOptions]] = []
        self.clips: list[Clip] = []
        self._act = act

    def encode(self, clip: Clip, augmentation: Augmentation | None = None) -> SourceFeatures:
        self.clips.append(clip)
        strength = None if augmentation is None else augmentation.strength
        return SourceFeatures(tokens=None, latents=clip.video, fps=clip.fps, augmentation=strength or 0.0)

    def render(
        self, features: SourceFeatures, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        options = RenderOptions() if options is None else options
        self.asked.append((list(trajectories), options))
        if self._act is not None:
            self._act(options)
        video = ((features.latents + 1) / 2 * (1 - (options.seed % 7) / 100)).clamp(0, 1)
        samples = torch.stack([video * (1 - s / 10) for s in range(options.samples)])
        return [
            View(
                samples=samples,
                latents=features.latents[None],
                trajectory=path,
                motion_bucket=127.0,
                classes=fake_classes(self.traits, options.samples),
                **{name: fake_maps()[name] for name in self.holds},
            )
            for path in trajectories
        ]


class FakeSource:
    """`count` frames, the number of a frame in its pixels, as `edit` makes them; `fails` is raised after the last."""

    def __init__(
        self,
        count: int,
        *,
        fps: float = 24.0,
        size: tuple[int, int] = (WIDTH, HEIGHT),
        period_s: float = 0.0,
        fails: Exception | None = None,
        edit: Callable[[Frame], Frame] = lambda frame: frame,
    ) -> None:
        self.info = SourceInfo(
            kind="synthetic", id="fake", width=size[0], height=size[1], fps_nominal=fps, clock="replay"
        )
        self.closed, self.corrupt = False, 0
        self._count, self._period_s, self._fails, self._edit = count, period_s, fails, edit

    def frames(self) -> Iterator[Frame]:
        for seq in range(self._count):
            if self.closed:
                return
            time.sleep(self._period_s)
            image = np.full((self.info.height, self.info.width, 3), 20 + seq % 200, np.uint8)
            yield self._edit(Frame(image=image, stamp_ns=round(seq * 1e9 / self.info.fps_nominal), seq=seq))
        if self._fails is not None:
            raise self._fails

    def close(self) -> None:
        self.closed = True


class Steady(FakeSource):
    """Frames at their rhythm until it is closed."""

    def __init__(self) -> None:
        super().__init__(10_000_000, period_s=0.002)


def made_node(
    config: NodeConfig,
    synthesizer: ViewSynthesizer,
    source: FrameSource,
    outbox: MessageSink,
    on_window: Callable[[WindowReport], None] | None = None,
) -> Node:
    """A node over parts that are there already; it ends with its source."""
    parts = Parts(open_source=lambda _: source, load_model=lambda _: synthesizer)
    return Node(config, parts, outbox, on_window=on_window)


@dataclass
class Box:
    """An outbox that keeps what it gets."""

    views: list[Any] = field(default_factory=list)  # and grids
    ends: list[EndMessage] = field(default_factory=list)
    notes: list[tuple[str, Mapping[str, Any]]] = field(default_factory=list)

    def send(self, message: DataMessage) -> bool:
        self.views.append(message)
        return True

    def end(self, message: EndMessage, *, delay_ms: int | None = None) -> None:
        self.ends.append(message)

    def note(self, topic: StatusTopic, header: OriginHeader, fields: Mapping[str, Any]) -> None:
        self.notes.append((topic, fields))

    def preview(self, made: Callable[[], ViewMessage]) -> None:
        self.views.append(made())

    def stop_waiting(self) -> None:
        """It never waits."""

    @property
    def stats(self) -> PublisherStats:
        return PublisherStats(sent=len(self.views))

    def of(self, kind: str, view: str = "main") -> list[ViewMessage]:
        return [message for message in self.views if message.topic == f"view/{view}/{kind}"]

    def ids(self) -> list[int]:
        """Of the windows."""
        return [message.header.window_id for message in self.of("win")]

    def seqs(self) -> list[int]:
        """Of the first frame of each window."""
        return [message.header.src.seq[0] for message in self.of("win")]

    def told(self, topic: StatusTopic) -> list[Mapping[str, Any]]:
        return [fields for each, fields in self.notes if each == topic]

    def events(self, code: str) -> list[Mapping[str, Any]]:
        return [fields for fields in self.told("event") if fields["code"] == code]


LOCKSTEP = 'kind = "synthetic"\npace = "lockstep"'


def fake_config(*changes: str, source: str = LOCKSTEP) -> NodeConfig:
    """A node of one view with a model of these fakes. changes: KEY=VALUE. source: of [source]."""
    text = f'[source]\n{source}\n[model]\nweights = "fake"\n[view.main]'
    return parse_config(text.encode(), "test", changes)


def run(config: NodeConfig, model: ViewSynthesizer | None = None, source: FrameSource | None = None) -> Box:
    """A node's whole life, by default over 28 frames."""
    box = Box()
    made_node(config, model or FakeSynthesizer(traits()), source or FakeSource(28), box).run()
    return box


NODE, VIEWER, OPERATOR = (new_key_pair() for _ in range(3))
CLIENTS = {VIEWER.public: Client(name="eye", role="viewer"), OPERATOR.public: Client(name="hand", role="operator")}
SECURITY = ServerSecurity(keys=NODE, find_client=CLIENTS.get)


class FakeNode:
    """A node behind the control socket that only remembers what it was told; knows one view, `top`, whose revision
    rises with each set_view."""

    def __init__(self) -> None:
        self.heard: list[Command] = []
        self.view_rev = 1
        self.result: Any = None
        self.events: list[tuple[str, dict[str, object]]] = []

    @contextmanager
    def serve(self, endpoint: str, **options: Any) -> Iterator[ControlServer]:
        with closing(ControlServer(endpoint, self.handle, lambda: "active", self.event, **options)) as server:
            yield server

    def handle(self, command: Command, role: Role) -> Outcome:
        self.heard.append(command)
        match command.verb:
            case "set_view":
                if abs(command.args.azimuth_deg or 0.0) > 90:
                    allowed: dict[str, object] = {"allowed": {"azimuth_deg": [-90, 90]}}
                    raise RequestError("azimuth_deg is beyond what was trained", Code.OUT_OF_RANGE, "", allowed)
                self.view_rev += 1
                return Outcome(result={"view_rev": self.view_rev})
            case "configure":
                raise NodeError("no model here")
            case "cleanup":
                raise ZeroDivisionError("a secret of the code")
            case "stats":
                return Outcome(result=self.result)
            case _:
                return Outcome(result={"role": role})

    def event(self, code: str, level: int, fields: Mapping[str, object]) -> None:
        self.events.append((code, {"level": int(level), **fields}))

    @property
    def codes(self) -> list[str]:
        """Of the events so far."""
        return [code for code, _ in self.events]

    def await_event(self, code: str) -> dict[str, object]:
        """The fields of the first event with this code."""
        until(lambda: code in self.codes)
        return next(fields for each, fields in self.events if each == code)


TINY = struct_replace(
    PLAIN_SMALL,
    height=HEIGHT,
    width=WIDTH,
    unet=struct_replace(PLAIN_SMALL.unet, width=16, head_width=16, embedding_width=32),
    vae=struct_replace(PLAIN_SMALL.vae, width=8),
    semantic_classes=DRIVING_CLASSES,
)


def write_tiny(folder: Path) -> Path:
    """`tiny.safetensors` in a folder: real weights of a tiny driving model at random, which paint class colours and
    take no time."""
    card = Card(name="tiny", config=TINY, family=FAMILIES["driving-semantic"], move_time=13, trained=False)
    save_weights(random_networks(TINY, seed=0), folder / "tiny.safetensors", card)
    return folder / "tiny.safetensors"
