"""The live view measured beside splats by exact depth and homographies.

    python -m gcd_train.live.measure --heldout DIR --training DIR --judge FILE --weights FILE --sets paper-first,orbit \
        --methods splat,live --out DIR

Same clips, same run; writes report.md, report.json and a sheet of pictures for each set.
"""

import argparse
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
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
from gcd_model.networks import LiveNetworks
from gcd_train.errors import DataError, TrainError
from gcd_train.live.clips import LiveClip, clip_paths, evenly, read_clip
from gcd_train.live.judge import JudgeNet, load_judge, random_judge
from gcd_train.live.measure_figures import STATES, MethodViews, Tally, fit_spread, scene_interval, truth_of
from gcd_train.live.measure_methods import (
    BestHomography,
    ExactSplat,
    Kept,
    Method,
    PointSplat,
    live_methods,
    live_model,
)

_SHEET_FRAMES, _SHEET_CLIPS = (5, 9, 13), 4
_TABLES: dict[str, dict[str, tuple[str, int]]] = {
    "Pictures": {
        "PSNR": ("psnr", 2),
        "last frame": ("psnr_last", 2),
        "SSIM": ("ssim", 3),
        "CPU ms a frame": ("cpu_ms_a_frame", 0),
    },
    "Seen pixels": {
        "share": ("share_seen", 3),
        "PSNR": ("psnr_seen", 2),
        "error / splat's": ("error_ratio_seen", 2),
        "SSIM": ("ssim_seen", 3),
        "depth within 10 %": ("depth_within_10_seen", 3),
        "seen now: share": ("share_now", 3),
        "PSNR, now": ("psnr_now", 2),
        "error / splat's, now": ("error_ratio_now", 2),
    },
    "Never-seen pixels": {
        "share": ("share_never", 3),
        "PSNR": ("psnr_never", 2),
        "gradient energy": ("gradient_energy", 2),
        "Frechet, judge": ("frechet_judge", 2),
        "Frechet, random": ("frechet_random", 2),
    },
    "Classes": {
        "mIoU": ("miou", 3),
        "person": ("person", 3),
        "cyclist": ("cyclist", 3),
        "car": ("car", 3),
        "pole": ("pole", 3),
        "mIoU 96x64": ("miou_coarse", 3),
        "person 96x64": ("person_coarse", 3),
        "cyclist 96x64": ("cyclist_coarse", 3),
        "car 96x64": ("car_coarse", 3),
        "pole 96x64": ("pole_coarse", 3),
    },
    "Visibility and spread": {
        **{f"IoU {name}": (f"iou_{name}", 3) for name in STATES},
        **{f"in 90 %: {name}": (f"inside_90_{name}", 3) for name in STATES},
    },
    "Time": {
        "flicker / truth's": ("flicker", 2),
        "flicker, levels": ("flicker_levels", 2),
        "jump / truth's": ("jump", 2),
        "jump, levels": ("jump_levels", 2),
    },
}


@dataclass(frozen=True, kw_only=True, slots=True)
class SetResult:
    """What became of one set: a tally for each method, and why others are missing."""

    name: str
    clips: int
    tallies: dict[str, Tally]
    missing: dict[str, str] = field(default_factory=dict[str, str])


def measure_set(
    name: str, paths: Sequence[Path], methods: Sequence[Method], splat: Method, judges: dict[str, JudgeNet], sheet: Path
) -> SetResult:
    """All methods on all clips of a set; `splat` is always among them, as seen pixels are compared to it."""
    rest = [method for method in methods if method.name != splat.name]
    result = SetResult(name=name, clips=len(paths), tallies={}, missing={})
    rows: list[NDArray[np.uint8]] = []
    shown = set(np.linspace(0, len(paths) - 1, min(_SHEET_CLIPS, len(paths))).round().astype(int).tolist())
    for index, path in enumerate(paths):
        clip = read_clip(path)
        truth, scene = truth_of(clip, list(judges.values())), clip.name.rsplit("-", 1)[0]
        made: dict[str, MethodViews] = {}
        for method in (splat, *rest):
            if method.name in result.missing:
                continue
            start = time.process_time()
            try:
                views = method.views(clip)
            except DataError as error:
                if method is splat:  # all are measured beside it
                    raise
                result.missing[method.name] = str(error)
                result.tallies.pop(method.name, None)
                continue
            spent = time.process_time() - start
            made[method.name] = views = views if views.cpu_s is not None else replace(views, cpu_s=spent)
            tally = result.tallies.setdefault(method.name, Tally(LiveConfig().classes, judges))
            tally.add(scene, truth, views, made[splat.name].video)
        if index in shown:
            rows += _sheet_rows(clip, made, truth.video)
        print(f"{name}: clip {index + 1} of {len(paths)}", flush=True)
    cv2.imwrite(str(sheet), np.ascontiguousarray(np.concatenate(rows)[..., ::-1]))
    return result


