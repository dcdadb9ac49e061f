"""What the paint network learns from: target views of clips with what is seen of them, in batches by number.

What is seen, the splats of all frames by learned or by exact depth, is worked out once. `<clip>.safetensors` beside the
clips' own names holds of T frames: colour u8 [T, H, W, 3], coverage, now_share, age (tenths of frames, at most 25.5) u8
[T, H, W], log_depth u16 (see `encode_depth`), label and label_share u8 [T, H, W].
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.numpy import save_file
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from gcd_model.geometry import Intrinsics
from gcd_model.live.config import LIVE_CLASSES, SKY_M, LiveConfig
from gcd_model.live.depth_net import DepthNet, depth_inputs, plane_depth, read_depth
from gcd_model.live.eyes import SeenWorld
from gcd_model.live.paint_net import Painted, Seen, camera_features
from gcd_model.live.splat import Splat, splat, unproject
from gcd_train.data.sample import to_network
from gcd_train.files import whole
from gcd_train.live.batches import (
    Pictures,
    Random,
    autocast,
    halved,
    on,
    on_device,
    rays_of,
    with_true_references,
)
from gcd_train.live.clips import (
    CAMERAS,
    Array,
    Cameras,
    LiveClip,
    Numbers,
    Poses,
    Shelf,
    TrainingClips,
    decode_depth,
    encode_depth,
    read_clip,
    room_on,
    tensor_of,
)

_DEPTH_NOISE = 0.03
INPUTS = ("colour", "coverage", "now_share", "age", "log_depth", "label", "label_share")
"""What is read of a clip's inputs."""
PIXELS = ("target.rgb", "target.depth", "target.labels", "target.visibility")
"""What is read of a clip, beside poses."""
_MOST_CARRIED = 3
"""Frames in a row of which each sees what was painted in the one before."""
_DRIFT = 0.15
"""Largest standard deviation of the colours' drift, for colours in [-1, 1]."""


def splats_of(clip: LiveClip, source: Pictures, config: LiveConfig) -> list[Splat]:
    """What the target camera of every frame sees of what the source has shown so far, by the depth of `source`."""
    world, lens = SeenWorld(config), clip.lens("target")
    labels, static = source.labels.to(torch.uint8), source.moves < 0.5
    made: list[Splat] = []
    for t, (own, pose, target) in enumerate(zip(source.lenses, *map(clip.poses, CAMERAS), strict=True)):
        world.look(source.video[t], source.metres[t], labels[t], static[t], own, pose)
        made.append(world.splat(target, lens))
    return made


def write_inputs(path: Path, splats: Sequence[Splat]) -> None:
    """Store what the paint network sees; the file appears whole."""

    def stacked(name: str) -> Tensor:
        return torch.stack([getattr(splat, name) for splat in splats])

    (share, label), inverse = stacked("votes").max(dim=1), stacked("inverse_depth")
    metres = torch.where(inverse > 0, 1 / inverse.clamp(min=1e-6), 0.0)
    arrays: dict[str, Array] = {
        "colour": _byte((stacked("colour") + 1) / 2).transpose(0, 2, 3, 1).copy(),
        "coverage": _byte(stacked("coverage")),
        "now_share": _byte(stacked("now_share")),
        "age": _byte(stacked("age") / 25.5),
        "log_depth": encode_depth(metres.numpy()),
        "label": label.to(torch.uint8).numpy(),
        "label_share": _byte(share),
    }
    with whole(path) as unfinished:
        save_file(arrays, unfinished)


