"""The live view measured beside the splat by exact depth, the best homography, and itself in other ways.

    python tools/live_measure.py --heldout DIR --training DIR --weights FILE --sets paper,orbit \
        --methods splat,live --out DIR

Same clips, same run; writes report.md, report.json and a sheet of pictures for each set. The other ways are errors that
nobody declares and other ways to paint: `--methods live,live-mean`, see `variants`.
"""

import argparse
import json
import math
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import torch
from live_figures import NAMED_CLASSES, MethodViews, Tally, truth_of
from torch import Tensor

from gcd_model import hatched
from gcd_model.errors import ModelError
from gcd_model.geometry import Intrinsics, invert_rigid
from gcd_model.layers import zeroed
from gcd_model.live.config import SKY_M, LiveConfig
from gcd_model.live.eyes import Eyes, Floor, FrameGeometry
from gcd_model.live.paint_net import filled, seen_of
from gcd_model.live.splat import splat, unproject
from gcd_model.live.synthesizer import COVERED
from gcd_model.networks import LiveNetworks
from gcd_train.errors import DataError, TrainError
from gcd_train.evaluation.galleries import Strip, to_bytes, write_sheet
from gcd_train.evaluation.predictors import pixel_rays, to_pixels
from gcd_train.evaluation.statistics import scene_weights
from gcd_train.evaluation.tables import markdown_rows
from gcd_train.live.batches import pictures_of
from gcd_train.live.calibration import fit_spread, floors_of, frames_of
from gcd_train.live.clips import NEVER, NOW, STATES, Array, LiveClip, clip_paths, evenly, read_clip, training_paths
from gcd_train.live.training import live_model

_FEWEST_PAIRS, _MOST_PAIRS = 8, 3000
_RANSAC_PX = 1.5
_ECC_ROUNDS, _ECC_STEP = 40, 1e-5
_SAMPLE = 60
"""Training clips that the fill of holes is read off."""
_SHEET_FRAMES, _SHEET_CLIPS = (5, 9, 13), 4
_TABLES: dict[str, dict[str, tuple[str, int]]] = {
    "Pictures": {"PSNR": ("psnr", 2), "SSIM": ("ssim", 3)},
    "Seen pixels": {
        "share": ("share_seen", 3),
        "PSNR": ("psnr_seen", 2),
        "error / splat's": ("error_ratio_seen", 2),
        "SSIM": ("ssim_seen", 3),
    },
    "Never-seen pixels": {
        "share": ("share_never", 3),
        "PSNR": ("psnr_never", 2),
        "gradient energy": ("gradient_energy", 2),
        "Frechet, random": ("frechet_random", 2),
    },
    "Classes": {"mIoU": ("miou", 3), **{name: (name, 3) for name in NAMED_CLASSES}},
    "Visibility and spread": {
        **{f"IoU {name}": (f"iou_{name}", 3) for name in STATES},
        **{f"in 90 %: {name}": (f"inside_90_{name}", 3) for name in STATES},
    },
    "Time": {"flicker / truth's": ("flicker", 2), "jump / truth's": ("jump", 2)},
}


class Method(Protocol):
    """Shows a clip as its target camera would have seen it."""

    @property
    def name(self) -> str: ...
    def views(self, clip: LiveClip) -> MethodViews:
        """All frames of it."""
        ...


@lru_cache
def commonest_class(training: Path, world: str) -> int:
    """Of target pixels of a world's training clips. Raises DataError if there are none."""
    paths = [path for path in training_paths(training) if path.parent.name == world]
    if not paths:
        raise DataError(f"{training} holds no training clips of {world!r}; holes are filled as they are on average")
    counts = np.zeros(256)
    for path in evenly(paths, _SAMPLE):
        labels = read_clip(path, slice(6, 7), ["target.labels"]).arrays["target.labels"]
        counts += np.bincount(labels.ravel(), minlength=256)
    return int(counts.argmax())


