"""Views of real videos, for which there is no ground truth: sheets, videos and a page."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gcd_model import (
    CameraMount,
    Clip,
    RenderOptions,
    Spherical,
    SphericalDelta,
    Traits,
    Trajectory,
    View,
    ViewSynthesizer,
)
from gcd_model.errors import OptionError
from gcd_model.geometry import Intrinsics
from gcd_train.data.sample import to_network
from gcd_train.evaluation.galleries import Strip, painted, to_bytes, write_sheet, write_video
from gcd_train.files import write_whole
from gcd_train.look.real_video import Bytes, Windowed

_ANGLES = (SphericalDelta(azimuth_deg=30.0, elevation_deg=10.0), SphericalDelta(azimuth_deg=-30.0))
"""Where steered models look from unless somebody says: to the right and from above, and to the left."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ViewRecipe:
    """How windows are viewed.

    angles: goals of steered models, target minus source; empty for the one view of others. samples: draws of each;
    all are shown, and from two on where they differ. steps: None as shipped. seed: of the noise.
    source: where the camera of steered models stands, as far as its goals depend on it; None as is usual for them.
    height_m, tilt_deg: of the camera on its vehicle, above the ground and down; None as trained.
    """

    angles: tuple[SphericalDelta, ...] = ()
    samples: int = 1
    steps: int | None = None
    seed: int = 0
    source: Spherical | None = None
    height_m: float | None = None
    tilt_deg: float | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class Viewed:
    """A window and what was made of it.

    strips: rows of the sheet. notes: what a viewer should know, in words.
    """

    window: Windowed
    strips: tuple[Strip, ...]
    notes: tuple[str, ...]


def paths(traits: Traits, recipe: ViewRecipe, hfov_deg: float | None = None) -> tuple[tuple[str, Trajectory], ...]:
    """Name and camera path of each goal, or of a model's one view.

    hfov_deg: of the pictures, if known. Raises: ViewFixedError, ViewRangeError as `Traits.plan_view`, OptionError also
    for a source that the model has no use for, or that its mount tells already.
    """
    mount = mounted(traits, recipe, hfov_deg)
    if recipe.source is not None and (mount is not None or traits.config.camera == "none"):
        raise OptionError(f"{traits.name} has no use for --source-elevation-deg and --source-radius; leave them out")
    if traits.config.camera == "none" and not recipe.angles:
        return (("view", traits.plan_view(mount=mount)),)
    angles = recipe.angles or _ANGLES
    return tuple(
        (
            f"az {each.azimuth_deg:+g} el {each.elevation_deg:+g} r {each.radius_m:+g}",
            traits.plan_view(each, source=recipe.source, mount=mount),
        )
        for each in angles
    )


def mounted(traits: Traits, recipe: ViewRecipe, hfov_deg: float | None) -> CameraMount | None:
    """How the camera sits on its vehicle, for the live model where somebody says it; else None."""
    if not traits.live or (recipe.height_m is None and recipe.tilt_deg is None):
        return None
    given = {"height_m": recipe.height_m, "tilt_deg": recipe.tilt_deg, "hfov_deg": hfov_deg}
    return replace(CameraMount(), **{name: number for name, number in given.items() if number is not None})


def view_window(synthesizer: ViewSynthesizer, window: Windowed, recipe: ViewRecipe) -> Viewed:
    """Encode a window once and render every goal. Raises: ModelError and its kind."""
    traits = synthesizer.traits
    mount = mounted(traits, recipe, window.hfov_deg)
    lens, (high, wide) = None, window.pictures.shape[1:3]
    if traits.live and window.hfov_deg is not None:
        lens = Intrinsics.from_hfov(window.hfov_deg, wide, high)
    features = synthesizer.encode(Clip(video=to_network(window.pictures), fps=window.fps, mount=mount, lens=lens))
    options = RenderOptions(samples=recipe.samples, steps=recipe.steps, seed=recipe.seed)
    strips = [Strip.of("input", window.pictures)]
    for name, path in paths(traits, recipe, window.hfov_deg):
        (view,) = synthesizer.render(features, [path], options)
        strips += _view_strips(traits, name, view)
    width, height = window.size
    rate = "" if window.trained_rate else f", a rate {traits.name} was not trained with"
    notes = (
        f"from {window.start_s:.1f} s, {len(window.pictures)} frames at {window.fps:g} a second{rate}",
        f"cut from {width} x {height} to {wide} x {high}",
    )
    return Viewed(window=window, strips=tuple(strips), notes=notes)


def write_viewed(viewed: Viewed, folder: Path) -> None:
    """`NAME.png`, the sheet, and `NAME.mp4`, all rows side by side. Raises RunError if they cannot be written."""
    window = viewed.window
    write_sheet([(f"{window.video} from {window.start_s:.1f} s", viewed.strips)], folder / f"{window.name}.png")
    write_video(viewed.strips, window.fps, folder / f"{window.name}.mp4")


def _view_strips(traits: Traits, name: str, view: View) -> list[Strip]:
    strips = [
        Strip.of(name if number == 0 else f"{name} sample {number + 1}", to_bytes(sample))
        for number, sample in enumerate(view.samples)
    ]
    deviation, word = (view.uncertainty, "uncertainty") if view.uncertainty is not None else (view.std, "deviation")
    if deviation is not None:
        strips.append(Strip.of(f"{word}, white {float(deviation.max()):.2g}", _heat(deviation.numpy())))
    if view.classes is not None:
        strips.append(Strip.of("classes", painted(view.classes[0], traits.classes)))
    return strips


def _heat(values: NDArray[np.float32]) -> Bytes:
    """Numbers [T, H, W] as pictures [T, H, W, 3]: black is 0, the brightest is their largest."""
    grey = np.rint(values / max(float(values.max()), 1e-6) * 255).clip(0, 255).astype(np.uint8)
    return np.stack([np.asarray(cv2.applyColorMap(each, cv2.COLORMAP_INFERNO)[..., ::-1], np.uint8) for each in grey])


_STYLE = (
    "body{font:15px/1.45 sans-serif;margin:2em auto;max-width:1080px;padding:0 1em;color:#222}"
    "img{max-width:100%;border:1px solid #ddd}h2{margin-top:2em}.note{color:#666}.fault{color:#a02020}"
)


def write_page(viewed: Sequence[Viewed], faults: Sequence[str], facts: Sequence[tuple[str, str]], out: Path) -> None:
    """Write the page.

    Args:
        viewed: windows in order, whose files lie beside the page. faults: what could not be shown, a line each. facts:
            name and value of what holds for all: the command, the weights, the options.
    Raises:
        RunError: it cannot be written.
    """
    rows = "".join(f"<tr><th align=left>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in facts)
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><title>Views of real videos</title>",
        f"<style>{_STYLE}</style><h1>Views of real videos</h1>",
        "<p>Every pixel of a view is generated. Nobody knows what was really there: a view that looks right is no "
        f"evidence that it is.</p><table>{rows}</table>",
        *(f"<p class=fault>{escape(fault)}</p>" for fault in faults),
        *map(_section, viewed),
    ]
    write_whole(out, ("\n".join(parts) + "</html>\n").encode())


def _section(viewed: Viewed) -> str:
    name = escape(viewed.window.name, quote=True)
    notes = escape("; ".join(viewed.notes))
    return (
        f"<h2>{escape(viewed.window.video)}, window {viewed.window.number + 1}</h2><p class=note>{notes}; "
        f'<a href="{name}.mp4">video</a></p><a href="{name}.png"><img src="{name}.png" alt="{name}"></a>'
    )
