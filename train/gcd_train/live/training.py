"""The live model's training, stage by stage and resumable: depth, inputs, paint, detail, calibration, export.

clips -> depth network -> what it shows of every target (inputs) -> paint network -> detail -> weights
"""

import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

import msgspec
import torch

from gcd_model.live.blocks import layout
from gcd_model.live.depth_net import DepthNet
from gcd_model.live.synthesizer import LiveSynthesizer, save_live
from gcd_model.loading import load_synthesizer
from gcd_model.networks import LiveNetworks
from gcd_train.errors import DataError
from gcd_train.live.batches import PART_SEED
from gcd_train.live.calibration import calibrate
from gcd_train.live.clips import clip_paths, read_clip
from gcd_train.live.depth_training import DepthTask
from gcd_train.live.paint_training import DetailTask, HeldOutViews, PaintTask
from gcd_train.live.recipe import LiveRecipe, LiveStage
from gcd_train.live.store import TrainingClips, training_paths
from gcd_train.live.views import InputShelf, ViewBatches, make_inputs
from gcd_train.parallel import map_items
from gcd_train.recipe_data import ComputeRecipe, LiveStageName
from gcd_train.training.distributed import ALONE, Engine, Processes
from gcd_train.training.loop import Loop, LoopOptions, Task
from gcd_train.training.monitor import RunFolder

_log = logging.getLogger(__name__)
_MEASURED = 8
"""About so many held-out clips are measured while training."""
_CARRIED = {"paint": 0.35, "detail": 0.6}
"""Share of the views that see what was painted a frame before, of a model that carries that."""
_SHARE = 4
"""Clips whose inputs a process works out at a time."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LivePlaces:
    """Where a training reads and writes. data, valid: folders of `gcd-train generate live`; out: the run's folder."""

    data: Path
    valid: Path
    out: Path