def _sheet_rows(clip: LiveClip, made: dict[str, MethodViews], truth: Tensor) -> list[NDArray[np.uint8]]:
    """One row a frame: the source, every method, the first one with visibility of its own hatched, the truth."""
    columns = {"source": torch.from_numpy(clip.arrays["source.rgb"]).permute(0, 3, 1, 2) / 255}
    columns |= {name: views.video for name, views in made.items()}
    says = next(
        (views for views in made.values() if views.visibility is not None and views.log_variance is not None), None
    )
    if says is not None and says.visibility is not None:
        shown = says.visibility.numpy()
        painted = hatched((says.video.clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1).numpy(), shown)
        columns["painted: hatched"] = torch.from_numpy(painted).permute(0, 3, 1, 2) / 255
    columns["truth"] = truth
    rows: list[NDArray[np.uint8]] = []
    for t in _SHEET_FRAMES:
        tiles = []
        for name, video in columns.items():
            tile = np.ascontiguousarray((video[t].clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy())
            label = f"{name}, frame {t + 1}"
            cv2.putText(tile, label, (3, 11), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (0, 0, 0), 2, cv2.LINE_AA)
            tiles.append(
                cv2.putText(tile, label, (3, 11), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (255, 255, 255), 1, cv2.LINE_AA)
            )
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
        lines += [*_differences(result), *_spreads(result)]
        lines += [f"- {name} is missing: {reason}" for name, reason in result.missing.items()]
        lines.append("")
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
    """PSNR of the first live method above each other method, mean over scenes with its 95 % interval, by their names.

    Beside it over the scenes alone that lie within what the other was made for.
    """
    first = next((name for name in result.tallies if name.startswith("live")), None)
    made: dict[str, dict[str, float]] = {}
    for other, theirs in result.tallies.items():
        if first is None or other == first:
            continue
        ours = result.tallies[first].psnr
        apart = {scene: float(np.mean(ours[scene]) - np.mean(each)) for scene, each in theirs.psnr.items()}
        within = [value for scene, value in apart.items() if scene not in theirs.outside]
        low, high = scene_interval(list(apart.values()))
        made[f"{first} - {other}"] = {
            "scenes": len(apart),
            "psnr": float(np.mean(list(apart.values()))),
            "low": low,
            "high": high,
            "scenes_within": len(within),
            "psnr_within": float(np.mean(within)) if within else math.nan,
        }
    return made


def _differences(result: SetResult) -> list[str]:
    return [
        f"- PSNR, {name}: {each['psnr']:+.2f} dB [{each['low']:+.2f}, {each['high']:+.2f}] over {each['scenes']:.0f} "
        f"scenes; {each['psnr_within']:+.2f} dB over the {each['scenes_within']:.0f} within the other's limits"
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
                    "outside": sorted(tally.outside),
                }
                for name, tally in result.tallies.items()
            },
            "differences": differences(result),
            "missing": result.missing,
        }
        for result in results
    }


def open_networks(weights: str) -> LiveNetworks:
    """Of a live weight file, in the precision that a node takes here; "init": fresh ones, seed 0. Raises DataError."""
    if weights == "init":
        torch.manual_seed(0)
        return LiveNetworks(LiveConfig()).eval()
    return live_model(weights, device="cpu").networks


def methods_of(names: Sequence[str], weights: str, training: Path) -> list[Method]:
    """By name. Raises DataError for a name that is none."""
    others: list[Method] = [
        ExactSplat(training=training),
        PointSplat(training=training),
        BestHomography(),
    ]
    known: dict[str, Method] = {method.name: method for method in others}
    if any(name.startswith("live") for name in names):
        known |= live_methods(open_networks(weights))
    if unknown := [name for name in names if name not in known]:
        raise DataError(f"no method is called {unknown[0]!r}; there are {', '.join(known)}")
    return [known[name] for name in names]


def main(arguments: Sequence[str] | None = None) -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description="Measure the live view beside splats and homographies.")
    parser.add_argument("--heldout", type=Path, required=True, help="folder of the sets")
    parser.add_argument("--training", type=Path, required=True, help="clips that fill holes as they are on average")
    parser.add_argument("--judge", type=Path, help="weights of the judge network; else only the random one judges")
    parser.add_argument("--weights", default="init", help="safetensors of the live networks, or init")
    parser.add_argument("--sets", required=True, help="names of sets, with commas")
    parser.add_argument("--methods", default="splat,live", help="names of methods, with commas")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--keep", type=Path, help="keep what other methods show there, for the next run; not what is live"
    )
    parser.add_argument("--clips", type=int, help="at most so many a set, evenly chosen")
    options = parser.parse_args(arguments)
    try:
        _measured(options)
    except (TrainError, ModelError) as error:
        raise SystemExit(f"error: {error}") from error


def _measured(options: argparse.Namespace) -> None:
    methods = methods_of(options.methods.split(","), options.weights, options.training)
    judges = {"random": random_judge()} | ({} if options.judge is None else {"judge": load_judge(options.judge)})
    options.out.mkdir(parents=True, exist_ok=True)
    results: list[SetResult] = []
    for name in options.sets.split(","):
        paths = clip_paths(options.heldout / name)
        paths = paths if options.clips is None else evenly(paths, options.clips)
        splat, *run = [
            _kept(method, options.keep, name) for method in (ExactSplat(training=options.training), *methods)
        ]
        results.append(measure_set(name, paths, run, splat, judges, options.out / f"{name}.png"))
        (options.out / "report.md").write_text(to_markdown(results))
        (options.out / "report.json").write_text(json.dumps(to_json(results), indent=1))


def _kept(method: Method, folder: Path | None, set_name: str) -> Method:
    """What does not change with the live model's weights is worked out once."""
    if folder is None or method.name.startswith("live"):
        return method
    return Kept(method=method, folder=folder / set_name)


if __name__ == "__main__":
    main()
