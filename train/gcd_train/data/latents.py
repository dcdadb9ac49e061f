"""The clips of a run, encoded once: as the U-Net needs them.

A folder of them has an index and shards (see `cache`); a shard holds some clips that follow each other:

source      float16 [N, F, T, C, h, w]      clean condition latents, plain and (F = 2) mirrored
target      float16 [N, F, T, C, h, w]      target latents, as the U-Net works on them
motion      float32 [N]                     the number that says how far the camera goes
control     float32 [N, F, T, K]            camera features, where the model is steered
emphasis    float16 [N, T, 1, h, w]         how much more a class counts, see `class_emphasis`
splat       float16 [N, F, T, C + 1, h, w]  the source's points from the target camera, where the model is shown them
"""

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Self

import msgspec
import torch
from torch import Tensor

from gcd_model.conditioning import splat_channels
from gcd_model.config import ModelConfig
from gcd_model.networks import Networks
from gcd_model.vae import Posterior
from gcd_model.weights.card import Family
from gcd_train.data.cache import (
    EncodedRows,
    FrozenEncoders,
    Index,
    Shard,
    autoencoder_digest,
    open_shard,
    read_index,
    write_index,
    write_shard,
)
from gcd_train.data.sample import Clips, numbers_of, splat_of, to_network
from gcd_train.errors import DataError, Interrupted, RunError
from gcd_train.files import only_writer
from gcd_train.recipe import LatentsRecipe, Recipe
from gcd_train.training.losses import COLOUR_WEIGHTS, class_emphasis
from gcd_train.training.setup import Conditioner, Draws, Precision, digest_of, mirrored_path

_log = logging.getLogger(__name__)
_SHARD = 32  # clips
_LOG_S = 15.0
_SENSITIVITY_CLIPS, _NUDGE = 8, 0.25
_ANEW = "delete its folder and run `gcd-train train ... --stage latents`"


class LatentsMeta(Index, frozen=True, kw_only=True):
    """The index of a folder of latents.

    identity: the autoencoder and the options it was made with. seeds: of the N clips there are to be; `shards` hold
    them in this order. frames: T. flips: F. sensitivity, when all are there: what a unit change of each latent channel
    does to the decoded picture, one on average.
    """

    identity: str
    seeds: tuple[int, ...]
    frames: int
    flips: int
    shards: tuple[Shard, ...] = ()
    sensitivity: tuple[float, ...] = ()

    @property
    def clips(self) -> int:
        """N."""
        return len(self.seeds)

    @property
    def done(self) -> int:
        """Clips that are there."""
        return sum(shard.arrays["motion"][0] for shard in self.shards)


