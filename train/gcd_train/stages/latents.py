"""Every clip encoded once; resumable clip by clip, finished when meta.json is there."""

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import torch
from torch import Tensor

from gcd_model.config import CAMERA_FEATURES
from gcd_model.errors import FileError
from gcd_model.geometry import Trajectory
from gcd_model.networks import Networks
from gcd_model.small_files import read_json
from gcd_train.datasets.clip_source import ClipSource, numbers_of, to_network
from gcd_train.datasets.latents import MOST_META, LatentsMeta
from gcd_train.errors import DataError, Interrupted, RunError
from gcd_train.files import write_whole
from gcd_train.recipe import LatentsRecipe
from gcd_train.stop import StopSignal
from gcd_train.training.batches import Conditioner, mirrored_path
from gcd_train.training.draws import Draws
from gcd_train.training.losses import ClassWeight, class_emphasis
from gcd_train.training.setup import Precision

_log = logging.getLogger(__name__)
_SAVE_EVERY = 32  # clips
_LOG_S = 15.0
_SENSITIVITY_CLIPS, _NUDGE = 8, 0.25


@dataclass(frozen=True, kw_only=True, slots=True)
class LatentsJob:
    """What the stage works with.

    networks: of which the autoencoder counts. conditioner: tells the U-Net of camera paths. class_weights: of painted
    targets, none for others. identity: names autoencoder and options.
    """

    folder: Path
    networks: Networks
    clips: ClipSource
    recipe: LatentsRecipe
    conditioner: Conditioner
    class_weights: Sequence[ClassWeight]
    precision: Precision
    seed: int
    identity: str
    stop: StopSignal


def encode_clips(job: LatentsJob) -> None:
    """Write the folder of latents, see `LatentClips`.

    Raises:
        Interrupted: the stop signal was set; run again to go on. DataError: there are no clips.
        RunError: the folder holds latents of another autoencoder or cannot be written.
    """
    if _finished(job):
        return
    job.precision.placed(job.networks.target_encoder)
    meta, arrays, done = _begin(job)
    places = numbers_of(job.clips, meta.seeds)
    logged = started = time.perf_counter()
    for number in range(done, meta.clips):
        for name, rows in _encoded(job, meta, places[number]).items():
            arrays[name][number] = rows
        now = time.perf_counter()
        if now - logged > _LOG_S:
            logged, rate = now, (number + 1 - done) / (now - started)
            _log.info(
                "latents  clip %d of %d  %.2f clips/s  %.0f s left",
                number + 1,
                meta.clips,
                rate,
                (meta.clips - number - 1) / rate,
            )
        if job.stop.is_set() or (number + 1) % _SAVE_EVERY == 0:
            _keep(job, meta, arrays, number + 1)
        if job.stop.is_set():
            raise Interrupted(f"stopped after clip {number + 1} of {meta.clips} of latents; run again to go on")
    _keep(job, meta, arrays, meta.clips)
    _finish(job, meta, arrays)


class _Begun(msgspec.Struct, frozen=True, kw_only=True):
    """Unfinished arrays. done: clips that are in them."""

    meta: LatentsMeta
    done: int


_Kind = TypeVar("_Kind", bound=msgspec.Struct)


def _finished(job: LatentsJob) -> bool:
    path = job.folder / "meta.json"
    if not path.exists():
        return False
    _require_same(job, _read(path, LatentsMeta))
    return True


def _read(path: Path, kind: type[_Kind]) -> _Kind:
    try:
        return read_json(path, kind, MOST_META)
    except FileError as error:
        raise RunError(f"{path} {error}; delete {path.parent} to encode the clips again") from error


def _require_same(job: LatentsJob, meta: LatentsMeta) -> None:
    if meta.identity != job.identity:
        raise RunError(
            f"{job.folder} was made by another autoencoder or with other options ({meta.identity}, now "
            f"{job.identity}); delete it to encode the clips again"
        )


def _begin(job: LatentsJob) -> tuple[LatentsMeta, dict[str, Any], int]:
    """Open the unfinished arrays, or make them: description, arrays by name, clips done."""
    progress = job.folder / "clips.json"
    try:
        if progress.exists():
            kept = _read(progress, _Begun)
            _require_same(job, kept.meta)
            return kept.meta, _opened(job.folder, kept.meta, "r+"), kept.done
        meta = _description(job)
        job.folder.mkdir(parents=True, exist_ok=True)
        return meta, _opened(job.folder, meta, "w+"), 0
    except (OSError, ValueError) as error:
        raise RunError(f"cannot go on in {job.folder} ({error}); free some space, or delete the folder") from error


