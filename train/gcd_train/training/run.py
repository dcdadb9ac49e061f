"""A run: the stages of a recipe in their order, each from where it stopped."""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import msgspec
import torch

from gcd_model import ModelConfig
from gcd_model.networks import Networks
from gcd_model.weights.adapter import Adapter, base_digest
from gcd_model.weights.card import Card
from gcd_train.datasets.clip_source import ClipSource
from gcd_train.datasets.latents import EncodedClips
from gcd_train.encodings import Encodings, autoencoder_digest
from gcd_train.errors import DataError, RecipeError
from gcd_train.recipe import Recipe, UNetRecipe, VAERecipe
from gcd_train.recipe_data import StageName
from gcd_train.stop import StopSignal
from gcd_train.training.batches import EncodedBatches, PixelBatches
from gcd_train.training.distributed import ALONE, Engine, Processes
from gcd_train.training.export import ExportJob, Validation, export
from gcd_train.training.loop import Loop, LoopOptions, Task
from gcd_train.training.monitor import RunFolder
from gcd_train.training.objective import BatchMaker, BatchSource, UNetTask
from gcd_train.training.setup import (
    Precision,
    carried_leftovers,
    digest_of,
    family_of,
    fill,
    model_config,
    require_exportable,
    sampled_as_trained,
    start_networks,
)
from gcd_train.training.trainable import adapter_of, halve_frozen, let_train, merge_lora, thaw
from gcd_train.training.vae import VAETask

_log = logging.getLogger(__name__)
Table = TypeVar("Table")


@dataclass(frozen=True, kw_only=True, slots=True)
class RunInputs:
    """What a run works with. clips: to learn from. valid: held out, to measure on. stop: asked between updates.

    batches: makes the U-Net's batches where they come neither from encoded clips nor from `clips`.
    parts: see `RunData`. latents: a folder for encoded clips that several runs share; None for the run's own.
    processes: this one among those of the run.
    """

    recipe: Recipe
    clips: ClipSource
    valid: ClipSource
    folder: RunFolder
    stop: StopSignal
    batches: BatchMaker | None = None
    parts: tuple[ClipSource, ...] = ()
    latents: Path | None = None
    processes: Processes = ALONE


