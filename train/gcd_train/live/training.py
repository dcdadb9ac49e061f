"""The live model's training, stage by stage and resumable: depth, inputs, paint, detail, calibration, export.

clips -> depth network -> what it shows of every target (inputs) -> paint network -> detail -> weights
"""

import logging
from collections.abc import Sequence
from copy import deepcopy
from functools import partial
from pathlib import Path
from threading import Event

import torch

from gcd_model.live.blocks import layout
from gcd_model.live.depth_net import DepthNet
from gcd_model.live.synthesizer import LiveSynthesizer, save_live
from gcd_model.loading import load_synthesizer
from gcd_model.networks import LiveNetworks, weights_digest
from gcd_train.errors import DataError
from gcd_train.live.batches import PART_SEED
from gcd_train.live.calibration import calibrate
from gcd_train.live.clips import TrainingClips, clip_paths, read_clip, training_paths
from gcd_train.live.depth_training import DepthTask
from gcd_train.live.paint_training import DetailTask, HeldOutViews, PaintTask
from gcd_train.live.views import InputShelf, ViewBatches, make_inputs
from gcd_train.parallel import map_items
from gcd_train.recipe import LiveRecipe, LiveStage
from gcd_train.recipe_data import ComputeRecipe, LiveStageName
from gcd_train.training.distributed import ALONE, Engine, Processes
from gcd_train.training.loop import Loop, LoopOptions, Task
from gcd_train.training.monitor import RunFolder
from gcd_train.training.setup import Precision, digest_of

_log = logging.getLogger(__name__)
_MEASURED = 8
"""About so many held-out clips are measured while training."""
_CARRIED = {"paint": 0.35, "detail": 0.6}
"""Share of the views that see what was painted a frame before, of a model that carries that."""
_CLIPS_A_TURN = 4
"""Clips whose inputs a process works out at a time."""


