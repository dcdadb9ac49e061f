"""`gcd-node calibrate-view`: where the camera of a reference picture stood, in the axes of the camera there is now."""

import logging
import math
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from typing import Annotated

import msgspec
import tomli_w
import torch
from rich.console import Console
from typer import Argument, Option

from gcd_model import (
    Alignment,
    AlignmentError,
    FileError,
    FrameSynthesizer,
    Intrinsics,
    Landmarks,
    align,
    decode_toml,
    landmarks_of,
    read_small,
)
from gcd_node.canonical import Reference
from gcd_node.cli.main import table
from gcd_node.cli.run import Changes
from gcd_node.config import NodeConfig, parse_config
from gcd_node.encoded_frames import EncodedFrames
from gcd_node.errors import ConfigError, SourceError, UsageError
from gcd_node.frame import Frame, Image
from gcd_node.image_io import write_whole
from gcd_node.preprocess import Fit, Rectifier
from gcd_node.session import load_model
from gcd_node.sources import LIVE_KINDS, open_source
from gcd_node.stream_context import StreamContext, prepare_stream
from gcd_node.view_config import CalibratedView
from gcd_node.window import PartialWindow, PlacedFrame

_LOG = logging.getLogger(__name__)
_VIEW, _NO_SIZE = "reference", (64, 64)  # which is not drawn
_APART_NS = 200_000_000  # between two frames
_PATIENCE_S = 60.0
_LENSES, _CLEARLY = (0.8, 0.87, 0.93, 1.07, 1.15, 1.25), 1.03  # focal lengths tried instead; times as many corners
_FINEST, _FINER = 4, 2.0  # times the model's size, and times as fine as the reference


def calibrate_view(
    reference: Annotated[
        Path, Argument(help="A picture of the training camera, as the policy was given it; or a folder of them.")
    ],
    source: Annotated[Path, Option(metavar="CONFIG", help=r"A launch file, for its \[source] and \[model].")],
    hfov_deg: Annotated[
        float | None, Option(min=1, max=179, help="Horizontal field of view of the reference, degrees.")
    ] = None,
    calibration: Annotated[Path | None, Option(help="Instead: its ROS camera_info YAML file.")] = None,
    out: Annotated[Path, Option(help=r"File for the pose: \[view.NAME] pose = its path.")] = Path("canonical.toml"),
    frames: Annotated[int, Option(min=1, help="Frames of the source to look at, 0.2 s apart.")] = 5,
    changes: Changes = None,
) -> None:
    """Find where the camera of a reference picture stood, for a canonical view.

    Both cameras must see the same things from places that are not too far apart, some 15 cm and 15 degrees at a table.
    Ends with 65 if they do not, 66 without a source, 78 with a wrong setting or no such reference.
    """
    config = _config(source, reference, hfov_deg, calibration, changes or ())
    with Console(stderr=True, markup=False).status("looking"):
        known, camera = _landmarks(config, frames)
        found = align(known, camera.features)
    move = found.moved_from(torch.eye(4, dtype=torch.float64))
    view = CalibratedView(
        pose=tuple(found.pose.flatten().tolist()), inliers=len(found.inliers), matches=found.matches, **asdict(move)
    )
    write_whole(out, lambda file: file.write(view.to_toml().encode()))
    rows = [
        ("from the source camera", move.pixels, move.degrees, move.centimetres),
        ("standard error", move.doubt_pixels, move.doubt_degrees, move.doubt_centimetres),
    ]
    shown = ((name, *(f"{number:.2f}" for number in numbers)) for name, *numbers in rows)
    console = Console(markup=False)
    console.print(table(shown, ("the reference's camera", ">pixels", ">degrees", ">cm")))
    console.print(f"{view.inliers} of {view.matches} common corners agree; wrote {out}", soft_wrap=True)
    doubt_lens(known, camera, found)


