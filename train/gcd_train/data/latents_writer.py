"""The clips of a run are encoded once: clip by clip, and where the latents of each set lie."""

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event

import msgspec
import torch
from torch import Tensor

from gcd_model import Family, ModelConfig
from gcd_model.networks import Networks, weights_digest
from gcd_train.data.latents import (
    LatentClips,
    LatentsMeta,
    Shard,
    open_shard,
    read_index,
    write_index,
    write_shard,
)
from gcd_train.data.sample import Clips, numbers_of, to_network
from gcd_train.errors import DataError, Interrupted, RunError
from gcd_train.recipe import LatentsRecipe, Recipe
from gcd_train.training.conditioner import Conditioner, mirrored_path
from gcd_train.training.draws import Draws
from gcd_train.training.losses import COLOUR_WEIGHTS, ClassWeight, class_emphasis
from gcd_train.training.setup import Precision, digest_of

_log = logging.getLogger(__name__)
_SHARD = 32  # clips
_LOG_S = 15.0
_SENSITIVITY_CLIPS, _NUDGE = 8, 0.25


@dataclass(frozen=True, kw_only=True, slots=True)
class LatentsJob:
    """What clips are encoded with.

    networks: of which the autoencoder counts. conditioner: works out what the U-Net gets of camera paths.
    class_weights: of painted targets, none for others. identity: names autoencoder and options.
    """

    folder: Path
    networks: Networks
    clips: Clips
    recipe: LatentsRecipe
    conditioner: Conditioner
    class_weights: Sequence[ClassWeight]
    precision: Precision
    seed: int
    identity: str
    stop: Event


def encode_clips(job: LatentsJob) -> None:
    """Write the folder of latents, or what is missing of it.

    Raises:
        Interrupted: the stop signal was set; run again to go on. DataError: there are no clips.
        RunError: the folder holds latents of another autoencoder or cannot be written.
    """
    meta = read_index(job.folder, LatentsMeta) or _description(job)
    if meta.identity != job.identity:
        raise RunError(
            f"{job.folder} was made by another autoencoder or with other options ({meta.identity}, now "
            f"{job.identity}); delete it to encode the clips again"
        )
    if meta.sensitivity:
        return
    job.precision.placed(job.networks.target_encoder)
    places, done, rows = numbers_of(job.clips, meta.seeds), meta.done, list[dict[str, Tensor]]()
    logged = started = time.perf_counter()
    for number in range(done, meta.clips):
        rows.append(_encoded(job, meta, places[number]))
        now, stopped = time.perf_counter(), job.stop.is_set()
        if now - logged > _LOG_S:
            logged, rate = now, (number + 1 - done) / (now - started)
            left_s = (meta.clips - number - 1) / rate
            _log.info("latents  clip %d of %d  %.2f clips/s  %.0f s left", number + 1, meta.clips, rate, left_s)
        if stopped or len(rows) == _SHARD or number + 1 == meta.clips:
            tensors = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
            shard = write_shard(job.folder, f"clips-{meta.done:06d}", tensors, Shard)
            meta = msgspec.structs.replace(meta, shards=(*meta.shards, shard))
            write_index(job.folder, meta)
            rows.clear()
        if stopped:
            raise Interrupted(f"stopped after clip {number + 1} of {meta.clips} of latents; run again to go on")
    first = [open_shard(job.folder, shard, f"delete {job.folder}") for shard in meta.shards[:_SENSITIVITY_CLIPS]]
    target = torch.cat([shard["target"] for shard in first])[:_SENSITIVITY_CLIPS, 0].float()
    write_index(job.folder, msgspec.structs.replace(meta, sensitivity=tuple(_sensitivity(job, target).tolist())))


def _description(job: LatentsJob) -> LatentsMeta:
    config = job.networks.config
    if len(job.clips) == 0:
        raise DataError("there are no clips to encode; generate some with `gcd-train generate driving`")
    frames, height, width = job.clips.sample(0).source.shape[:3]
    if (frames, height, width) != (config.frames, config.height, config.width):
        raise DataError(
            f"clips must be {config.frames} frames of {config.width}x{config.height} for this model, "
            f"got {frames} of {width}x{height}; generate them anew, or change [model] in the recipe"
        )
    count = min(len(job.clips), job.recipe.limit or len(job.clips))
    return LatentsMeta(
        identity=job.identity,
        seeds=tuple(job.clips.seeds[:count]),
        frames=frames,
        flips=2 if job.recipe.flip else 1,
    )


