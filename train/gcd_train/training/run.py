"""A run: the stages of a recipe in their order, each from where it stopped."""

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path
from threading import Event

import msgspec
import torch

from gcd_model.config import ModelConfig
from gcd_model.networks import Networks
from gcd_model.weights.adapter import Adapter, base_digest
from gcd_model.weights.card import Card
from gcd_train.data.batches import CachedBatches, EncodedBatches, SampleBatches
from gcd_train.data.cache import CachedLatents, autoencoder_digest
from gcd_train.data.latents import Encodings, LatentClips
from gcd_train.data.open import RunData
from gcd_train.data.sample import Clips
from gcd_train.errors import DataError, RecipeError
from gcd_train.recipe import Recipe, StageRecipe, VAERecipe
from gcd_train.recipe_data import AnyStageName
from gcd_train.training.distributed import ALONE, Engine, Processes
from gcd_train.training.export import Validation, export
from gcd_train.training.loop import Loop, LoopOptions, Task
from gcd_train.training.monitor import RunFolder
from gcd_train.training.objective import BatchSource, UNetTask
from gcd_train.training.setup import (
    Precision,
    digest_of,
    family_of,
    fill,
    loaded_base,
    require_exportable,
    run_config,
    sampled_as_trained,
    start_networks,
)
from gcd_train.training.trainable import adapter_of, halve_frozen, let_train, merge_lora, thaw
from gcd_train.training.vae import VAETask

_log = logging.getLogger(__name__)
_DENOISER: AnyStageName = "unet"  # the stage that several processes share


