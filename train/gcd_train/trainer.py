"""A run: the stages of a recipe in their order, each from where it stopped."""

import logging
from dataclasses import dataclass
from typing import TypeVar

import torch

from gcd_model import ModelConfig
from gcd_model.networks import Networks
from gcd_train.batches import BatchSource, EncodedBatches, PixelBatches
from gcd_train.datasets.clip_source import ClipSource, KeptClips, numbers_of
from gcd_train.datasets.latents import LatentClips
from gcd_train.datasets.predictions import Predictions, PredictionsMeta, write_predictions
from gcd_train.draws import Draws
from gcd_train.errors import RecipeError, RunError
from gcd_train.loop import Loop, LoopOptions, StopSignal, Task
from gcd_train.losses import class_frequency_weights
from gcd_train.model_setup import digest_of, family_of, fill, model_config, start_networks, weights_digest
from gcd_train.objective import Weights
from gcd_train.precision import Precision
from gcd_train.recipe import DecoderRecipe, Recipe, StageName, UNetRecipe, VAERecipe
from gcd_train.run_folder import RunFolder
from gcd_train.stages.decoder import DecoderData, DecoderTask, Predictor
from gcd_train.stages.export import export, without_plane_mix
from gcd_train.stages.latents import LatentsJob, encode_clips
from gcd_train.stages.unet import UNetTask
from gcd_train.stages.vae import VAETask
from gcd_train.validation import Validation

_log = logging.getLogger(__name__)
Table = TypeVar("Table")


@dataclass(frozen=True, kw_only=True, slots=True)
class RunInputs:
    """What a run works with. clips: to learn from. valid: held out, to measure on. stop: asked between updates."""

    recipe: Recipe
    clips: ClipSource
    valid: ClipSource
    folder: RunFolder
    stop: StopSignal


