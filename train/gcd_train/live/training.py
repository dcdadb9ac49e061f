"""The live model's training, stage by stage and resumable: depth, inputs, paint, detail, calibration, export.

clips -> depth network -> what it shows of every target (inputs) -> paint network -> detail -> weights
"""

import hashlib
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import torch

from gcd_model.live.depth_net import DepthNet
from gcd_model.live.synthesizer import save_live
from gcd_model.live.view import LiveNetworks
from gcd_train.errors import DataError
from gcd_train.live.batches import training_paths
from gcd_train.live.calibration import calibrate
from gcd_train.live.clips import clip_paths, read_clip
from gcd_train.live.depth_training import DepthTask
from gcd_train.live.detail_training import DetailTask
from gcd_train.live.inputs import make_inputs
from gcd_train.live.paint_training import HeldOutViews, PaintTask, ViewBatches
from gcd_train.live.recipe import LiveRecipe, LiveStage
from gcd_train.loop import Loop, LoopOptions, Task
from gcd_train.map_items import map_items
from gcd_train.recipe.values import LiveStageName
from gcd_train.run_folder import RunFolder
from gcd_train.stop import StopSignal

_log = logging.getLogger(__name__)
_VALID_SHARE = 8
"""Every so many-th held-out clip is measured while training."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LivePlaces:
    """Where a training reads and writes. data, valid: folders of `gcd-train generate live`; out: the run's folder."""

    data: Path
    valid: Path
    out: Path


def train_live(recipe: LiveRecipe, places: LivePlaces, stop: StopSignal) -> Path:
    """All stages, or what is left of them; returns the weight file.

    Raises:
        DataError: no clips, clips of another shape than the recipe's, or held-out clips among the training's.
        Interrupted: `stop` was set; the state is saved.
    """
    _require_apart(places)
    _require_shape(recipe, places)
    folder, paths, held_out = RunFolder(places.out), training_paths(places.data), clip_paths(places.valid)
    torch.manual_seed(recipe.seed)
    networks = LiveNetworks(recipe.model).to(_device(recipe.device), memory_format=torch.channels_last)  # pyright: ignore
    measured = held_out[:: max(len(held_out) // _VALID_SHARE, 1)]
    run = partial(_stage, recipe, folder, stop)
    depth = DepthTask(networks.depth, recipe.model, paths, measured, recipe.depth.batch, recipe.seed, recipe.workers)
    run("depth", recipe.depth, depth)
    inputs = places.out / "inputs"
    exact = _make_all_inputs(inputs / "exact", paths[:: recipe.exact_every], None, recipe, stop)
    learned = _make_all_inputs(inputs / "learned", paths, networks.depth, recipe, stop)
    shown = _make_all_inputs(inputs / "held-out", measured, networks.depth, recipe, stop)
    batches = ViewBatches(paths, [exact, learned], recipe.model, recipe.paint.batch, recipe.seed)
    views = HeldOutViews(measured, shown, recipe.model)
    paint = PaintTask(networks.paint, recipe.model, batches, paths, views, recipe.workers)
    run("paint", recipe.paint, paint)
    batches = ViewBatches(paths, [learned], recipe.model, recipe.detail.batch, recipe.seed + 1, carried=0.6)
    run(
        "detail",
        recipe.detail,
        DetailTask(networks.paint, networks.depth, recipe.model, batches, views, recipe.workers),
    )
    calibrate(networks.cpu(), held_out, views, depth.class_weights, paint.class_weights)
    path = places.out / f"{recipe.name}.safetensors"
    save_live(path, networks, recipe.name, overwrite=True)
    _log.info("wrote %s", path)
    return path


def _device(name: str) -> torch.device:
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def _require_apart(places: LivePlaces) -> None:
    """Raises DataError if a scene is in both folders."""
    trained = {_scene(path) for path in training_paths(places.data)}
    both = sorted(trained & {_scene(path) for path in clip_paths(places.valid)})
    if both:
        raise DataError(
            f"{len(both)} held-out scenes are among the training's, first: {both[0]}; give --valid scenes of their own"
        )


def _require_shape(recipe: LiveRecipe, places: LivePlaces) -> None:
    """Raises DataError if the clips have another size or number of frames than the model."""
    wanted = (recipe.model.frames, recipe.model.height, recipe.model.width)
    for folder in (places.data, places.valid):
        path = clip_paths(folder)[0]
        found = read_clip(path, names=["target.labels"]).arrays["target.labels"].shape
        if found != wanted:
            raise DataError(f"the recipe's model takes clips of [T, H, W] {wanted}, {path} has {found}")


def _scene(path: Path) -> str:
    return f"{path.parent.name}/{path.stem.split('-')[0]}"


def _stage(
    recipe: LiveRecipe, folder: RunFolder, stop: StopSignal, name: LiveStageName, stage: LiveStage, task: Task
) -> None:
    """Train a stage to the end of its budget; its module then has the averaged weights."""
    told = msgspec.json.encode([recipe.model.depth, recipe.model.paint, recipe.seed, name])
    options = LoopOptions(
        stage=name,
        identity=hashlib.sha256(told).hexdigest()[:12],
        budget=stage.budget,
        optimiser=stage.optimiser,
        ema=stage.ema,
        log=recipe.log,
        stop=stop,
        frames_per_clip=recipe.model.frames,
    )
    loop = Loop(task, folder, options)
    loop.run()
    loop.adopt_average()
    task.module.eval().requires_grad_(False)


def _make_all_inputs(
    out: Path, paths: Sequence[Path], net: DepthNet | None, recipe: LiveRecipe, stop: StopSignal
) -> Path:
    """Inputs of every clip, in processes where the recipe has workers; gives their folder, one a depth network."""
    out = out / _digest(net, recipe)
    missing = [path for path in paths if not (out / path.parent.name / path.name).exists()]
    if not missing:
        return out
    _log.info("working out what is seen of %d clips (%s)", len(missing), out.name)
    state = None if net is None else {name: value.cpu().clone() for name, value in net.state_dict().items()}
    work = partial(_inputs_of, out, state, recipe)
    for outcome in map_items(work, list(_shares(missing)), workers=max(recipe.workers, 1)):
        outcome.unwrap()
        if stop.is_set():
            break
    return out


def _digest(net: DepthNet | None, recipe: LiveRecipe) -> str:
    """Of all that decides what is seen of a clip."""
    told = hashlib.sha256(msgspec.json.encode([recipe.model.memory, recipe.model.memory_frames, recipe.seed]))
    for name, value in {} if net is None else net.state_dict().items():
        told.update(name.encode() + value.cpu().numpy().tobytes())
    return told.hexdigest()[:12]


def _shares(paths: Sequence[Path], size: int = 16) -> Iterator[list[Path]]:
    for first in range(0, len(paths), size):
        yield list(paths[first : first + size])


def _inputs_of(out: Path, state: dict[str, Any] | None, recipe: LiveRecipe, paths: list[Path]) -> None:
    net: DepthNet | None = None
    if state is not None:
        net = DepthNet(recipe.model.depth, len(recipe.model.classes))
        net.load_state_dict(state)
        net.eval()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        make_inputs(out, paths, net, recipe.model, recipe.seed)
    finally:
        torch.set_num_threads(threads)