def _opened(folder: Path, meta: LatentsMeta, mode: str) -> dict[str, Any]:
    """The arrays under their unfinished names; under the final ones where a run was killed between the renames."""
    arrays: dict[str, Any] = {}
    for name, (shape, kind) in meta.shapes.items():
        unfinished, final = folder / f"{name}.npy.part", folder / f"{name}.npy"
        path = final if mode == "r+" and final.exists() and not unfinished.exists() else unfinished
        arrays[name] = np.lib.format.open_memmap(path, mode=mode, dtype=kind, shape=shape)  # pyright: ignore[reportArgumentType]
    return arrays


def _description(job: LatentsJob) -> LatentsMeta:
    config = job.networks.config
    if len(job.clips) == 0:
        raise DataError("there are no clips to encode; generate some with `gcd-train generate driving`")
    frames, height, width = job.clips.rgb(0)[0].shape[:3]
    if (frames, height, width) != (config.frames, config.height, config.width):
        raise DataError(
            f"clips must be {config.frames} frames of {config.width}x{config.height} for this model, "
            f"got {frames} of {width}x{height}; generate them anew, or change [model] in the recipe"
        )
    down = config.vae.down_factor
    return LatentsMeta(
        identity=job.identity,
        seeds=tuple(
            job.clips.seed(number) for number in range(min(len(job.clips), job.recipe.limit or len(job.clips)))
        ),
        frames=frames,
        flips=2 if job.recipe.flip else 1,
        channels=config.vae.latent_channels,
        height=height // down,
        width=width // down,
        control=CAMERA_FEATURES[config.camera],
        emphasis=bool(job.class_weights),
    )


@torch.no_grad()
def _encoded(job: LatentsJob, meta: LatentsMeta, number: int) -> dict[str, np.ndarray[Any, Any]]:
    """One clip's row of every array."""
    source, target = (job.precision.frames(to_network(side)) for side in job.clips.rgb(number))
    draws = Draws(job.seed, "latents", number, job.precision.device)
    plain_and_mirrored = [False, True][: meta.flips]
    rows = {
        "source": torch.stack([_condition(job, source, draws, mirrored) for mirrored in plain_and_mirrored]).half(),
        "target": torch.stack([_target(job, target, draws, mirrored) for mirrored in plain_and_mirrored]).half(),
        **_told(job.conditioner, job.clips.trajectory(number), plain_and_mirrored),
    }
    if meta.emphasis:
        rows["emphasis"] = class_emphasis(target, job.class_weights, (meta.height, meta.width)).half()
    return {name: value.cpu().numpy() for name, value in rows.items()}


def _told(conditioner: Conditioner, path: Trajectory, plain_and_mirrored: Sequence[bool]) -> dict[str, Tensor]:
    """What the network is told of a clip's camera: motion number [] and, where it is steered, features [F, T, K]."""
    features = [conditioner.camera(mirrored_path(path) if mirrored else path) for mirrored in plain_and_mirrored]
    steered = [each for each in features if each is not None]
    motion = {"motion": torch.tensor(conditioner.motion(path))}
    return {**motion, "control": torch.stack(steered)} if steered else motion


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


def _keep(job: LatentsJob, meta: LatentsMeta, arrays: Mapping[str, Any], done: int) -> None:
    for array in arrays.values():
        array.flush()
    write_whole(job.folder / "clips.json", msgspec.json.encode(_Begun(meta=meta, done=done)), lasting=True)


def _finish(job: LatentsJob, meta: LatentsMeta, arrays: dict[str, Any]) -> None:
    target = torch.from_numpy(arrays["target"][: min(meta.clips, 64)].astype(np.float32))
    values = target.movedim(3, 0).flatten(1)  # [C, everything]
    meta = msgspec.structs.replace(
        meta,
        sensitivity=tuple(_sensitivity(job, target[:_SENSITIVITY_CLIPS, 0]).tolist()),
        mean=tuple(values.mean(1).tolist()),
        std=tuple(values.std(1).tolist()),
    )
    arrays.clear()
    for name in meta.shapes:
        unfinished = job.folder / f"{name}.npy.part"
        if unfinished.exists():
            unfinished.replace(job.folder / f"{name}.npy")
    write_whole(job.folder / "meta.json", msgspec.json.format(msgspec.json.encode(meta)), lasting=True)
    (job.folder / "clips.json").unlink()


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