def _byte(share: Tensor) -> Array:
    return (share.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def make_inputs(out: Path, paths: Sequence[Path], net: DepthNet | None, config: LiveConfig, seed: int) -> None:
    """Inputs of clips; net: None for exact depth."""
    for path in paths:
        clip = read_clip(path)
        source, random = with_true_references(clip), np.random.default_rng([seed, int(path.stem.replace("-", ""))])
        if net is None:  # off by a few per cent in wide patches, as depth from anywhere is
            metres = source.metres
            rough = torch.from_numpy(random.normal(size=(len(metres), 1, 4, 6)) * _DEPTH_NOISE).float()
            smooth = interpolate(rough, size=metres.shape[-2:], mode="bilinear")[:, 0]
            source = replace(source, metres=torch.where(metres < SKY_M, metres * smooth.exp(), metres))
        else:
            source = _as_learned(net, config, source, source.ground(random, whole=True))
        write_inputs(out / path.parent.name / path.name, splats_of(clip, source, config))


@torch.inference_mode()
def _as_learned(net: DepthNet, config: LiveConfig, source: Pictures, ground: Tensor) -> Pictures:
    """Source frames with depth, classes and motion as the depth network has them, computed where that is."""
    device = next(net.parameters()).device
    there = on(device, source)
    with autocast(device):
        output = net(depth_inputs(there.video, there.rays, ground.to(device)), there.sweeps(config.depth))
    made = {"labels": output.classes.argmax(1), "moves": (output.moves >= 0).float()}
    return on(torch.device("cpu"), replace(there, metres=read_depth(output, config.depth).metres, **made))


def read_inputs(path: Path, frames: slice, names: Sequence[str] = INPUTS) -> dict[str, Array]:
    """What is stored of some frames: see the module."""
    with safe_open(path, framework="numpy") as file:
        return {name: file.get_slice(name)[frames] for name in names}


@dataclass(frozen=True, kw_only=True, slots=True)
class Views:
    """N target views: what is seen of them and the truth.

    target: [N, 3, H, W] in [-1, 1]. labels: int64, log_depth: float32, visibility: int64, [N, H, W]. poses:
    float64 [N, 4, 4], world_from_target. lenses: N.
    """

    seen: Seen
    target: Tensor
    labels: Tensor
    log_depth: Tensor
    visibility: Tensor
    poses: Tensor
    lenses: tuple[Intrinsics, ...]


def views_of(path: Path, inputs: Path, frames: slice) -> Views:
    """Some frames of a clip, with what is seen of them as it is stored there, and with a declared floor."""
    clip = read_clip(path, frames, [*(f"{name}.pose" for name in CAMERAS), *PIXELS])
    arrays = {name: tensor_of(array) for name, array in (clip.arrays | read_inputs(inputs, frames)).items()}
    targets = clip.cameras("target")
    return _views(arrays, clip.arrays["source.pose"], targets, np.full(len(targets.poses), True))


def _views(arrays: dict[str, Tensor], sources: Poses, cameras: Cameras, ground: Array) -> Views:
    """arrays: as clips and inputs have them, of N frames. sources: poses [N, 4, 4]; cameras: the targets'. ground:
    bool [N], where it is told.
    """
    target, poses = to_network(arrays["target.rgb"]), cameras.poses
    rays = rays_of(cameras.lenses, target.device)
    floor = plane_depth(rays, on_device(poses[:, 2, :3].copy(), target), on_device(cameras.heights_m, target))
    coverage = arrays["coverage"].float() / 255
    covered = coverage > 0
    share = (arrays["label_share"].float() / 255 * covered)[:, None]
    votes = torch.zeros(len(target), len(LIVE_CLASSES), *coverage.shape[1:], device=target.device)
    seen = Seen(
        colour=to_network(arrays["colour"]) * covered[:, None],
        coverage=coverage,
        now_share=arrays["now_share"].float() / 255,
        age=arrays["age"].float() / 10,
        log_depth=torch.where(covered, decode_depth(arrays["log_depth"]).log(), 0.0),
        votes=votes.scatter_(1, arrays["label"].long()[:, None], share),
        painted=torch.zeros_like(target),
        painted_coverage=torch.zeros_like(coverage),
        rays=rays,
        ground_m=floor * on_device(ground, target)[:, None, None],
        camera=camera_features(torch.from_numpy(np.linalg.inv(sources) @ poses)).to(target.device),
    )
    return Views(
        seen=seen,
        target=target,
        labels=arrays["target.labels"].long(),
        log_depth=decode_depth(arrays["target.depth"]).log(),
        visibility=arrays["target.visibility"].long(),
        poses=torch.from_numpy(poses),
        lenses=cameras.lenses,
    )


def halved_views(views: Views) -> Views:
    """See `halved`; the colours of what is seen count by how much of a pixel it covers."""
    seen, half = views.seen, halved(views)
    covered = avg_pool2d(seen.coverage[:, None], 2)
    colour = avg_pool2d(seen.colour * seen.coverage[:, None], 2) / covered.clamp(min=1e-6)
    return replace(half, seen=replace(half.seen, colour=colour))


class InputShelf(Shelf):
    """What is seen of clips, from folders of `make_inputs`, by number of the file."""

    def __init__(self, clips: TrainingClips, folders: Sequence[Path]) -> None:
        super().__init__(read_inputs, INPUTS, clips.device, room_on(clips.device))
        self._of: list[tuple[int, range]] = []
        for i, path in enumerate(clips.paths):
            first = len(self._paths)
            for file in (folder / path.parent.name / path.name for folder in folders):
                if file.exists():
                    self.add(file)
            if taken := range(first, len(self._paths)):
                self._of.append((i, taken))

    def drawn(self, random: Random, n: int) -> tuple[Numbers, Numbers]:
        """Numbers of N clips and of a file of each."""
        of = [self._of[i] for i in random.integers(len(self._of), size=n)]
        files = [each[int(place * len(each))] for (_, each), place in zip(of, random.random(n), strict=True)]
        return np.array([clip for clip, _ in of]), np.array(files)


class ViewBatches:
    """Batches of target views; the number of the update decides which.

    carried: share of the views that see what was painted a frame before.
    """

    def __init__(
        self, clips: TrainingClips, inputs: InputShelf, config: LiveConfig, size: int, seed: int, carried: float
    ) -> None:
        self._clips, self._inputs, self._config = clips, inputs, config
        self._size, self._seed, self._carried = size, seed, carried

    def batch(self, update: int) -> tuple[tuple[Views, ...], Views, Random]:
        """N views; before them the frames before of the first of them, in order, which see what was painted there.

        And the generator for what else is drawn.
        """
        random = np.random.default_rng([self._seed, update])
        carried = int(random.binomial(self._size, self._carried))
        run = min(int(random.integers(1, _MOST_CARRIED + 1)), self._config.frames - 1) if carried else 0
        clips, inputs = self._inputs.drawn(random, self._size)
        frames = random.integers(self._config.frames - run * (np.arange(self._size) < carried))
        frames[:carried] += run
        ground, look = random.random(self._size) < 0.6, other_look(random, self._size)

        def views(back: int, count: int) -> Views:
            """The first so many, some frames earlier."""
            times, some = frames[:count] - back, clips[:count]
            arrays = self._clips.take(some, times, PIXELS) | self._inputs.take(inputs[:count], times, INPUTS)
            sources, targets = (self._clips.cameras(name, some, times) for name in CAMERAS)
            return look(_views(arrays, sources.poses, targets, ground[:count]))

        return tuple(views(back, carried) for back in range(run, 0, -1)), views(0, self._size), random


def other_look(random: Random, n: int) -> Callable[[Views], Views]:
    """Exposure, gamma and white balance of N views, the same for what is seen and for the truth."""
    gamma = np.exp(random.normal(size=(n, 1, 1, 1)) * 0.2)
    gain = np.exp(random.normal(size=(n, 1, 1, 1)) * 0.12 + random.normal(size=(n, 3, 1, 1)) * 0.05)

    def look(views: Views) -> Views:
        """Of the first of them."""
        power, scale = (on_device(each[: len(views.poses)], views.target) for each in (gamma, gain))

        def changed(x: Tensor) -> Tensor:
            return ((((x + 1) / 2).clamp(0, 1) ** power) * scale).clamp(0, 1) * 2 - 1

        colour = changed(views.seen.colour) * (views.seen.coverage > 0)[:, None]
        return replace(views, seen=replace(views.seen, colour=colour), target=changed(views.target))

    return look


def mirrored(views: Views) -> Views:
    """All of it seen in a mirror. Poses are not: carry what was painted before."""
    seen = views.seen
    fixed = ("rays", "camera")
    turned = {f.name: getattr(seen, f.name).flip(-1) for f in fields(seen) if f.name not in fixed}
    # x becomes -x in both cameras: rotation entries that mix x with another axis change sign, and so does the move in x
    signs = torch.tensor([1.0, -1, -1, -1, 1, 1, -1, 1, 1, -1, 1, 1], device=seen.camera.device)
    truth = {name: getattr(views, name).flip(-1) for name in ("target", "labels", "log_depth", "visibility")}
    return replace(views, seen=replace(seen, **turned, camera=seen.camera * signs), **truth)


@torch.no_grad()
def carried_through(
    first_step: Callable[[Seen], Painted], before: Sequence[Views], now: Views, movable: Tensor, random: Random
) -> Views:
    """`now` with what is painted frame after frame before the first of its views; colours drift a little on the way.

    Without the drift a painter learns to believe what it painted, and its errors add up over many frames.
    Source: the noise on past frames of Valevski et al. 2024 (GameNGen), section 3.2.
    """
    if not before:
        return now
    views = before[0]
    for after in (*before[1:], now):
        views = carry(first_step(views.seen), views, after, movable)
    seen, count = views.seen, len(before[0].poses)
    strength = _DRIFT * random.random((count, 1, 1, 1))
    rough = [random.normal(size=(count, 3, *cells)) * strength for cells in ((1, 1), (4, 6))]
    size = seen.painted.shape[-2:]
    drift = sum(interpolate(torch.from_numpy(each).to(seen.painted), size=size, mode="bilinear") for each in rough)
    painted = seen.painted.clone()
    painted[:count] = (painted[:count] + drift).clamp(-1, 1) * (seen.painted_coverage[:count, None] > 0)
    return replace(views, seen=replace(seen, painted=painted))


@torch.no_grad()
def carry(painted: Painted, before: Views, now: Views, movable: Tensor) -> Views:
    """`now` with what was painted in the frames before of the first of its views, moved into their cameras."""
    colours, coverages = now.seen.painted.clone(), now.seen.painted_coverage.clone()
    labels = painted.classes.argmax(1)
    for i, (pose, lens) in enumerate(zip(before.poses, before.lenses, strict=True)):
        keep = (before.seen.coverage[i] < 0.5) & ~movable[labels[i]]
        metres, picture, label = painted.log_depth[i].exp(), painted.picture[i].clamp(-1, 1), labels[i].to(torch.uint8)
        surfels = unproject(metres, picture, label, lens, pose, 0.0, painted=True, keep=keep)
        moved = splat(surfels, now.poses[i], now.lenses[i], painted.classes.shape[1], 0.0)
        colours[i], coverages[i] = moved.colour, moved.coverage
    return replace(now, seen=replace(now.seen, painted=colours, painted_coverage=coverages))