@dataclass(frozen=True, kw_only=True, slots=True)
class ExactSplat:
    """This frame's pixels by their exact depth, as surfels; holes have the colours around and the commonest class."""

    training: Path
    name: str = "splat"

    def views(self, clip: LiveClip) -> MethodViews:
        """See Method."""
        source, lens, classes = pictures_of(clip), clip.lens("target"), len(LiveConfig().classes)
        rays, nothing, labels = lens.rays(), torch.zeros(lens.height, lens.width), source.labels.to(torch.uint8)
        made, video = [], []
        for t, (pose, target) in enumerate(zip(clip.poses("source"), clip.poses("target"), strict=True)):
            surfels = unproject(source.metres[t], source.video[t], labels[t], source.lenses[t], pose, 1.0)
            made.append(splat(surfels, target, lens, classes, 1.0))
            seen = seen_of(made[-1], None, rays, nothing, torch.zeros(12))
            video.append((filled(seen)[0].clamp(-1, 1) + 1) / 2)
        covered, votes = (
            torch.stack(each) for each in zip(*((s.coverage, s.votes.argmax(0)) for s in made), strict=True)
        )
        label = commonest_class(self.training, str(clip.facts["world"]))
        return MethodViews(
            video=torch.stack(video),
            classes=torch.where(covered > 0, votes, label).to(torch.uint8),
            visibility=torch.where(covered >= COVERED, NOW, NEVER).to(torch.uint8),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class LiveModel:
    """The live model, frame by frame as a node runs it.

    floor_higher_m, floor_tilt_deg: how far the declared floor is off. steps: of the paint sampler, None as shipped.
    eyes: what looks at the source.
    """

    networks: LiveNetworks
    name: str = "live"
    floor_higher_m: float = 0.0
    floor_tilt_deg: float = 0.0
    steps: int | None = None
    eyes: Callable[[LiveNetworks], Eyes] = Eyes

    def views(self, clip: LiveClip) -> MethodViews:
        """See Method."""
        source = pictures_of(clip)
        floors, eyes = [self._misjudged(floor) for floor in floors_of(source)], self.eyes(self.networks)
        frames = frames_of(self.networks, clip, source, floors, eyes=eyes, steps=self.steps)
        return MethodViews(
            video=torch.stack([(frame.picture.clamp(-1, 1) + 1) / 2 for frame in frames]),
            classes=torch.stack([frame.classes for frame in frames]),
            visibility=torch.stack([frame.visibility for frame in frames]),
            log_variance=torch.stack([frame.log_variance for frame in frames]),
        )

    def _misjudged(self, floor: Floor) -> Floor:
        tilt = torch.tensor(np.radians(self.floor_tilt_deg)).float()
        x, y, z = floor.up
        up = torch.stack([x, y * tilt.cos() - z * tilt.sin(), y * tilt.sin() + z * tilt.cos()])
        return Floor(up=up, height_m=floor.height_m + self.floor_higher_m)


@dataclass(frozen=True, kw_only=True, slots=True)
class BestHomography:
    """The source's picture under the best plane-to-plane map, frame by frame: of three the one nearest to the truth.

    Candidates: least squares and RANSAC on exact correspondences of pixels that are seen now, and ECC on the pictures.
    """

    name: str = "homography"

    def views(self, clip: LiveClip) -> MethodViews:
        """See Method."""
        metres, seen = clip.depth("target"), torch.from_numpy(clip.arrays["target.visibility"] == NOW)
        video, classes = [], []
        for t, move in enumerate(invert_rigid(clip.poses("source")) @ clip.poses("target")):
            source, target = (clip.arrays[f"{name}.rgb"][t] for name in ("source", "target"))
            places = _correspondences(metres[t], seen[t], move, clip.lens("target"), clip.lens("source"))
            shown = [(_warped(source, each, cv2.INTER_LINEAR), each) for each in _candidates(*places, source, target)]
            best, chosen = min(shown, key=lambda each: float(np.square(each[0].astype(np.float64) - target).mean()))
            video.append(best)
            classes.append(_warped(clip.arrays["source.labels"][t], chosen, cv2.INTER_NEAREST))
        pictures = torch.from_numpy(np.stack(video)).permute(0, 3, 1, 2).float() / 255
        return MethodViews(video=pictures, classes=torch.from_numpy(np.stack(classes)))


def _correspondences(
    metres: Tensor, seen: Tensor, source_from_target: Tensor, lens: Intrinsics, own: Intrinsics
) -> tuple[Array, Array]:
    """Where pixels are in the target and in the source, [N, 2] each, as OpenCV counts pixels; evenly chosen.

    metres: [H, W], of the target. seen: bool [H, W], the pixels to take. lens, own: of target and source.
    """
    v, u = (each[:: max(len(each) // _MOST_PAIRS, 1)] for each in seen.nonzero(as_tuple=True))
    points = pixel_rays(lens)[v, u] * metres[v, u, None].double()
    there = to_pixels(points @ source_from_target[:3, :3].T + source_from_target[:3, 3], own) - 0.5
    return torch.stack([u, v], dim=1).double().numpy(), there.numpy()


def _candidates(here: Array, there: Array, source: Array, target: Array) -> list[Array]:
    """Maps from target to source pixels."""
    made: list[Array | None] = []
    if len(here) >= _FEWEST_PAIRS:
        made = [cv2.findHomography(here, there, method, _RANSAC_PX)[0] for method in (0, cv2.RANSAC)]
    kept = [each for each in made if each is not None] or [np.eye(3)]
    template, moved = (cv2.cvtColor(np.ascontiguousarray(each), cv2.COLOR_RGB2GRAY) for each in (target, source))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _ECC_ROUNDS, _ECC_STEP)
    try:
        found = cv2.findTransformECC(template, moved, kept[0].astype(np.float32), cv2.MOTION_HOMOGRAPHY, criteria)[1]
    except cv2.error:  # it does not converge where the pictures have little in common
        return kept
    return [*kept, np.asarray(found)]


def _warped(picture: Array, source_from_target: Array, interpolation: int) -> Array:
    height, width = picture.shape[:2]
    flags, move = interpolation | cv2.WARP_INVERSE_MAP, source_from_target.astype(np.float64)
    return np.asarray(cv2.warpPerspective(picture, move, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE))


class Misjudging(Eyes):
    """Eyes whose depth is off by a factor."""

    def __init__(self, networks: LiveNetworks, scale: float) -> None:
        super().__init__(networks)
        self._scale = scale

    def look(self, *args: Any, **kwargs: Any) -> FrameGeometry:
        geometry = super().look(*args, **kwargs)
        metres = geometry.metres
        return replace(geometry, metres=torch.where(metres < SKY_M, metres * self._scale, metres))


def variants(live: LiveModel) -> Sequence[Method]:
    """The homography, and the live model with what may be wrong, with several steps, its mean, or that made crisp."""
    mean, crisp = deepcopy(live.networks), deepcopy(live.networks)
    mean.paint.first_step = partial(mean.paint.first_step, detail=False)
    zeroed(crisp.paint.detail.out)
    return [
        BestHomography(),
        replace(live, name="live-depth-0.9", eyes=partial(Misjudging, scale=0.9)),
        replace(live, name="live-depth-1.1", eyes=partial(Misjudging, scale=1.1)),
        replace(live, name="live-floor-20cm", floor_higher_m=0.2),
        replace(live, name="live-floor-2deg", floor_tilt_deg=2.0),
        replace(live, name="live-2-steps", steps=2),
        replace(live, name="live-4-steps", steps=4),
        replace(live, name="live-mean", networks=mean),
        replace(live, name="live-crisp", networks=crisp),
    ]


def chosen_methods(names: Sequence[str], known: Sequence[Method]) -> list[Method]:
    """By name, the first one in any case, as all are compared to it. Raises DataError for a name that is none."""
    by_name = {method.name: method for method in known}
    if unknown := [name for name in names if name not in by_name]:
        raise DataError(f"no method is called {unknown[0]!r}; there are {', '.join(by_name)}")
    return [by_name[name] for name in dict.fromkeys((known[0].name, *names))]


@dataclass(frozen=True, kw_only=True, slots=True)
class SetResult:
    """What became of one set: a tally for each method."""

    name: str
    clips: int
    tallies: dict[str, Tally]


def measure_set(name: str, paths: Sequence[Path], methods: Sequence[Method], sheet: Path) -> SetResult:
    """All methods on all clips of a set; seen pixels of all are compared to the first one's."""
    tallies = {method.name: Tally(LiveConfig().classes) for method in methods}
    shown = set(np.linspace(0, len(paths) - 1, min(_SHEET_CLIPS, len(paths))).round().astype(int).tolist())
    rows: list[tuple[str, list[Strip]]] = []
    for index, path in enumerate(paths):
        clip = read_clip(path)
        truth, scene = truth_of(clip), clip.name.rsplit("-", 1)[0]
        made = {method.name: method.views(clip) for method in methods}
        for each, views in made.items():
            tallies[each].add(scene, truth, views, made[methods[0].name].video)
        if index in shown:
            rows.append((clip.name, _strips(clip, made, truth.video)))
        print(f"{name}: clip {index + 1} of {len(paths)}", flush=True)
    write_sheet(rows, sheet)
    return SetResult(name=name, clips=len(paths), tallies=tallies)


def _strips(clip: LiveClip, made: dict[str, MethodViews], truth: Tensor) -> list[Strip]:
    """Some frames of the source, of every method, of the first live one with what it painted hatched, of the truth."""
    videos = {"source": clip.arrays["source.rgb"], **{name: to_bytes(views.video) for name, views in made.items()}}
    for name, views in made.items():
        if views.log_variance is not None and views.visibility is not None:
            videos["painted: hatched"] = hatched(videos[name], views.visibility.numpy())
            break
    videos["truth"] = to_bytes(truth)
    return [Strip(name=name, frames={t: video[t] for t in _SHEET_FRAMES}) for name, video in videos.items()]


def to_markdown(results: Sequence[SetResult]) -> str:
    """All tables of all sets; a dash for what a method does not say."""
    lines = ["# The live view, measured", "", "Frames 2 to 14 of every clip.", ""]
    for result in results:
        lines += [f"## {result.name}: {result.clips} clips", ""]
        figures = {name: tally.figures() for name, tally in result.tallies.items()}
        for title, columns in _TABLES.items():
            rows = [
                [name, *(_cell(each[figure], digits) for figure, digits in columns.values())]
                for name, each in figures.items()
            ]
            said = [row for row in rows if any(cell != "-" for cell in row[1:])]
            lines += [f"### {title}", "", *markdown_rows(["", *columns], said), ""]
        lines += [
            f"- PSNR, {name}: {each['psnr']:+.2f} dB [{each['low']:+.2f}, {each['high']:+.2f}] "
            f"over {each['scenes']:.0f} scenes"
            for name, each in differences(result).items()
        ]
        for name, tally in result.tallies.items():
            if bool(tally.spread.counts.sum() > 0):
                shifts = zip(STATES, fit_spread(tally.spread), strict=True)
                told = ", ".join(f"{shift:+.2f} ({state})" for state, shift in shifts)
                lines.append(f"- {name}: 90 % would lie inside with {told} added to the log-variance")
        lines.append("")
    return "\n".join(lines)


def _cell(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def differences(result: SetResult) -> dict[str, dict[str, float]]:
    """PSNR of the first live method above each other, mean over scenes with its 95 % interval, by their names."""
    first = next((name for name in result.tallies if name.startswith("live")), None)
    made: dict[str, dict[str, float]] = {}
    for other, theirs in result.tallies.items():
        if first is None or other == first:
            continue
        ours = result.tallies[first].psnr
        apart = np.array([np.mean(ours[scene]) - np.mean(each) for scene, each in theirs.psnr.items()])
        low, high = np.quantile(scene_weights(len(apart)) @ apart / len(apart), [0.025, 0.975]).tolist()
        made[f"{first} - {other}"] = {"scenes": len(apart), "psnr": float(apart.mean()), "low": low, "high": high}
    return made


def to_json(results: Sequence[SetResult]) -> dict[str, Any]:
    """The same as numbers, with every scene's PSNR."""
    return {
        result.name: {
            "clips": result.clips,
            "methods": {
                name: {
                    **tally.figures(),
                    "spread_shift": fit_spread(tally.spread),
                    "psnr_of_scenes": {scene: float(np.mean(each)) for scene, each in tally.psnr.items()},
                }
                for name, tally in result.tallies.items()
            },
            "differences": differences(result),
        }
        for result in results
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description="Measure the live view beside the exact splat.")
    parser.add_argument("--heldout", type=Path, required=True, help="folder of the sets")
    parser.add_argument("--training", type=Path, required=True, help="clips that fill holes as they are on average")
    parser.add_argument("--weights", default="package:live-small", help="a live model's")
    parser.add_argument("--sets", required=True, help="names of sets, with commas")
    parser.add_argument("--methods", default="splat,live", help="names of methods, with commas")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--clips", type=int, help="at most so many a set, evenly chosen")
    options = parser.parse_args(arguments)
    results: list[SetResult] = []
    try:
        live = LiveModel(networks=live_model(options.weights, device="cpu").networks)
        known = [ExactSplat(training=options.training), live, *variants(live)]
        methods = chosen_methods(options.methods.split(","), known)
        options.out.mkdir(parents=True, exist_ok=True)
        for name in options.sets.split(","):
            paths = clip_paths(options.heldout / name)
            paths = paths if options.clips is None else evenly(paths, options.clips)
            results.append(measure_set(name, paths, methods, options.out / f"{name}.png"))
            (options.out / "report.md").write_text(to_markdown(results))
            (options.out / "report.json").write_text(json.dumps(to_json(results), indent=1))
    except (TrainError, ModelError) as error:
        raise SystemExit(f"error: {error}") from error


if __name__ == "__main__":
    main()