class LatentClips:
    """An opened folder of latents."""

    def __init__(self, meta: LatentsMeta, shards: Sequence[dict[str, Tensor]]) -> None:
        self.meta, self._shards = meta, tuple(shards)
        self._ends = torch.tensor([len(shard["motion"]) for shard in shards]).cumsum(0)

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Map the arrays. Raises RunError if the folder is unfinished, DataError for a damaged shard."""
        meta = read_index(folder, LatentsMeta)
        if meta is None or not meta.sensitivity:
            raise RunError(f"{folder} holds no finished latents; run `gcd-train train ... --stage latents`")
        return cls(meta, [open_shard(folder, shard, _ANEW) for shard in meta.shards])

    def resident(self, device: torch.device) -> Self:
        """The same, held in the device's memory."""
        names = self._shards[0]
        return type(self)(self.meta, [{name: torch.cat([s[name] for s in self._shards]).to(device) for name in names}])

    def rows(self, clips: Tensor, frames: Tensor, mirrored: Tensor, device: torch.device) -> EncodedRows:
        """The frames (clips[i], frames[i]), mirrored where the flag says so; all int64 or bool [N] on the CPU."""

        part_of = torch.bucketize(clips, self._ends, right=True)
        parts: list[int] = part_of.unique().tolist()
        places = [(part_of == part).nonzero()[:, 0] for part in parts]
        order = torch.cat(places).argsort()

        def at(name: str, *index: Tensor) -> Tensor | None:
            """Rows of an array, which lie in several shards, in the order of `clips`."""
            if name not in self._shards[0]:
                return None
            found: list[Tensor] = []
            for part, which in zip(parts, places, strict=True):
                values = self._shards[part][name]
                numbers = clips[which] - (self._ends[part - 1] if part else 0)
                found.append(values[tuple(each.to(values.device) for each in (numbers, *(i[which] for i in index)))])
            rows = torch.cat(found)
            return rows[order.to(rows.device)].to(device)

        side = mirrored.long()
        source, target, splat = (at(name, side, frames) for name in ("source", "target", "splat"))
        assert source is not None and target is not None  # noqa: PT018
        emphasis = at("emphasis", frames)
        if emphasis is not None:
            flip = mirrored.to(device).view(-1, *[1] * (emphasis.ndim - 1))
            emphasis = torch.where(flip, emphasis.flip(-1), emphasis).float()
        return EncodedRows(
            source=source.float(),
            target=target.float(),
            motion=at("motion"),
            camera=at("control", side, frames),
            emphasis=emphasis,
            splat=None if splat is None else splat.float(),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class Encodings:
    """A run's folder of latents: its clips, encoded once.

    networks are given to each function; of them the autoencoder counts. folder: of the run's own. shared: a folder that
    several runs share, where each set of clips lies under the name of what it belongs to; None for the run's own.
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
        """Write the folder of latents, or what is missing of it.

        Raises:
            Interrupted: the stop signal was set; run again to go on. DataError: there are no clips.
            RunError: the folder holds latents of another autoencoder or cannot be written.
        """
        identity = self._identity(networks)
        folder = self._place(identity)
        with only_writer(folder):
            self._write(networks, folder, identity)

    def _write(self, networks: Networks, folder: Path, identity: str) -> None:
        meta = read_index(folder, LatentsMeta) or self._description(identity)
        _require_identity(folder, meta, identity)
        if meta.sensitivity:
            return
        self.precision.placed(networks.target_encoder)
        places, done, rows = numbers_of(self.clips, meta.seeds), meta.done, list[dict[str, Tensor]]()
        conditioner = Conditioner(self.config, self.recipe.unet, self.precision, self.family)
        logged = started = time.perf_counter()
        for number in range(done, meta.clips):
            rows.append(self._encoded(networks, conditioner, places[number], meta.flips))
            now, stopped = time.perf_counter(), self.stop.is_set()
            if now - logged > _LOG_S:
                logged, rate = now, (number + 1 - done) / (now - started)
                left_s = (meta.clips - number - 1) / rate
                _log.info("latents  clip %d of %d  %.2f clips/s  %.0f s left", number + 1, meta.clips, rate, left_s)
            if stopped or len(rows) == _SHARD or number + 1 == meta.clips:
                tensors = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
                shard = write_shard(folder, f"clips-{meta.done:06d}", tensors, Shard)
                meta = msgspec.structs.replace(meta, shards=(*meta.shards, shard))
                write_index(folder, meta)
                rows.clear()
            if stopped:
                raise Interrupted(f"stopped after clip {number + 1} of {meta.clips} of latents; run again to go on")
        first = [open_shard(folder, shard, f"delete {folder}")["target"] for shard in meta.shards[:_SENSITIVITY_CLIPS]]
        told = self._sensitivity(networks, torch.cat(first)[:_SENSITIVITY_CLIPS, 0].float())
        write_index(folder, msgspec.structs.replace(meta, sensitivity=tuple(told.tolist())))

    def opened(self, networks: Networks) -> LatentClips:
        """What the U-Net learns from.

        Raises RunError for latents of another autoencoder, or unfinished ones; DataError for damaged ones.
        """
        identity = self._identity(networks)
        place = self._place(identity)
        latents = LatentClips.open(place)
        _require_identity(place, latents.meta, identity)
        return latents.resident(self.precision.device) if self.recipe.compute.resident else latents

    def _place(self, identity: str) -> Path:
        return self.folder if self.shared is None else self.shared / identity

    def _identity(self, networks: Networks) -> str:
        recipe, config, family = self.recipe, self.config, self.family
        by_path = family.motion_bucket is None and family.limits is not None
        motion = family.name if by_path else None  # families with the recipe's number write the same latents
        shown = () if config.splat == "none" else (config.splat,)  # without, latents of before are the same
        steered = (config.camera, motion, recipe.unet.motion_bucket, *shown)
        options = digest_of(self._latents, self._seed, self.clips.origin, steered, recipe.unet.loss.class_weights)
        return f"{autoencoder_digest(networks)}-{options}"

    @property
    def _latents(self) -> LatentsRecipe:
        assert self.recipe.latents is not None, "clips are encoded only if the recipe has the table"
        return self.recipe.latents

    @property
    def _seed(self) -> int:
        """Of the draws; without any, runs that differ in seed alone share their latents."""
        return self.recipe.seed if self._latents.augmentation or self._latents.sample else 0

    def _description(self, identity: str) -> LatentsMeta:
        config, count = self.config, len(self.clips)
        if count == 0:
            raise DataError("there are no clips to encode; generate some with `gcd-train generate driving`")
        frames, height, width = self.clips.sample(0).source.shape[:3]
        if (frames, height, width) != (config.frames, config.height, config.width):
            raise DataError(
                f"clips must be {config.frames} frames of {config.width}x{config.height} for this model, "
                f"got {frames} of {width}x{height}; generate them anew, or change [model] in the recipe"
            )
        seeds = tuple(self.clips.seeds[: self._latents.limit or count])
        return LatentsMeta(identity=identity, seeds=seeds, frames=frames, flips=2 if self._latents.flip else 1)

    @torch.no_grad()
    def _encoded(self, networks: Networks, conditioner: Conditioner, number: int, flips: int) -> dict[str, Tensor]:
        """One clip's row of every array."""
        sample = self.clips.sample(number)
        path, draws = sample.trajectory, Draws(self._seed, "latents", number, self.precision.device)
        source, target = (self.precision.frames(to_network(side)) for side in (sample.source, sample.target))
        sources, targets = ([side, side.flip(-1)][:flips] for side in (source, target))
        encoders, recipe = FrozenEncoders(networks=networks, at_once=len(source)), self._latents

        def noisy(frames: Tensor) -> Tensor:
            return frames + recipe.augmentation * draws.normal(*frames.shape) if recipe.augmentation else frames

        def drawn(posterior: Posterior) -> Tensor:
            return posterior.sample(draws.normal(*posterior.mean.shape)) if recipe.sample else posterior.mean

        splats = splat_of(sample, source, self.config.splat)
        with self.precision.arithmetic():
            conditions = [encoders.condition(noisy(frames)) for frames in sources]
            posteriors = [encoders.target(frames) for frames in targets]
            sides = () if splats is None else (splats, splats.flip(-1))[:flips]
            shown = [splat_channels(each, encoders.condition) for each in sides]
        rows = {
            "source": torch.stack(conditions).half(),
            "target": torch.stack([drawn(each) * self.config.vae.scale for each in posteriors]).half(),
            "motion": torch.tensor(conditioner.motion(path), dtype=torch.float32),
        }
        if shown:
            rows["splat"] = torch.stack(shown).half()
        features = [conditioner.camera(each) for each in (path, mirrored_path(path))[:flips]]
        steered = [each.float() for each in features if each is not None]
        if steered:
            rows["control"] = torch.stack(steered)
        if class_weights := COLOUR_WEIGHTS[self.recipe.unet.loss.class_weights]:
            size = (rows["target"].shape[-2], rows["target"].shape[-1])
            rows["emphasis"] = class_emphasis(target, class_weights, size).half()
        return {name: value.cpu() for name, value in rows.items()}

    @torch.no_grad()
    def _sensitivity(self, networks: Networks, latents: Tensor) -> Tensor:
        """Mean squared change of the decoded picture for a small change of each channel, one on average: [C].

        latents: [N, T, C, h, w]; the first, middle and last frame of each are decoded, each by itself.
        """
        decoder = self.precision.placed(networks.decoder)
        draws = Draws(self._seed, "sensitivity", 0, self.precision.device)
        frames = latents[:, [0, latents.shape[1] // 2, -1]].flatten(0, 1) / networks.config.vae.scale
        rows = self.precision.frames(frames)
        plain = decoder(rows, None)
        changes: list[Tensor] = []
        for channel in range(rows.shape[1]):
            nudged = rows.clone()
            nudged[:, channel] += _NUDGE * draws.normal(*rows[:, channel].shape)
            changes.append(((decoder(nudged, None) - plain) ** 2).mean())
        total = torch.stack(changes).cpu()
        return total / total.mean()


def _require_identity(folder: Path, meta: LatentsMeta, identity: str) -> None:
    if meta.identity != identity:
        raise RunError(
            f"{folder} was made by another autoencoder, of other clips or with other options ({meta.identity}, now "
            f"{identity}); delete it and run the latents stage again"
        )
