"""Clips, networks and recipes small enough to train in a second, and the command line."""

import json
from dataclasses import replace
from pathlib import Path
from threading import Event

import msgspec
import numpy as np
import torch
from safetensors.torch import load_file
from torch import nn
from typer.testing import CliRunner

from gcd_model import Clip, Traits, View, load_synthesizer
from gcd_model.config import DRIVING_CLASSES, PLAIN_SMALL, CameraControl, ModelConfig
from gcd_model.geometry import (
    CameraMount,
    Intrinsics,
    Spherical,
    SphericalDelta,
    Trajectory,
    driving_trajectory,
    spherical_trajectory,
)
from gcd_model.networks import random_networks
from gcd_model.weights.card import FAMILIES, Card
from gcd_model.weights.load import save_weights
from gcd_train.cli.main import new_app
from gcd_train.data.open import RunData
from gcd_train.data.sample import Clips, Sample, to_network
from gcd_train.recipe import EmaRecipe, OptimiserRecipe, Recipe, UNetRecipe
from gcd_train.recipe_data import Budget, LogRecipe
from gcd_train.training.checkpoint import SavedWeights, newest_weights
from gcd_train.training.loop import LoopOptions, Progress, StepLoss, Task
from gcd_train.training.monitor import RunFolder
from gcd_train.training.objective import Batch
from gcd_train.training.run import Trainer
from gcd_train.training.setup import Draws

FRAMES, HEIGHT, WIDTH = 4, 32, 64

RECIPE = b"""
name = "tiny"
seed = 3
[model]
frames = 4
height = 32
width = 64
[model.unet]
width = 16
multipliers = [1, 2, 3]
head_width = 16
embedding_width = 32
[model.vae]
width = 16
multipliers = [1, 1, 2]
[log]
valid_clips = 1
[vae]
budget = { updates = 6 }
crop = 16
clips = 2
frames = 2
optimiser = { rate = 2e-3, warm_up = 2, final = 0.1, clip = 1.0 }
[latents]
[unet]
budget = { updates = 6 }
image_share = 0.5
image_batch = 4
clip_batch = 1
augmentation = 0.0
optimiser = { rate = 1e-3, warm_up = 2, flat = 0.3, final = 0.02, clip = 1.0 }
ema = { limit = 0.998, horizon = 0.15 }
noise = { fixed_share = 0.5, shared = 1.0 }
loss = { weight_limit = 5.0, sensitivity = true }
"""