def train_live(
    recipe: LiveRecipe, data: Path, valid: Path, folder: RunFolder, stop: Event, processes: Processes = ALONE
) -> Path:
    """All stages, or what is left of them; returns the weight file.

    Several processes share the updates of depth and paint; the first one does the rest. data, valid: folders of
    `gcd-train generate live`.

    Raises:
        DataError: no clips, clips of another shape than the recipe's, or held-out clips among the training's.
        Interrupted: `stop` was set; the state is saved.
    """
    held_out = clip_paths(valid)
    _require_fit(recipe, training_paths(data), held_out)
    device = Precision.of(ComputeRecipe(device=recipe.device)).device
    torch.manual_seed(recipe.seed)
    networks = _networks(recipe).to(device, memory_format=layout(device))  # pyright: ignore
    clips, measured = TrainingClips(data, device), held_out[:: max(len(held_out) // _MEASURED, 1)]
    model, seed, out = recipe.model, recipe.seed, folder.path
    alone = partial(processes.by_the_first, stop=stop)

    def run(name: LiveStageName, task: Task, processes: Processes) -> None:
        """Train a stage, whose weights are then averaged and in a file of their own; one to be kept is kept."""
        if name not in recipe.keep:
            _train(recipe, name, task, folder, stop, processes)
            path = out / f"{recipe.name}-{name}.safetensors"
            alone(lambda: save_live(path, networks, recipe.name, overwrite=True))
        task.module.eval().requires_grad_(False)

    depth = DepthTask(networks.depth, model, clips, measured, recipe.depth, seed)
    run("depth", depth, processes)
    # inputs by exact depth, by learned depth, and of held-out clips; named by all that decides what is seen
    memory = digest_of(model.memory, model.memory_frames, seed)
    by_net = f"{memory}-{weights_digest(networks.depth.state_dict())}"
    exact = out / "inputs" / "exact" / memory
    learned, shown = (out / "inputs" / name / by_net for name in ("learned", "held-out"))
    make = partial(_make_all_inputs, recipe=recipe, stop=stop, workers=max(recipe.workers, processes.count))
    alone(lambda: make(exact, clips.paths[:: recipe.exact_every], None))
    alone(lambda: make(learned, clips.paths[:: recipe.learned_every], networks.depth))
    alone(lambda: make(shown, measured, networks.depth))
    carried = _CARRIED if model.carry_painted else {"paint": 0.0, "detail": 0.0}
    inputs, views = InputShelf(clips, [exact, learned]), HeldOutViews(measured, shown)
    batches = [
        ViewBatches(clips, inputs, model, recipe.paint.batch, seed + part * PART_SEED, carried["paint"])
        for part in range(recipe.paint.parts)
    ]
    paint = PaintTask(networks.paint, model, batches, clips.paths, views, recipe.paint.small_share)
    run("paint", paint, processes)
    path = out / f"{recipe.name}.safetensors"

    def finish() -> None:
        seen = ViewBatches(clips, inputs, model, recipe.detail.batch, seed + 1, carried["detail"])
        run("detail", DetailTask(networks.paint, networks.depth, model, seen, views), ALONE)
        calibrate(networks.cpu(), clips.paths, held_out, views, depth.class_weights, paint.class_weights)
        save_live(path, networks, recipe.name, overwrite=True)
        _log.info("wrote %s", path)

    alone(finish)
    return path


def _train(
    recipe: LiveRecipe, name: LiveStageName, task: Task, folder: RunFolder, stop: Event, processes: Processes
) -> None:
    """Train a stage to the end of its budget; its module then has the averaged weights."""
    stage: LiveStage = getattr(recipe, name)
    options = LoopOptions(
        stage=name,
        identity=digest_of(recipe.model.depth, recipe.model.paint, recipe.seed, name),
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


def live_model(weights: str, *, device: str = "auto", dtype: str | None = None) -> LiveSynthesizer:
    """A live model. Raises DataError for weights of another."""
    loaded = load_synthesizer(weights, device=device, dtype=dtype)
    if not isinstance(loaded, LiveSynthesizer):
        raise DataError(f"{weights} is no live model; give the weights of one")
    return loaded


def _networks(recipe: LiveRecipe) -> LiveNetworks:
    """At random, or as a weight file has them. Raises DataError if that is another model."""
    networks = LiveNetworks(recipe.model)
    if recipe.weights is not None:
        begun = live_model(recipe.weights, device="cpu", dtype="float32").networks
        found, wanted = ((c.depth, c.paint, c.classes) for c in (begun.config, recipe.model))
        if found != wanted:
            raise DataError(f"{recipe.weights} has other networks or classes than the recipe: {found}, wanted {wanted}")
        networks.load_state_dict(begun.state_dict())
    return networks


def _require_fit(recipe: LiveRecipe, learned: Sequence[Path], held_out: Sequence[Path]) -> None:
    """Raises DataError if a scene is in both, or clips have another size or number of frames than the model."""
    scenes, measured = ({f"{p.parent.name}/{p.stem.split('-')[0]}" for p in paths} for paths in (learned, held_out))
    if both := sorted(scenes & measured):
        raise DataError(
            f"{len(both)} held-out scenes are among the training's, first: {both[0]}; give --valid scenes of their own"
        )
    wanted = (recipe.model.frames, recipe.model.height, recipe.model.width)
    for path in (learned[0], held_out[0]):
        found = read_clip(path, names=["target.labels"]).arrays["target.labels"].shape
        if found != wanted:
            raise DataError(f"the recipe's model takes clips of [T, H, W] {wanted}, {path} has {found}")


def _make_all_inputs(
    out: Path, paths: Sequence[Path], net: DepthNet | None, recipe: LiveRecipe, stop: Event, workers: int
) -> None:
    """Inputs of every clip that has none yet."""
    missing = [path for path in paths if not (out / path.parent.name / path.name).exists()]
    if not missing:
        return
    _log.info("working out what is seen of %d clips (%s)", len(missing), out.parent.name)
    work = partial(_inputs_of, out, None if net is None else deepcopy(net).cpu(), recipe)
    turns = [missing[first : first + _CLIPS_A_TURN] for first in range(0, len(missing), _CLIPS_A_TURN)]
    for outcome in map_items(work, turns, workers=workers):
        outcome.unwrap()
        if stop.is_set():
            break


def _inputs_of(out: Path, net: DepthNet | None, recipe: LiveRecipe, paths: list[Path]) -> None:
    if net is not None:
        net.to(Precision.of(ComputeRecipe(device=recipe.device)).device).eval()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        make_inputs(out, paths, net, recipe.model, recipe.seed)
    finally:
        torch.set_num_threads(threads)