@torch.no_grad()
def _encoded(job: LatentsJob, meta: LatentsMeta, number: int) -> dict[str, Tensor]:
    """One clip's row of every array."""
    sample = job.clips.sample(number)
    source, target = (job.precision.frames(to_network(side)) for side in (sample.source, sample.target))
    path, draws = sample.trajectory, Draws(job.seed, "latents", number, job.precision.device)
    sides = [False, True][: meta.flips]
    rows = {
        "source": torch.stack([_condition(job, source, draws, mirrored) for mirrored in sides]).half(),
        "target": torch.stack([_target(job, target, draws, mirrored) for mirrored in sides]).half(),
        "motion": torch.tensor(job.conditioner.motion(path), dtype=torch.float32),
    }
    features = [job.conditioner.camera(mirrored_path(path) if mirrored else path) for mirrored in sides]
    steered = [each.float() for each in features if each is not None]
    if steered:
        rows["control"] = torch.stack(steered)
    if job.class_weights:
        size = (rows["target"].shape[-2], rows["target"].shape[-1])
        rows["emphasis"] = class_emphasis(target, job.class_weights, size).half()
    return {name: value.cpu() for name, value in rows.items()}


def _condition(job: LatentsJob, frames: Tensor, draws: Draws, mirrored: bool) -> Tensor:
    noisy = frames.flip(-1) if mirrored else frames
    if job.recipe.augmentation:
        noisy = noisy + job.recipe.augmentation * draws.normal(*noisy.shape)
    with job.precision.arithmetic():
        return job.networks.condition_encoder(noisy).mean.float()


def _target(job: LatentsJob, frames: Tensor, draws: Draws, mirrored: bool) -> Tensor:
    with job.precision.arithmetic():
        posterior = job.networks.target_encoder(frames.flip(-1) if mirrored else frames)
    latents = posterior.sample(draws.normal(*posterior.mean.shape)) if job.recipe.sample else posterior.mean
    return latents.float() * job.networks.config.vae.scale


@torch.no_grad()
def _sensitivity(job: LatentsJob, latents: Tensor) -> Tensor:
    """Mean squared change of the decoded picture for a small change of each channel, one on average: [C].

    latents: [N, T, C, h, w]; the first, middle and last frame of each are decoded, each by itself.
    """
    decoder = job.precision.placed(job.networks.decoder)
    draws = Draws(job.seed, "sensitivity", 0, job.precision.device)
    frames = latents[:, [0, latents.shape[1] // 2, -1]].flatten(0, 1) / job.networks.config.vae.scale
    rows = job.precision.frames(frames)
    plain = decoder(rows, None)
    changes: list[Tensor] = []
    for channel in range(rows.shape[1]):
        nudged = rows.clone()
        nudged[:, channel] += _NUDGE * draws.normal(*rows[:, channel].shape)
        changes.append(((decoder(nudged, None) - plain) ** 2).mean())
    total = torch.stack(changes).cpu()
    return total / total.mean()


@dataclass(frozen=True, kw_only=True, slots=True)
class Encodings:
    """A run's folder of latents.

    folder: of the run's own. shared: a folder that several runs share, where each set of clips lies under the name of
    what it belongs to; None for the run's own.
    """

    recipe: Recipe
    config: ModelConfig
    family: Family
    precision: Precision
    clips: Clips
    folder: Path
    shared: Path | None
    stop: Event

    def encode(self, networks: Networks) -> None:
        """Write what is not there yet. Raises Interrupted, DataError, RunError, see `encode_clips`."""
        recipe, identity = self.recipe, self._identity(networks)
        job = LatentsJob(
            folder=self._place(identity),
            networks=networks,
            clips=self.clips,
            recipe=self._latents,
            precision=self.precision,
            seed=recipe.seed,
            conditioner=Conditioner(self.config, recipe.unet, self.precision, self.family),
            class_weights=COLOUR_WEIGHTS[recipe.unet.loss.class_weights],
            identity=identity,
            stop=self.stop,
        )
        encode_clips(job)

    def opened(self, networks: Networks) -> LatentClips:
        """What the U-Net learns from.

        Raises RunError for latents of another autoencoder, or unfinished ones; DataError for damaged ones.
        """
        identity = self._identity(networks)
        place = self._place(identity)
        latents = LatentClips.open(place)
        if latents.meta.identity != identity:
            raise RunError(
                f"{place} was made by another autoencoder, of other clips or with other options than this run's; "
                "delete it and run the latents stage again"
            )
        return latents.resident(self.precision.device) if self.recipe.compute.resident else latents

    def _place(self, identity: str) -> Path:
        return self.folder if self.shared is None else self.shared / identity

    def _identity(self, networks: Networks) -> str:
        recipe, config, family = self.recipe, self.config, self.family
        by_path = family.motion_bucket is None and family.limits is not None
        motion = family.name if by_path else None  # families with the recipe's number write the same latents
        steered = (config.camera, motion, recipe.unet.motion_bucket)
        options = digest_of(self._latents, recipe.seed, self.clips.origin, steered, recipe.unet.loss.class_weights)
        return f"{autoencoder_digest(networks)}-{options}"

    @property
    def _latents(self) -> LatentsRecipe:
        assert self.recipe.latents is not None, "clips are encoded only if the recipe has the table"
        return self.recipe.latents


def autoencoder_digest(networks: Networks) -> str:
    """Names the weights that encode and decode."""
    parts = (networks.target_encoder, networks.condition_encoder, networks.decoder)
    return weights_digest(
        {f"{i}.{name}": value for i, part in enumerate(parts) for name, value in part.state_dict().items()}
    )