def train_live(recipe: LiveRecipe, places: LivePlaces, stop: Event, processes: Processes = ALONE) -> Path:
    """All stages, or what is left of them; returns the weight file.

    Several processes share the updates of depth and paint; the first one does the rest.

    Raises:
        DataError: no clips, clips of another shape than the recipe's, or held-out clips among the training's.
        RecipeError: an update's parts cannot be shared. Interrupted: `stop` was set; the state is saved.
    """
    _require_apart(places)
    _require_shape(recipe, places)
    folder, device, held_out = RunFolder(places.out), _device(recipe.device), clip_paths(places.valid)
    torch.manual_seed(recipe.seed)
    networks = _networks(recipe).to(device, memory_format=layout(device))  # pyright: ignore
    clips, measured = TrainingClips(places.data, device), held_out[:: max(len(held_out) // _MEASURED, 1)]
    model, seed = recipe.model, recipe.seed
    alone = partial(processes.by_the_first, stop=stop)

    def run(name: LiveStageName, stage: LiveStage, task: Task, processes: Processes) -> None:
        """Train a stage, whose weights are then in a file of their own; one to be kept is kept."""
        if name in recipe.keep:
            task.module.eval().requires_grad_(False)
            return
        _stage(recipe, folder, stop, name, stage, task, processes)
        so_far = places.out / f"{recipe.name}-{name}.safetensors"
        alone(lambda: save_live(so_far, networks, recipe.name, overwrite=True))

    depth = DepthTask(networks.depth, model, clips, measured, recipe.depth, seed)
    run("depth", recipe.depth, depth, processes)
    exact, learned, shown = (
        places.out / "inputs" / name / _digest(net, recipe)
        for name, net in (("exact", None), ("learned", networks.depth), ("held-out", networks.depth))
    )
    make = partial(_make_all_inputs, recipe=recipe, stop=stop, workers=max(recipe.workers, processes.count))
    alone(lambda: make(exact, clips.paths[:: recipe.exact_every], None))
    alone(lambda: make(learned, clips.paths[:: recipe.learned_every], networks.depth))
    alone(lambda: make(shown, measured, networks.depth))
    carried = _CARRIED if model.carry_painted else {"paint": 0.0, "detail": 0.0}
    inputs = InputShelf(clips, [exact, learned])
    batches = [
        ViewBatches(clips, inputs, model, recipe.paint.batch, seed + part * PART_SEED, carried["paint"])
        for part in range(recipe.paint.parts)
    ]
    views = HeldOutViews(measured, shown)
    paint = PaintTask(networks.paint, model, batches, clips.paths, views, recipe.paint.small_share)
    run("paint", recipe.paint, paint, processes)
    path = places.out / f"{recipe.name}.safetensors"

    def finish() -> None:
        seen = ViewBatches(clips, inputs, model, recipe.detail.batch, seed + 1, carried["detail"])
        run("detail", recipe.detail, DetailTask(networks.paint, networks.depth, model, seen, views), ALONE)
        calibrate(networks.cpu(), clips.paths, held_out, views, depth.class_weights, paint.class_weights)
        save_live(path, networks, recipe.name, overwrite=True)
        _log.info("wrote %s", path)

    alone(finish)
    return path


def _networks(recipe: LiveRecipe) -> LiveNetworks:
    """At random, or as a weight file has them. Raises DataError if that is another model."""
    networks = LiveNetworks(recipe.model)
    if recipe.weights is not None:
        begun = load_synthesizer(recipe.weights, device="cpu", dtype="float32")
        if not isinstance(begun, LiveSynthesizer):
            raise DataError(f"a live model's training begins from a live model, {recipe.weights} is another")
        found, wanted = ((c.depth, c.paint, c.classes) for c in (begun.networks.config, recipe.model))
        if found != wanted:
            raise DataError(f"{recipe.weights} has other networks or classes than the recipe: {found}, wanted {wanted}")
        networks.load_state_dict(begun.networks.state_dict())
    return networks


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
    recipe: LiveRecipe,
    folder: RunFolder,
    stop: Event,
    name: LiveStageName,
    stage: LiveStage,
    task: Task,
    processes: Processes,
) -> None:
    """Train a stage to the end of its budget; its module then has the averaged weights."""
    told = msgspec.json.encode([recipe.model.depth, recipe.model.paint, recipe.seed, name])
    options = LoopOptions(
        stage=name,
        identity=hashlib.sha256(told).hexdigest()[:12],
        table=stage,
        log=recipe.log,
        stop=stop,
        frames_per_clip=recipe.model.frames,
        parts=stage.parts,
        engine=Engine(processes=processes, compute=ComputeRecipe(parallel="ddp")),
    )
    loop = Loop(task, folder, options)
    loop.run()
    loop.adopt_average()
    task.module.eval().requires_grad_(False)


def _make_all_inputs(
    out: Path, paths: Sequence[Path], net: DepthNet | None, recipe: LiveRecipe, stop: Event, workers: int
) -> None:
    """Inputs of every clip that has none yet."""
    missing = [path for path in paths if not (out / path.parent.name / path.name).exists()]
    if not missing:
        return
    _log.info("working out what is seen of %d clips (%s)", len(missing), out.parent.name)
    state = None if net is None else {name: value.cpu().clone() for name, value in net.state_dict().items()}
    shares = [missing[first : first + _SHARE] for first in range(0, len(missing), _SHARE)]
    for outcome in map_items(partial(_inputs_of, out, state, recipe), shares, workers=workers):
        outcome.unwrap()
        if stop.is_set():
            break


def _digest(net: DepthNet | None, recipe: LiveRecipe) -> str:
    """Of all that decides what is seen of a clip."""
    told = hashlib.sha256(msgspec.json.encode([recipe.model.memory, recipe.model.memory_frames, recipe.seed]))
    for name, value in {} if net is None else net.state_dict().items():
        told.update(name.encode() + value.cpu().numpy().tobytes())
    return told.hexdigest()[:12]


def _inputs_of(out: Path, state: dict[str, Any] | None, recipe: LiveRecipe, paths: list[Path]) -> None:
    net: DepthNet | None = None
    if state is not None:
        net = DepthNet(recipe.model.depth, len(recipe.model.classes)).to(_device(recipe.device))
        net.load_state_dict(state)
        net.eval()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        make_inputs(out, paths, net, recipe.model, recipe.seed)
    finally:
        torch.set_num_threads(threads)
