"""What the paint network sees of a clip, worked out once: the splats of all its frames, by learned or by exact depth.

`<clip>.safetensors` beside the clips' own names holds, for T frames: colour u8 [T, H, W, 3], coverage, now_share, age
(tenths of frames, at most 25.5) u8 [T, H, W], log_depth u16 (see `encode_depth`), label and label_share u8 [T, H, W].
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save_file
from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_model.live.config import SKY_M, LiveConfig
from gcd_model.live.depth_net import DepthNet, depth_inputs, read_depth
from gcd_model.live.memory import SeenWorld
from gcd_model.live.splat import Splat
from gcd_train.files import whole
from gcd_train.live.batches import Pictures, Random, autocast, pictures_of, with_true_references
from gcd_train.live.clips import LiveClip, decode_depth, encode_depth, read_clip

Array = NDArray[Any]
_DEPTH_NOISE = 0.03


@dataclass(frozen=True, kw_only=True, slots=True)
class Geometry:
    """What is known of a clip's source frames: metres [T, H, W], labels uint8 [T, H, W], static bool [T, H, W]."""

    metres: Tensor
    labels: Tensor
    static: Tensor


@torch.inference_mode()
def learned_geometry(net: DepthNet, config: LiveConfig, source: Pictures, ground: Tensor) -> Geometry:
    """By the depth network, frame by frame."""
    metres, labels, static = [], [], []
    sweeps = source.sweeps(config.depth)
    for t in range(len(source.lenses)):
        inputs = depth_inputs(source.video[t : t + 1], source.rays[t : t + 1], ground[t : t + 1])
        with autocast(inputs.device):
            output = net(inputs, sweeps[t : t + 1])
        metres.append(read_depth(output, config.depth).metres)
        labels.append(output.classes.argmax(1).to(torch.uint8))
        static.append(output.moves < 0)
    return Geometry(metres=torch.cat(metres), labels=torch.cat(labels), static=torch.cat(static))


def exact_geometry(source: Pictures, random: Random | None = None) -> Geometry:
    """The truth; with `random`, off by a few per cent in wide patches, as depth from anywhere is."""
    metres = source.metres
    if random is not None:
        rough = torch.from_numpy(random.normal(size=(len(metres), 1, 4, 6)) * _DEPTH_NOISE).float()
        smooth = torch.nn.functional.interpolate(rough, size=metres.shape[-2:], mode="bilinear")[:, 0]
        metres = torch.where(metres < SKY_M, metres * smooth.exp(), metres)
    return Geometry(metres=metres, labels=source.labels.to(torch.uint8), static=source.moves < 0.5)


def splats_of(clip: LiveClip, geometry: Geometry, config: LiveConfig, *, memory: bool = True) -> list[Splat]:
    """What the target camera of every frame sees of what the source has shown so far."""
    world = SeenWorld(
        classes=len(config.classes),
        capacity=config.memory if memory else 0,
        oldest_frames=config.memory_frames,
    )
    height, width = geometry.metres.shape[-2:]
    lens = Intrinsics.from_hfov(clip.hfov_deg("source"), width, height)
    target_lens = Intrinsics.from_hfov(clip.hfov_deg("target"), width, height)
    source = pictures_of(clip, "source")
    made: list[Splat] = []
    for t in range(clip.frames):
        pose, target = (torch.from_numpy(clip.arrays[f"{camera}.pose"][t]) for camera in ("source", "target"))
        world.look(source.video[t], geometry.metres[t], geometry.labels[t], geometry.static[t], lens, pose)
        made.append(world.splat(target, target_lens))
    return made


def write_inputs(path: Path, splats: Sequence[Splat]) -> None:
    """Store what the paint network sees; the file appears whole."""
    stacked = {
        name: torch.stack([getattr(splat, name) for splat in splats])
        for name in ("colour", "coverage", "now_share", "age", "inverse_depth", "votes")
    }
    share, label = stacked["votes"].max(dim=1)
    inverse = stacked["inverse_depth"]
    metres = torch.where(inverse > 0, 1 / inverse.clamp(min=1e-6), 0.0)
    arrays: dict[str, Array] = {
        "colour": _byte((stacked["colour"] + 1) / 2).transpose(0, 2, 3, 1).copy(),
        "coverage": _byte(stacked["coverage"]),
        "now_share": _byte(stacked["now_share"]),
        "age": _byte(stacked["age"] / 25.5),
        "log_depth": encode_depth(metres.numpy()),
        "label": label.to(torch.uint8).numpy(),
        "label_share": _byte(share),
    }
    with whole(path) as unfinished:
        save_file(arrays, unfinished)


def _byte(share: Tensor) -> Array:
    return (share.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def make_inputs(out: Path, paths: Sequence[Path], net: DepthNet | None, config: LiveConfig, seed: int) -> None:
    """Inputs of every clip that has none yet; net: None for exact depth."""
    for path in paths:
        place = out / path.parent.name / path.name
        if place.exists():
            continue
        clip = read_clip(path)
        source = with_true_references(clip, "source")
        random = np.random.default_rng([seed, int(path.stem.replace("-", ""))])
        if net is None:
            geometry = exact_geometry(source, random)
        else:
            geometry = learned_geometry(net, config, source, source.ground(random, whole=True))
        write_inputs(place, splats_of(clip, geometry, config))


def read_inputs(path: Path, frames: slice, classes: int) -> dict[str, Tensor]:
    """The fields of `Seen` that do not depend on the lens, of some frames: see the module."""
    with safe_open(path, framework="numpy") as file:
        arrays = {name: file.get_slice(name)[frames] for name in file.keys()}  # noqa: SIM118
    metres = torch.from_numpy(decode_depth(arrays.pop("log_depth")))
    cut = {name: torch.from_numpy(array) for name, array in arrays.items()}
    coverage = cut["coverage"].float() / 255
    share = (cut["label_share"].float() / 255 * (coverage > 0))[:, None]
    votes = torch.zeros(len(coverage), classes, *coverage.shape[1:]).scatter_(1, cut["label"].long()[:, None], share)
    return {
        "colour": (cut["colour"].permute(0, 3, 1, 2).float() / 127.5 - 1) * (coverage > 0)[:, None],
        "coverage": coverage,
        "now_share": cut["now_share"].float() / 255,
        "age": cut["age"].float() / 10,
        "log_depth": torch.where(coverage > 0, metres.log(), 0.0),
        "votes": votes,
    }
