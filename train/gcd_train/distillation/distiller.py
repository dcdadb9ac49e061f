"""A distillation: the stages of its recipe in their order, each from where it stopped."""

import logging
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from gcd_model.networks import Networks
from gcd_model.weights.adapter import Adapter, base_digest
from gcd_model.weights.card import Card
from gcd_train.batches import BatchSource, EncodedBatches, PixelBatches
from gcd_train.data.latents import EncodedClips
from gcd_train.data.latents_writer import Encodings
from gcd_train.data.open import RunData
from gcd_train.distillation.paired import PairedTask
from gcd_train.distillation.recipe import DistillRecipe, SampleLossRecipe
from gcd_train.distillation.sample_losses import SampleLoss
from gcd_train.distillation.teacher import Teacher, as_training, student_config
from gcd_train.engine.engine import Engine
from gcd_train.errors import RecipeError
from gcd_train.loop import Loop, LoopOptions, Task
from gcd_train.lora import adapter_of, merge_lora
from gcd_train.model_setup import digest_of, fill, require_exportable
from gcd_train.precision import Precision
from gcd_train.recipe import DistillStageName
from gcd_train.run_folder import RunFolder
from gcd_train.stages.export import ExportJob, export
from gcd_train.start import carried_leftovers, start_networks
from gcd_train.stop import StopSignal
from gcd_train.trained_part import halve_frozen, let_train, thaw
from gcd_train.validation import Validation

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class DistillInputs:
    """What a distillation works with. stop: asked between updates. latents: see `RunInputs`."""

    recipe: DistillRecipe
    teacher: Teacher
    data: RunData
    folder: RunFolder
    stop: StopSignal
    latents: Path | None = None


class Distiller:
    """The stages of one distillation."""

    def __init__(self, inputs: DistillInputs) -> None:
        """Raises RecipeError if the student cannot be built or exported, or its device is not there."""
        self._inputs, self._recipe, self._folder = inputs, inputs.recipe, inputs.folder
        self._updates = 0  # of the stage that was filled in last
        self._shared = as_training(inputs.recipe, inputs.teacher)
        self._config = student_config(inputs.teacher.config, inputs.recipe.student)
        require_exportable(self._shared, self._config)
        self._precision = Precision.of(inputs.recipe.compute)
        self._encodings = Encodings(
            recipe=self._shared,
            config=self._config,
            family=inputs.teacher.family,
            precision=self._precision,
            sets=(inputs.data.clips,),
            as_videos=False,
            folder=inputs.folder.stage("latents"),
            shared=inputs.latents,
            stop=inputs.stop,
        )

    def run(self, only: DistillStageName | None = None) -> None:
        """Every stage that is not finished, or just one.

        Raises:
            Interrupted: the stop signal was set; what was done is saved.
            RunError: the run folder holds something that does not fit. RecipeError: no such stage in the recipe.
        """
        if only is not None and only not in self._recipe.stages:
            raise RecipeError(f"this recipe has no stage {only!r}, only {', '.join(self._recipe.stages)}")
        steps = {
            "latents": lambda: self._encodings.encode(self._teacher()),
            "paired": self._train_paired,
            "export": self._export,
        }
        for stage in (only,) if only else self._recipe.stages:
            _log.info("stage %s", stage)
            steps[stage]()

    @cached_property
    def _base(self) -> str:
        """Names the teacher's weights."""
        return base_digest(self._read.state_dict())

    @cached_property
    def _read(self) -> Networks:
        return start_networks(self._shared.model, self._config, self._recipe.seed)

    def _teacher(self) -> Networks:
        """The teacher's weights under the student's sampler."""
        return deepcopy(self._read)

    def _learner(self) -> Networks:
        """The student before it learned anything, ready to; adapters beside their layers."""
        networks = self._teacher()
        let_train(networks, self._shared.model, self._recipe.seed)
        return networks

    def _student(self) -> Networks:
        """The same with what [paired] taught it."""
        networks = self._learner()
        self._updates = fill(networks, self._folder, "paired", self._identity)
        return networks

    @property
    def _identity(self) -> str:
        """What the state of [paired] belongs to; runs that have begun hold the teacher's name and the last digest."""
        student, seed, sampling = self._recipe.student, self._recipe.seed, self._config.sampling
        return f"{self._base}-teacher-{digest_of(seed, sampling, student.train, student.lora, ())}"

    def _train_paired(self) -> None:
        recipe, networks = self._recipe.paired, self._learner()
        batches, weights = self._ready(networks, recipe.loss)
        loss = SampleLoss(networks, recipe.loss, weights, self._precision)
        task = PairedTask(
            networks,
            batches,
            self._validation(),
            recipe,
            self._recipe.batches,
            loss,
            self._precision,
            self._recipe.seed,
        )
        self._loop(task)

    def _ready(self, networks: Networks, loss: SampleLossRecipe) -> tuple[BatchSource, Tensor | None]:
        """Batches for networks that are placed to learn, and weights of latent channels."""
        shared = self._shared
        if shared.compute.frozen == "bfloat16":
            halve_frozen(networks)
        if shared.unet.source == "latents":
            clips = self._encodings.pairs(networks)
            self._precision.placed(networks.unet)
            return EncodedBatches(clips, self._config, shared.unet, self._precision), self._weights(clips, loss)
        self._precision.placed(networks)
        made = self._inputs.data.batches
        if made is not None:
            return made(networks, self._precision), None
        family = self._inputs.teacher.family
        return PixelBatches(self._inputs.data.clips, networks, shared.unet, self._precision, family), None

    def _weights(self, clips: EncodedClips, loss: SampleLossRecipe) -> Tensor | None:
        return torch.tensor(clips.meta.sensitivity, device=self._precision.device) if loss.sensitivity else None

    def _merged(self) -> Networks:
        """The student that is exported, as plain networks."""
        networks = self._student()
        merge_lora(networks)
        thaw(networks)
        return networks

    def _export(self) -> None:
        networks, recipe = self._merged(), self._recipe
        job = ExportJob(
            name=recipe.name,
            family=self._inputs.teacher.family,
            move_time=self._inputs.teacher.move_time,
            updates=self._updates,
            recipe=recipe.export,
            leftovers=self._leftovers,
            adapter=self._adapter if recipe.student.train == "lora" else None,
        )
        export(networks, self._folder, job, self._validation())

    def _leftovers(self) -> Mapping[str, Tensor]:
        return carried_leftovers(self._shared.model)

    def _adapter(self, card: Card) -> Adapter:
        """What the student learned, apart from its teacher."""
        return adapter_of(self._student(), self._recipe.student.lora, card, self._base)

    def _validation(self) -> Validation:
        count = self._recipe.log.valid_clips
        return Validation(self._inputs.data.valid, self._inputs.teacher.family, count=count)

    def _loop(self, task: Task) -> None:
        recipe = self._recipe.paired
        options = LoopOptions(
            stage="paired",
            identity=self._identity,
            budget=recipe.budget,
            optimiser=recipe.optimiser,
            ema=recipe.ema,
            log=self._recipe.log,
            stop=self._inputs.stop,
            frames_per_clip=self._config.frames,
            parts=self._recipe.batches.accumulate,
            engine=Engine(compute=self._recipe.compute),
        )
        Loop(task, self._folder, options).run()
