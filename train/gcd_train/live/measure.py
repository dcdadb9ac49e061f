"""The live view measured beside splats by exact depth and homographies.

    python -m gcd_train.live.measure --heldout DIR --training DIR --weights FILE --sets paper,orbit \
        --methods splat,live --out DIR

Same clips, same run; writes report.md, report.json and a sheet of pictures for each set.
"""

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_model import hatched
from gcd_model.errors import ModelError
from gcd_model.live.config import LiveConfig
from gcd_train.errors import DataError, TrainError
from gcd_train.live.clips import LiveClip, clip_paths, evenly, read_clip
from gcd_train.live.measure_figures import (
    NAMED_CLASSES,
    STATES,
    MethodViews,
    Tally,
    fit_spread,
    scene_interval,
    truth_of,
)
from gcd_train.live.measure_methods import BestHomography, ExactSplat, Method, live_methods, live_model

_SHEET_FRAMES, _SHEET_CLIPS = (5, 9, 13), 4
_TABLES: dict[str, dict[str, tuple[str, int]]] = {
    "Pictures": {
        "PSNR": ("psnr", 2),
        "SSIM": ("ssim", 3),
    },
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


@dataclass(frozen=True, kw_only=True, slots=True)
class SetResult:
    """What became of one set: a tally for each method."""

    name: str
    clips: int
    tallies: dict[str, Tally]


def measure_set(name: str, paths: Sequence[Path], methods: Sequence[Method], sheet: Path) -> SetResult:
    """All methods on all clips of a set; seen pixels of all are compared to the first one's."""
    tallies = {method.name: Tally(LiveConfig().classes) for method in methods}
    rows: list[NDArray[np.uint8]] = []
    shown = set(np.linspace(0, len(paths) - 1, min(_SHEET_CLIPS, len(paths))).round().astype(int).tolist())
    for index, path in enumerate(paths):
        clip = read_clip(path)
        truth, scene = truth_of(clip), clip.name.rsplit("-", 1)[0]
        made = {method.name: method.views(clip) for method in methods}
        for each, views in made.items():
            tallies[each].add(scene, truth, views, made[methods[0].name].video)
        if index in shown:
            rows += _sheet_rows(clip, made, truth.video)
        print(f"{name}: clip {index + 1} of {len(paths)}", flush=True)
    cv2.imwrite(str(sheet), np.ascontiguousarray(np.concatenate(rows)[..., ::-1]))
    return SetResult(name=name, clips=len(paths), tallies=tallies)


def _sheet_rows(clip: LiveClip, made: dict[str, MethodViews], truth: Tensor) -> list[NDArray[np.uint8]]:
    """One row a frame: the source, every method, the first live one with what it painted hatched, the truth."""
    columns = {"source": torch.from_numpy(clip.arrays["source.rgb"]).permute(0, 3, 1, 2) / 255}
    columns |= {name: views.video for name, views in made.items()}
    says = next((views for views in made.values() if views.log_variance is not None), None)
    if says is not None and says.visibility is not None:
        told = (says.video.clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1).numpy()
        painted = hatched(told, says.visibility.numpy())
        columns["painted: hatched"] = torch.from_numpy(painted).permute(0, 3, 1, 2) / 255
    columns["truth"] = truth
    rows: list[NDArray[np.uint8]] = []
    for t in _SHEET_FRAMES:
        tiles = []
        for name, video in columns.items():
            tile = np.ascontiguousarray((video[t].clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy())
            for level, thickness in ((0, 2), (255, 1)):
                told = (f"{name}, frame {t + 1}", (3, 11), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (level,) * 3, thickness)
                cv2.putText(tile, *told, cv2.LINE_AA)
            tiles.append(tile)
        rows.append(np.concatenate(tiles, axis=1).astype(np.uint8))
    return rows


def to_markdown(results: Sequence[SetResult]) -> str:
    """All tables of all sets; a dash for what a method does not say."""
    lines = ["# The live view, measured", "", "Frames 2 to 14 of every clip.", ""]
    for result in results:
        lines += [f"## {result.name}: {result.clips} clips", ""]
        figures = {name: tally.figures() for name, tally in result.tallies.items()}
        for title, columns in _TABLES.items():
            lines += [f"### {title}", "", *_table(columns, figures), ""]
        lines += [*_differences(result), *_spreads(result), ""]
    return "\n".join(lines)


def _table(columns: dict[str, tuple[str, int]], figures: dict[str, dict[str, float]]) -> list[str]:
    lines = ["| |" + "|".join(columns) + "|", "|---|" + "---:|" * len(columns)]
    for name, each in figures.items():
        cells = [_cell(each.get(figure, math.nan), digits) for figure, digits in columns.values()]
        if any(cell != "-" for cell in cells):
            lines.append(f"|{name}|" + "|".join(cells) + "|")
    return lines


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
        apart = [float(np.mean(ours[scene]) - np.mean(each)) for scene, each in theirs.psnr.items()]
        low, high = scene_interval(apart)
        made[f"{first} - {other}"] = {"scenes": len(apart), "psnr": float(np.mean(apart)), "low": low, "high": high}
    return made


def _differences(result: SetResult) -> list[str]:
    return [
        f"- PSNR, {name}: {each['psnr']:+.2f} dB [{each['low']:+.2f}, {each['high']:+.2f}] "
        f"over {each['scenes']:.0f} scenes"
        for name, each in differences(result).items()
    ]


def _spreads(result: SetResult) -> list[str]:
    """What would calibrate the methods that state their spread, on these very clips."""
    lines: list[str] = []
    for name, tally in result.tallies.items():
        if bool(tally.spread.counts.sum() > 0):
            shifts = zip(STATES, fit_spread(tally.spread), strict=True)
            told = ", ".join(f"{shift:+.2f} ({state})" for state, shift in shifts)
            lines.append(f"- {name}: 90 % would lie inside with {told} added to the log-variance")
    return lines


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


def methods_of(names: Sequence[str], weights: str, training: Path) -> list[Method]:
    """By name, the exact splat first, as all are compared to it. Raises DataError for a name that is none."""
    others: list[Method] = [ExactSplat(training=training), BestHomography()]
    known: dict[str, Method] = {method.name: method for method in others}
    if any(name.startswith("live") for name in names):
        known |= live_methods(live_model(weights, device="cpu").networks)
    if unknown := [name for name in names if name not in known]:
        raise DataError(f"no method is called {unknown[0]!r}; there are {', '.join(known)}")
    return [known[name] for name in dict.fromkeys((others[0].name, *names))]


def main(arguments: Sequence[str] | None = None) -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description="Measure the live view beside splats and homographies.")
    parser.add_argument("--heldout", type=Path, required=True, help="folder of the sets")
    parser.add_argument("--training", type=Path, required=True, help="clips that fill holes as they are on average")
    parser.add_argument("--weights", default="package:live-small", help="a live model's")
    parser.add_argument("--sets", required=True, help="names of sets, with commas")
    parser.add_argument("--methods", default="splat,live", help="names of methods, with commas")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--clips", type=int, help="at most so many a set, evenly chosen")
    options = parser.parse_args(arguments)
    try:
        _measured(options)
    except (TrainError, ModelError) as error:
        raise SystemExit(f"error: {error}") from error


def _measured(options: argparse.Namespace) -> None:
    methods = methods_of(options.methods.split(","), options.weights, options.training)
    options.out.mkdir(parents=True, exist_ok=True)
    results: list[SetResult] = []
    for name in options.sets.split(","):
        paths = clip_paths(options.heldout / name)
        paths = paths if options.clips is None else evenly(paths, options.clips)
        results.append(measure_set(name, paths, methods, options.out / f"{name}.png"))
        (options.out / "report.md").write_text(to_markdown(results))
        (options.out / "report.json").write_text(json.dumps(to_json(results), indent=1))


if __name__ == "__main__":
    main()