def doubt_lens(known: list[Landmarks], camera: Reference, found: Alignment) -> None:
    """Warn where clearly more corners agree with a pose if the reference's lens were another: a wrong one of either
    camera makes a wrong pose, whose standard error does not tell."""
    agree = {1.0: len(found.inliers) / found.matches}
    for factor in _LENSES:
        lens = replace(camera.lens, fx=factor * camera.lens.fx, fy=factor * camera.lens.fy)
        with suppress(AlignmentError):
            other = align(known, [replace(each, lens=lens) for each in camera.features])
            agree[factor] = len(other.inliers) / other.matches
    best = max(agree, key=lambda factor: agree[factor])
    if agree[best] > _CLEARLY * agree[1.0]:
        wide, wider = (math.degrees(2 * math.atan(camera.lens.width / 2 / f / camera.lens.fx)) for f in (1.0, best))
        _LOG.warning(
            f"a reference of about {wider:.0f} degrees instead of {wide:.0f} would agree with {agree[best]:.0%} of the "
            f"corners instead of {agree[1.0]:.0%}: are both lenses stated right? A wrong lens is a wrong pose"
        )


def _config(
    path: Path, reference: Path, hfov_deg: float | None, calibration: Path | None, changes: list[str] | tuple[str, ...]
) -> NodeConfig:
    """Of a launch file, with the one canonical view that is looked for instead of its own."""
    if (hfov_deg is None) == (calibration is None):
        raise UsageError("state the lens of the reference: --hfov-deg or --calibration")
    view: dict[str, object] = {"kind": "canonical", "reference": str(reference), "size": _NO_SIZE}
    view |= {"hfov_deg": hfov_deg} if calibration is None else {"calibration": str(calibration)}
    try:
        content = decode_toml(read_small(path))
    except FileError as error:
        raise ConfigError(f"the launch file {path} {error}; give the path of a TOML file") from error
    found = {_VIEW: view | {"pose": [0, 0, 0, 0, 0, 0, 1]}}  # in lockstep a view needs one
    return parse_config(tomli_w.dumps({**content, "view": found}), str(path), changes)


def _landmarks(config: NodeConfig, count: int) -> tuple[list[Landmarks], Reference]:
    """Of so many frames of the source."""
    model = load_model(config.model)
    if not isinstance(model, FrameSynthesizer):
        raise ConfigError("[model] weights: a canonical view takes the live model; take package:live-small")
    model = model.streaming()
    is_live = config.source.kind in LIVE_KINDS
    source = open_source(config.source if is_live else msgspec.structs.replace(config.source, pace="lockstep"))
    patience = threading.Timer(_PATIENCE_S, source.close)
    patience.start()
    try:
        context = prepare_stream(config, model.traits, source.info)
        if context.lens is None and source.info.hfov_in_use(config.source.hfov_deg) is None:
            raise ConfigError("[source]: a pose takes a known lens; state hfov_deg or calibration of the source")
        reference, encoded = context.references[_VIEW], EncodedFrames(lambda: None)
        known: list[Landmarks] = []
        for frame in islice(_apart(source.frames()), count):
            depth = None if frame.depth is None else context.fit.depth(frame.depth)
            placed = PlacedFrame(context.fit.image(frame.image), frame.stamp_ns, frame.seq, 0, depth, frame.odometry)
            features = encoded.features(model, PartialWindow(frames=(placed,), fps=context.fps, epoch=0), context)
            known.append(landmarks_of(model.see(features)[0], *_fine(context, frame, reference.lens)))
    finally:
        patience.cancel()
        source.close()
    if not known:
        raise SourceError(f"{source.info.id} gave no frame in {_PATIENCE_S:.0f} s; look at the camera")
    return known, reference


def _apart(frames: Iterator[Frame]) -> Iterator[Frame]:
    last_ns: int | None = None
    for frame in frames:
        if last_ns is None or frame.stamp_ns - last_ns >= _APART_NS:
            last_ns = frame.stamp_ns
            yield frame


def _fine(context: StreamContext, frame: Frame, reference: Intrinsics) -> tuple[Image, Intrinsics]:
    """What the model is given of a frame, as fine as there is use for; and its lens."""
    fit, lens, calibration = context.fit, context.intrinsics, context.lens
    assert lens is not None, "the live model has one"
    most = min(_FINEST, max(1.0, _FINER * reference.fx / lens.fx))
    if isinstance(fit, Fit):
        most = min(most, max(1.0, fit.crop_box(*frame.size)[2] / fit.width))
    elif calibration is not None:
        most = min(most, max(1.0, calibration.resized(*frame.size).fx / lens.fx))
    lens = lens.resized(round(most * lens.width), round(most * lens.height))
    if isinstance(fit, Fit):
        return replace(fit, width=lens.width, height=lens.height, resize="area").image(frame.image), lens
    assert calibration is not None, "it was rectified by one"
    return Rectifier(calibration, lens, allow_upscale=True).image(frame.image), lens