class Trainer:
    """The stages of one run."""

    def __init__(self, inputs: RunInputs) -> None:
        """Raises RecipeError if the recipe's model cannot be built or exported, or its device is not there."""
        self._inputs, self._recipe, self._folder = inputs, inputs.recipe, inputs.folder
        self._family = family_of(inputs.recipe.model)
        config = model_config(inputs.recipe.model)
        if self._family.output == "semantic" and inputs.valid.classes:
            config = msgspec.structs.replace(config, semantic_classes=tuple(inputs.valid.classes))
        self._config: ModelConfig = sampled_as_trained(config, inputs.recipe.unet)
        require_exportable(inputs.recipe, self._config)
        self._precision = Precision.of(inputs.recipe.compute)
        self._engine = Engine(processes=inputs.processes, compute=inputs.recipe.compute)
        for clips in (inputs.clips, inputs.valid):
            require_fit(clips, self._config, inputs.recipe.unet.fps)
        self._encodings = Encodings(
            recipe=inputs.recipe,
            config=self._config,
            family=self._family,
            precision=self._precision,
            sets=inputs.parts or (inputs.clips,),
            as_videos=bool(inputs.parts),
            folder=inputs.folder.stage("latents"),
            shared=inputs.latents,
            stop=inputs.stop,
        )

    def run(self, only: StageName | None = None) -> None:
        """Every stage that is not finished, or just one; several processes train the U-Net, one of them the rest.

        Raises:
            Interrupted: the stop signal was set; what was done is saved.
            RunError: the run folder holds something that does not fit. RecipeError: no such stage in the recipe.
        """
        if only is not None and only not in self._recipe.stages:
            raise RecipeError(f"this recipe has no stage {only!r}, only {', '.join(self._recipe.stages)}")
        steps = {
            "vae": self._train_vae,
            "latents": self._encode,
            "unet": self._train_unet,
            "export": self._export,
        }
        for stage in (only,) if only else self._recipe.stages:
            _log.info("stage %s", stage)
            if stage == "unet":
                steps[stage]()
            else:
                self._inputs.processes.by_the_first(steps[stage], self._inputs.stop)

    def _networks(self, *stages: StageName) -> Networks:
        """Networks with the weights of those stages that the recipe has."""
        networks = start_networks(self._recipe.model, self._config, self._recipe.seed)
        for stage in stages:
            if stage == "unet":
                self._fill_unet(networks)
                merge_lora(networks)
                thaw(networks)
            elif stage in self._recipe.stages:
                fill(networks, self._folder, stage, self._identity(stage, networks))
        return networks

    def _fill_unet(self, networks: Networks) -> int:
        """Put in what the U-Net stage trained, adapters beside their layers; returns its updates so far."""
        identity = self._identity("unet", networks)
        let_train(networks, self._recipe.model, self._recipe.seed)
        return fill(networks, self._folder, "unet", identity)

    def _adapter(self, card: Card) -> Adapter:
        """What the U-Net stage trained, apart from its base."""
        networks = self._networks("vae")
        base = base_digest(networks.state_dict())
        self._fill_unet(networks)
        return adapter_of(networks, self._recipe.model.lora, card, base)

    def _identity(self, stage: StageName, networks: Networks) -> str:
        """What a stage's state belongs to; `networks` hold what was trained before it."""
        config, seed = self._config, self._recipe.seed
        if stage == "vae":
            return digest_of(config.vae, seed)
        shape, model = digest_of(config.unet, config.prediction, seed), self._recipe.model
        part = "" if model.train == "all" else f"-{base_digest(networks.state_dict())}-{digest_of(model.lora)}"
        return f"{autoencoder_digest(networks)}-{shape}{part}"

    def _loop(self, task: Task, stage: StageName, recipe: VAERecipe | UNetRecipe, identity: str) -> None:
        options = LoopOptions(
            stage=stage,
            identity=identity,
            budget=recipe.budget,
            optimiser=recipe.optimiser,
            ema=recipe.ema,
            log=self._recipe.log,
            stop=self._inputs.stop,
            frames_per_clip=self._config.frames,
            parts=recipe.parts if isinstance(recipe, UNetRecipe) else 1,
            engine=self._engine if stage == "unet" else Engine(),
        )
        Loop(task, self._folder, options).run()

    def _train_vae(self) -> None:
        recipe, seed = _present(self._recipe.vae), self._recipe.seed
        networks = self._networks()
        identity = self._identity("vae", networks)
        task = VAETask(networks, self._inputs.clips, self._inputs.valid, recipe, self._precision, seed)
        self._loop(task, "vae", recipe, identity)

    def _encode(self) -> None:
        self._encodings.encode(self._networks("vae"))

    def _train_unet(self) -> None:
        recipe, networks = self._recipe.unet, self._networks("vae")
        identity = self._identity("unet", networks)
        let_train(networks, self._recipe.model, self._recipe.seed)
        if self._recipe.compute.frozen == "bfloat16":
            halve_frozen(networks)
        self._precision.placed(networks if recipe.source == "pixels" else networks.unet)  # encoders only to encode
        clips = self._encodings.opened(networks) if recipe.source == "latents" else None
        task = UNetTask(
            networks,
            self._batches(networks, clips),
            self._validation(),
            recipe,
            self._weights(clips),
            self._precision,
            self._recipe.seed,
        )
        self._loop(task, "unet", recipe, identity)

    def _export(self) -> None:
        recipe, networks = self._recipe, self._networks("vae")
        updates = self._fill_unet(networks)
        merge_lora(networks)
        thaw(networks)
        job = ExportJob(
            name=recipe.name,
            family=self._family,
            move_time=recipe.data.goal_frame(self._config.frames),
            updates=updates,
            recipe=recipe.export,
            leftovers=lambda: carried_leftovers(recipe.model),
            adapter=self._adapter if recipe.model.train == "lora" else None,
        )
        export(networks, self._folder, job, self._validation())

    def _validation(self) -> Validation:
        return Validation(self._inputs.valid, self._family, count=self._recipe.log.valid_clips)

    def _batches(self, networks: Networks, clips: EncodedClips | None) -> BatchSource:
        recipe, made = self._recipe.unet, self._inputs.batches
        if clips is None and made is not None:
            return made(networks, self._precision)
        if clips is None:
            return PixelBatches(self._inputs.clips, networks, recipe, self._precision, self._family)
        return EncodedBatches(clips, self._config, recipe, self._precision)

    def _weights(self, clips: EncodedClips | None) -> torch.Tensor | None:
        """Of latent channels."""
        if clips is None or not self._recipe.unet.loss.sensitivity:
            return None
        return torch.tensor(clips.meta.sensitivity, device=self._precision.device)


def _present(table: Table | None) -> Table:
    assert table is not None, "a stage runs only if the recipe has its table"
    return table


def require_fit(clips: ClipSource, config: ModelConfig, fps: float) -> None:
    """Raises DataError if the clips are not what the model and its recipe take them for."""
    if clips.fps != fps:
        raise DataError(f"the recipe's unet.fps is {fps:g}, the clips have {clips.fps:g}; change one of them")
    if config.camera == "spherical" and clips.camera != "spherical":
        raise DataError("the model is steered by angles and radius, and these clips have no orbits; take drop clips")
    if config.camera == "none" and clips.camera != "none":
        raise DataError("the model has one fixed view, and each of these clips has its own; take driving clips")
    classes = config.semantic_classes
    if classes and [kind.name for kind in classes] != [kind.name for kind in clips.classes]:
        raise DataError("the clips' classes are not the model's; generate them with this version")