class Trainer:
    """The stages of one run."""

    def __init__(self, inputs: RunInputs) -> None:
        """Raises RecipeError if the recipe's model cannot be built or its device is not there."""
        self._inputs, self._recipe, self._folder = inputs, inputs.recipe, inputs.folder
        self._config: ModelConfig = model_config(inputs.recipe.model)
        self._family = family_of(inputs.recipe.model)
        self._precision = Precision.of(inputs.recipe.compute)

    def run(self, only: StageName | None = None) -> None:
        """Every stage that is not finished, or just one.

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
            "decoder": self._train_decoder,
            "export": self._export,
        }
        for stage in (only,) if only else self._recipe.stages:
            _log.info("stage %s", stage)
            steps[stage]()

    def _networks(self, *stages: StageName) -> Networks:
        """Networks with the weights of those stages that the recipe has."""
        networks = start_networks(self._recipe.model, self._config, self._recipe.seed)
        for stage in stages:
            if stage in self._recipe.stages:
                fill(networks, self._folder, stage)
        return networks

    def _loop(
        self, task: Task, stage: StageName, recipe: VAERecipe | UNetRecipe | DecoderRecipe, identity: str
    ) -> None:
        options = LoopOptions(
            stage=stage,
            identity=identity,
            budget=recipe.budget,
            optimiser=recipe.optimiser,
            ema=recipe.ema,
            log=self._recipe.log,
            stop=self._inputs.stop,
        )
        Loop(task, self._folder, options).run()

    def _train_vae(self) -> None:
        recipe, seed = _present(self._recipe.vae), self._recipe.seed
        task = VAETask(self._networks(), self._inputs.clips, self._inputs.valid, recipe, self._precision, seed)
        self._loop(task, "vae", recipe, digest_of(self._config.vae, seed))

    def _encode(self) -> None:
        recipe, networks = _present(self._recipe.latents), self._networks("vae")
        job = LatentsJob(
            folder=self._folder.stage("latents"),
            networks=networks,
            clips=self._inputs.clips,
            recipe=recipe,
            precision=self._precision,
            seed=self._recipe.seed,
            identity=f"{_autoencoder_digest(networks)}-{digest_of(recipe, self._recipe.seed)}",
            stop=self._inputs.stop,
        )
        encode_clips(job)

    def _train_unet(self) -> None:
        recipe, networks = self._recipe.unet, self._networks("vae")
        autoencoder = _autoencoder_digest(networks)
        self._precision.placed(networks)
        clips = self._latent_clips(autoencoder) if recipe.source == "latents" else None
        task = UNetTask(
            networks,
            self._batches(networks, clips),
            self._validation(plane_mix=False),
            recipe,
            self._weights(clips),
            self._precision,
            self._recipe.seed,
        )
        shape = digest_of(self._config.unet, self._config.prediction, self._config.plane_warp, self._recipe.seed)
        self._loop(task, "unet", recipe, f"{autoencoder}-{shape}")

    def _train_decoder(self) -> None:
        recipe, networks = _present(self._recipe.decoder), self._networks("vae", "unet")
        clips = self._latent_clips(_autoencoder_digest(networks))
        identity = f"{weights_digest(networks.unet.state_dict())}-{digest_of(self._recipe.seed)}"
        self._precision.placed(networks)
        data = DecoderData(
            clips=KeptClips(self._inputs.clips, numbers_of(self._inputs.clips, clips.meta.seeds)),
            latents=clips,
            predictions=self._predictions(networks, clips, recipe, identity),
            class_weights=class_weights(clips, recipe.class_power, self._precision.device),
        )
        task = DecoderTask(networks, data, self._validation(plane_mix=True), recipe, self._precision, self._recipe.seed)
        mix = digest_of(self._config.plane_warp, self._config.plane_mix)
        self._loop(task, "decoder", recipe, f"{identity}-{mix}")

    def _predictions(self, networks: Networks, clips: LatentClips, recipe: DecoderRecipe, identity: str) -> Predictions:
        """What the U-Net makes of some clips; made now unless they are there."""
        folder = self._folder.path / "predictions"
        order = Draws(self._recipe.seed, "decoder-clips", 0, torch.device("cpu")).order(clips.meta.clips)
        meta = PredictionsMeta(identity=identity, clips=tuple(order[: recipe.clips]))
        if not (folder / "meta.json").exists():
            _log.info("predicting %d clips", len(meta.clips))
            batches = EncodedBatches(clips, self._config, self._recipe.unet, self._precision)
            predictor = Predictor(networks, clips, batches, self._precision, self._recipe.seed)
            write_predictions(folder, meta, predictor.predict)
        made = Predictions.open(folder)
        if made.meta != meta:
            raise RunError(f"{folder} was made by another U-Net or of other clips; delete it and run again")
        return made

    def _export(self) -> None:
        mixes = "decoder" in self._recipe.stages
        networks = self._networks("vae", "unet", "decoder")
        networks = networks if mixes else without_plane_mix(networks)
        export(networks, self._folder, self._recipe.name, self._family, self._validation(plane_mix=mixes))

    def _validation(self, *, plane_mix: bool) -> Validation:
        count = self._recipe.log.valid_clips
        return Validation(self._inputs.valid, self._family, count=count, plane_mix=plane_mix)

    def _latent_clips(self, autoencoder: str) -> LatentClips:
        clips = LatentClips.open(self._folder.stage("latents"))
        if not clips.meta.identity.startswith(autoencoder):
            raise RunError(
                f"{self._folder.stage('latents')} was made by another autoencoder than this run's; delete it and run "
                "the latents stage again"
            )
        return clips.resident(self._precision.device) if self._recipe.compute.resident else clips

    def _batches(self, networks: Networks, clips: LatentClips | None) -> BatchSource:
        recipe = self._recipe.unet
        if clips is None:
            return PixelBatches(self._inputs.clips, networks, recipe, self._precision)
        return EncodedBatches(clips, self._config, recipe, self._precision)

    def _weights(self, clips: LatentClips | None) -> Weights:
        loss, device = self._recipe.unet.loss, self._precision.device
        if clips is None:
            return Weights()
        channels = torch.tensor(clips.meta.sensitivity, device=device) if loss.sensitivity else None
        return Weights(channels=channels, classes=class_weights(clips, loss.class_power, device))


def class_weights(clips: LatentClips, power: float, device: torch.device) -> torch.Tensor | None:
    """Weights of the classes by their frequency in the encoded clips, [K]; None without class maps."""
    if not clips.meta.class_counts:
        return None
    return class_frequency_weights(torch.tensor(clips.meta.class_counts), power).to(device)


def _autoencoder_digest(networks: Networks) -> str:
    parts = (networks.target_encoder, networks.condition_encoder, networks.decoder)
    return weights_digest(
        {f"{i}.{name}": value for i, part in enumerate(parts) for name, value in part.state_dict().items()}
    )


def _present(table: Table | None) -> Table:
    assert table is not None, "a stage runs only if the recipe has its table"
    return table
