"""Does a live model know that a camera shows another world? Its score on held-out clips beside that on real videos.

python tools/other_world.py --heldout DIR --videos DIR [FILE ...] --weights FILE --out OUT
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.geometry import Intrinsics
from gcd_model.live.eyes import Eyes
from gcd_model.live.synthesizer import LiveSynthesizer
from gcd_train.data.sample import to_network
from gcd_train.live.clips import clip_paths, evenly, read_clip
from gcd_train.live.training import live_model
from gcd_train.look.gallery import GalleryOptions, find_videos, read_windows

_ASSUMED_HFOV_DEG = 70.0
"""Of a video whose lens nobody knows."""


def score(synthesizer: LiveSynthesizer, video: Tensor, lens: Intrinsics) -> float:
    """Mean `FrameGeometry.ood` of a window [T, 3, H, W] in [-1, 1], motion by its pictures, no mount declared."""
    eyes = Eyes(synthesizer.networks)
    return float(np.mean([eyes.see(frame, lens=lens).geometry.ood for frame in video]))


def auc(known: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """How often a score of another world is above one of the known world; ties count half."""
    wins = np.subtract.outer(other, known)
    return float(((wins > 0) + 0.5 * (wins == 0)).mean())


def known_scores(synthesizer: LiveSynthesizer, folder: Path, clips: int) -> Iterator[tuple[str, float]]:
    """Of at most so many clips, evenly chosen, each world."""
    for world in sorted(path for path in folder.iterdir() if path.is_dir()):
        paths = sorted(world.glob("*.safetensors"))
        for path in evenly(paths, clips):
            clip = read_clip(path, names=["source.rgb"])
            yield clip.name, score(synthesizer, to_network(clip.arrays["source.rgb"]), clip.lens("source"))


def other_scores(synthesizer: LiveSynthesizer, paths: Sequence[Path], windows: int) -> Iterator[tuple[str, float]]:
    """Of at most so many windows a video, evenly chosen."""
    traits = synthesizer.traits
    lens = Intrinsics.from_hfov(_ASSUMED_HFOV_DEG, traits.config.width, traits.config.height)
    for video in find_videos(paths):
        for window in read_windows(video, traits, GalleryOptions(windows=windows)):
            yield f"{window.name} at {window.start_s:.1f} s", score(synthesizer, to_network(window.pictures), lens)


def main(arguments: Sequence[str] | None = None) -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description="How well a live model tells other worlds from its own.")
    parser.add_argument("--heldout", type=Path, required=True, help="clips of the known worlds that it never learned")
    parser.add_argument("--videos", type=Path, nargs="+", required=True, help="videos of other worlds, or folders")
    parser.add_argument("--weights", default="package:live-small", help="a live model's")
    parser.add_argument("--clips", type=int, default=10, help="of each known world")
    parser.add_argument("--windows", type=int, default=6, help="of each video")
    parser.add_argument("--out", type=Path, required=True, help="JSON file")
    options = parser.parse_args(arguments)
    clip_paths(options.heldout)
    model = live_model(options.weights)
    known = dict(known_scores(model, options.heldout, options.clips))
    other = dict(other_scores(model, options.videos, options.windows))
    of_known, of_other = np.array(list(known.values())), np.array(list(other.values()))
    threshold = model.networks.config.ood_threshold
    figures = {
        "auc": auc(of_known, of_other),
        "threshold": threshold,
        "known_above": float((of_known > threshold).mean()),
        "other_above": float((of_other > threshold).mean()),
    }
    options.out.write_text(json.dumps({**figures, "known": known, "other": other}, indent=1))
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