class Trainer:
    """The stages of one run in their order; each goes on where it stopped."""

    def __init__(
        self,
        *,
        recipe: Recipe,
        data: RunData,
        folder: RunFolder,
        stop: Event,
        latents: Path | None = None,
        processes: Processes = ALONE,
    ) -> None:
        """stop: asked between updates. latents: a folder for encoded clips that several runs share; None for the run's
        own. processes: this one among those of the run.

        Raises RecipeError if the recipe's model cannot be built or exported, its device is not there, or a student is
        to learn in several processes.
        """
        if recipe.student is not None and processes.count > 1:
            raise RecipeError("a distillation is the work of one process; start it without torchrun")
        self._recipe, self._data, self._folder, self._stop = recipe, data, folder, stop
        self._family = family_of(recipe.model)
        self._config = self._trained_config()
        require_exportable(recipe, self._config)
        self._precision = Precision.of(recipe.compute)
        self._engine = Engine(processes=processes, compute=recipe.compute)
        self._encodings = Encodings(
            recipe=recipe,
            config=self._config,
            family=self._family,
            precision=self._precision,
            clips=data.clips,
            folder=folder.stage("latents"),
            shared=latents,
            stop=stop,
        )

    def run(self, only: AnyStageName | None = None) -> None:
        """Every stage that is not finished, or just one; several processes train the U-Net, one of them the rest.

        Raises:
            Interrupted: the stop signal was set; what was done is saved.
            RunError: the run folder holds something that does not fit. RecipeError: no such stage in the recipe.
        """
        steps = self._steps()
        if only is not None and only not in steps:
            raise RecipeError(f"this recipe has no stage {only!r}, only {', '.join(steps)}")
        for stage in (only,) if only else steps:
            _log.info("stage %s", stage)
            if stage == _DENOISER:
                steps[stage]()
            else:
                self._engine.processes.by_the_first(steps[stage], self._stop)

    def _steps(self) -> dict[AnyStageName, Callable[[], None]]:
        """The stages that the recipe has, in their order."""
        steps: dict[AnyStageName, Callable[[], None]] = {}
        if self._recipe.vae is not None:
            steps["vae"] = partial(self._train_vae, self._recipe.vae)
        if self._recipe.latents is not None:
            steps["latents"] = lambda: self._encodings.encode(self._start())
        return {**steps, _DENOISER: self._train_denoiser, "export": self._export}

    def _trained_config(self) -> ModelConfig:
        """The networks' config, by the recipe. Raises DataError for clips that do not fit it."""
        recipe, data = self._recipe, self._data
        config = run_config(recipe)
        if recipe.student is None:
            if self._family.output == "semantic" and data.valid.classes:
                config = msgspec.structs.replace(config, semantic_classes=tuple(data.valid.classes))
            config = sampled_as_trained(config, recipe.unet)
        for clips in (data.clips, data.valid):
            require_fit(clips, config, recipe.unet.fps)
        return config

    def _start(self) -> Networks:
        """The networks as the denoiser's stage begins: with the weights that the stages before it trained."""
        networks = start_networks(self._recipe.model, self._config, self._recipe.seed)
        if self._recipe.vae is not None:
            fill(networks, self._folder, "vae", self._vae_identity())
        return networks

    def _fill_denoiser(self, networks: Networks) -> int:
        """Put in what the denoiser's stage trained, adapters beside their layers; returns its updates so far."""
        identity = self._identity(networks)
        let_train(networks, self._recipe.model, self._recipe.seed)
        return fill(networks, self._folder, _DENOISER, identity)

    def _adapter(self, card: Card) -> Adapter:
        """What the denoiser's stage trained, apart from its base."""
        networks = self._start()
        base = base_digest(networks.state_dict())
        self._fill_denoiser(networks)
        return adapter_of(networks, self._recipe.model.lora, card, base)

    def _vae_identity(self) -> str:
        return digest_of(self._config.vae, self._recipe.seed)

    def _identity(self, networks: Networks) -> str:
        """What the state of the denoiser's stage belongs to; `networks` hold what was trained before it."""
        config, model = self._config, self._recipe.model
        told = (config.unet, config.prediction, self._recipe.seed)
        student = self._recipe.student is not None
        shape = digest_of(*told, *((config.sampling,) if student else ()))
        part = (
            ""
            if model.train == "all" and not student
            else f"-{base_digest(networks.state_dict())}-{digest_of(model.lora)}"
        )
        return f"{autoencoder_digest(networks)}-{shape}{part}"

    def _loop(self, task: Task, stage: AnyStageName, table: StageRecipe, identity: str, parts: int = 1) -> None:
        options = LoopOptions(
            stage=stage,
            identity=identity,
            table=table,
            log=self._recipe.log,
            stop=self._stop,
            frames_per_clip=self._config.frames,
            parts=parts,
            engine=self._engine if stage == _DENOISER else Engine(),
        )
        Loop(task, self._folder, options).run()

    def _train_vae(self, recipe: VAERecipe) -> None:
        networks = start_networks(self._recipe.model, self._config, self._recipe.seed)
        task = VAETask(networks, self._data.clips, self._data.valid, recipe, self._precision, self._recipe.seed)
        self._loop(task, "vae", recipe, self._vae_identity())

    def _train_denoiser(self) -> None:
        recipe, networks, precision = self._recipe.unet, self._start(), self._precision
        identity = self._identity(networks)
        let_train(networks, self._recipe.model, self._recipe.seed)
        clips = self._encodings.opened(networks) if recipe.source == "latents" else None
        if self._recipe.compute.frozen == "bfloat16":
            halve_frozen(networks)
        precision.placed(networks if recipe.source == "pixels" else networks.unet)  # encoders only to encode
        weights = None  # of latent channels, by what the decoder makes of them
        if recipe.loss.sensitivity and clips is not None:
            weights = torch.tensor(clips.meta.sensitivity, device=precision.device)
        batches, seed, student = self._batches(networks, clips), self._recipe.seed, self._recipe.student
        task = UNetTask(networks, batches, self._validation(), recipe, weights, precision, seed, student)
        self._loop(task, _DENOISER, recipe, identity, recipe.parts)

    def _batches(self, networks: Networks, clips: LatentClips | None) -> BatchSource:
        """clips: encoded ones, where batches are made of such."""
        recipe, precision = self._recipe.unet, self._precision
        drawn = self._data.clips if self._data.drawn is None else self._data.drawn
        if clips is not None:
            return EncodedBatches(clips, self._config, recipe, precision)
        if isinstance(drawn, CachedLatents):
            return CachedBatches(drawn, networks, recipe, precision, self._recipe.data.path)
        turns = [part for part, _ in self._engine.processes.batches(recipe.parts)]
        loader, seed = self._recipe.data.loader, self._recipe.seed
        return SampleBatches(drawn, networks, recipe, self._family, precision, loader, seed, turns)

    def _export(self) -> None:
        recipe, networks, config = self._recipe, self._start(), self._config
        start, updates = recipe.model.weights, self._fill_denoiser(networks)
        merge_lora(networks)
        thaw(networks)
        goal = recipe.data.goal_frame(config.frames)
        export(
            networks,
            self._folder,
            Card(name=recipe.name, config=config, family=self._family, move_time=goal),
            recipe.export,
            self._validation(),
            updates=updates,
            leftovers=lambda: {} if start is None else loaded_base(start, config).carried,
            adapter=self._adapter if recipe.model.train == "lora" else None,
        )

    def _validation(self) -> Validation:
        return Validation(self._data.valid, self._family, count=self._recipe.log.valid_clips)


def require_fit(clips: Clips, config: ModelConfig, fps: float) -> None:
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