class TinyClips(Clips):
    """Random gradients; the target is the source upside down."""

    fps = 10.0
    camera: CameraControl = "none"
    classes = DRIVING_CLASSES
    origin = "tiny"

    def __init__(self, count: int = 2, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        low = random.integers(0, 255, (count, FRAMES, 4, 8, 3), np.uint8)
        self._clips = low.repeat(HEIGHT // 4, axis=2).repeat(WIDTH // 8, axis=3)
        self._ids = (self._clips[..., 0] % len(DRIVING_CLASSES)).astype(np.uint8)
        self.seeds = range(100, 100 + count)

    def trajectory(self, number: int, /) -> Trajectory:
        return driving_trajectory(frames=FRAMES, move_time=FRAMES - 1, mount=CameraMount())

    def sample(self, number: int, /) -> Sample:
        number %= len(self)
        path = self.trajectory(number)
        return Sample(
            source=self._clips[number],
            target=self._clips[number][:, ::-1],
            target_classes=self._ids[number],
            source_from_target=path.source_from_target.numpy(),
            start=path.source,
            deltas=None if path.delta is None else path.delta.numpy(),
            fps=self.fps,
            scene="tiny",
            frame_numbers=tuple(range(FRAMES)),
            lens=Intrinsics.from_hfov(85.0, WIDTH, HEIGHT),
            source_depth=np.full((FRAMES, HEIGHT, WIDTH), 10.0, np.float32),
        )


class TinyOrbits(TinyClips):
    """The same pictures, each clip from a path of its own over the sphere; no classes."""

    fps = 12.0
    camera: CameraControl = "spherical"
    classes = ()
    origin = "tiny orbits"

    def trajectory(self, number: int, /) -> Trajectory:
        source = Spherical(azimuth_deg=0.0, elevation_deg=5.0 + number, radius_m=14.0)
        change = SphericalDelta(azimuth_deg=40.0 - 70.0 * number, elevation_deg=10.0, radius_m=-1.0)
        return spherical_trajectory(source, change, frames=FRAMES, move_time=FRAMES - 1)


class Slope(Task):
    """Four numbers to learn, from inputs that follow from the update; keeps every update's loss, which can go wrong."""

    module: nn.Linear

    def __init__(self, fails_at: int | None = None) -> None:
        super().__init__(nn.Linear(4, 1))
        nn.init.constant_(self.module.weight, 0.5)
        nn.init.zeros_(self.module.bias)
        self.losses: dict[int, float] = {}
        self._fails_at = fails_at

    def step_loss(self, progress: Progress) -> StepLoss:
        inputs = torch.randn(8, 4, generator=torch.Generator().manual_seed(progress.updates))
        loss = (self.module(inputs) - inputs.sum(1, keepdim=True)).square().mean()
        self.losses[progress.updates] = loss.item()
        if progress.updates == self._fails_at:
            loss = loss * torch.inf
        return StepLoss(loss, {"square": loss}, 8)

    def measure(self, picture: Path) -> dict[str, float]:
        return {"bias": self.module.bias.item()}


def loop_options(budget: Budget, ema: EmaRecipe | None = None, **changes: object) -> LoopOptions:
    """A stage of so long, which speaks, saves and measures at its end alone."""
    options = LoopOptions(
        stage="unet",
        identity="slope",
        table=UNetRecipe(budget=budget, optimiser=OptimiserRecipe(rate=0.1), ema=ema),
        log=LogRecipe(log_s=1e6, save_s=1e6, measure_s=1e6),
        stop=Event(),
        frames_per_clip=1,
    )
    return replace(options, **changes)


def noise_batch(config: ModelConfig, draws: Draws, rows: int, frames: int, size: tuple[int, int] = (4, 8)) -> Batch:
    """Rows of nothing but noise, with all that a network of this config is given. size: of the latents."""
    tower, unet = config.image_encoder, config.unet
    return Batch(
        target=draws.normal(rows, unet.latent_channels, *size),
        condition=draws.normal(rows, unet.condition_channels, *size),
        vector=draws.normal(rows, unet.vector_width),
        tokens=None if tower is None else draws.normal(rows, tower.output_width),
        emphasis=None,
        frames=frames,
        camera=draws.normal(rows, 13) if config.camera == "spherical" else None,
    )


class After(Event):
    """A stop signal that is set the n-th time it is asked."""

    def __init__(self, asked: int) -> None:
        super().__init__()
        self._left = asked

    def is_set(self) -> bool:
        self._left -= 1
        return self._left <= 0


def tiny_recipe(**changes: object) -> Recipe:
    """The tiny recipe, with top-level fields replaced."""
    return msgspec.structs.replace(msgspec.toml.decode(RECIPE, type=Recipe), **changes)


def trainer(
    path: Path,
    recipe: Recipe | None = None,
    clips: Clips | None = None,
    valid: Clips | None = None,
    stop: Event | None = None,
    latents: Path | None = None,
) -> Trainer:
    """A run in a folder, by default of the tiny recipe on tiny clips."""
    return Trainer(
        recipe=recipe or tiny_recipe(),
        data=RunData(clips=clips or TinyClips(2), valid=valid or TinyClips(1, seed=9)),
        folder=RunFolder(path),
        stop=stop or Event(),
        latents=latents,
    )


def measured(run: Path) -> dict[str, dict[str, float]]:
    """The last measurement of each stage of a run."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return {line["stage"]: line for line in lines if line["kind"] == "measured"}


def rendered(weights: Path, number: int = 0) -> tuple[View, Traits]:
    """What a weight file makes of a clip that it has not seen."""
    synthesizer = load_synthesizer(weights, device="cpu")
    source = to_network(TinyClips(1, seed=4).sample(number).source)
    features = synthesizer.encode(Clip(video=source, fps=10.0))
    return synthesizer.render(features, [synthesizer.traits.plan_view()])[0], synthesizer.traits


def saved(stage_folder: Path, stage: str) -> SavedWeights:
    """The newest state of a stage."""
    found = newest_weights(stage_folder, stage)
    assert found is not None, f"{stage_folder} has no state"
    return found


def assert_same_states(first: Path, second: Path, stage: str) -> None:
    """The newest states of two runs of a stage hold the same bits: weights, averages and moments."""
    (a, b) = (saved(folder / stage, stage) for folder in (first, second))
    assert (a.note.updates, a.note.identity) == (b.note.updates, b.note.identity)
    one, other = ({n: v for f in each.path.glob("*.safetensors") for n, v in load_file(f).items()} for each in (a, b))
    assert one.keys() == other.keys()
    assert [name for name, value in one.items() if not torch.equal(value, other[name])] == []


def write_untrained(folder: Path) -> Path:
    """`untrained.safetensors`: four frames of 64 x 32."""
    config = msgspec.structs.replace(
        PLAIN_SMALL,
        frames=FRAMES,
        height=HEIGHT,
        width=WIDTH,
        unet=msgspec.structs.replace(PLAIN_SMALL.unet, width=16, embedding_width=32, head_width=16),
        vae=msgspec.structs.replace(PLAIN_SMALL.vae, width=16),
        sampling=msgspec.structs.replace(PLAIN_SMALL.sampling, steps=1),
    )
    path = folder / "untrained.safetensors"
    card = Card(name="untrained", config=config, family=FAMILIES["driving"], move_time=FRAMES - 1, trained=False)
    save_weights(random_networks(config, seed=0), path, card)
    return path


def ran(*words: object) -> tuple[int, str]:
    """`gcd-train` with these words: its exit code, and on one line all that it prints."""
    app, line = new_app([str(words[0])]), [str(word) for word in words]
    made = CliRunner().invoke(app, line, env={"COLUMNS": "240"}, catch_exceptions=False)
    return made.exit_code, " ".join(made.output.split())


def smaller(frames: int, height: int, width: int) -> ModelConfig:
    """A still smaller one."""
    change = msgspec.structs.replace
    unet = change(
        PLAIN_SMALL.unet,
        width=8,
        multipliers=(1, 2),
        attention=(False, True),
        embedding_width=16,
        head_width=8,
    )
    return change(
        PLAIN_SMALL,
        frames=frames,
        height=height,
        width=width,
        unet=unet,
        vae=change(PLAIN_SMALL.vae, width=8, multipliers=(1, 1, 2)),
    )
