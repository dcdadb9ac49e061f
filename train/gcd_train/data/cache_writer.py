"""Makes the latent cache, scene by scene, here or on many machines; a run that was killed goes on.

What a scene of 50 frames costs, both paths, K = 4: 713 encoder passes of 0.411 TFLOP and 49 of the image tower of 0.324
TFLOP (counted by torch on one 384 x 256 frame of the published shapes), 1.45 CPU hours (extrapolated from one frame).
The released trainer spends 16 TFLOP on them in every sample: its 13 000 updates of 24 clips are 5.0 EFLOP, the cache of
1 533 scenes 0.47.
"""

import logging
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
import torch
from torch import Tensor
from typer import Option

from gcd_model.config import SplatDepth
from gcd_model.engines.torch import arrange
from gcd_model.geometry import driving_trajectory
from gcd_model.live.eyes import estimated_depth
from gcd_model.loading import random_weights, weights_path
from gcd_model.weights.card import precision
from gcd_model.weights.load import load_weights
from gcd_train.data.cache import (
    CacheIdentity,
    CacheIndex,
    ClipPlan,
    FrozenEncoders,
    SceneShard,
    encoder_parts,
    encoders_digest,
    fault,
    log_variance_codes,
    read_index,
    write_index,
    write_shard,
)
from gcd_train.data.dataset4d import Dataset4D
from gcd_train.data.files import Skips
from gcd_train.data.parallel_domain4d import ParallelDomain4D
from gcd_train.data.paths import Draw
from gcd_train.data.pictures import PictureOptions, pictures_of, trained_picture
from gcd_train.data.sample import Sample, splat_of, to_network
from gcd_train.data.splits import Part, present, read_split
from gcd_train.errors import DataError, RecipeError, RunError
from gcd_train.files import only_writer
from gcd_train.parallel import Outcome, map_items
from gcd_train.training.losses import PARALLEL_DOMAIN_WEIGHTS, class_emphasis
from gcd_train.training.setup import Draws

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class CacheOptions:
    """Which encoders, run where and how, and what is cached: options of `gcd-train cache`."""

    weights: Annotated[
        str,
        Option(help="Checkpoint with the encoders: a path, package:NAME; random:driving, small ones, to try it out."),
    ]
    family: Annotated[str | None, Option(help="Family of the weights, where their file does not tell.")] = None
    device: Annotated[str, Option(help="auto, cpu, cuda or cuda:N.")] = "auto"
    dtype: Annotated[str, Option(help="Type the encoders run in: float32, bfloat16 or float16.")] = "float32"
    batch: Annotated[
        int, Option(min=1, help="Pictures in one call of the encoder; changes memory, not the latents.")
    ] = 2

    split: Annotated[Part | None, Option(help="Part of the set, needs --split-file; the whole set if left out.")] = None
    split_file: Annotated[Path | None, Option(help="JSON with the scenes of train, val and test.")] = None
    copies: Annotated[int, Option(min=1, help="Differently noised latents of every source frame.")] = 4
    path: Annotated[
        Literal["gradual", "direct", "both"],
        Option(help="Clips to encode for: the camera moves (gradual), or is there at once (direct)."),
    ] = "both"
    semantic: Annotated[bool, Option("--semantic", help="Targets show the classes instead of colour.")] = False
    splat: Annotated[SplatDepth, Option(help="Also the source's points from the target camera, see model.splat.")] = (
        "none"
    )
    exact: Annotated[bool, Option("--exact", help="Draw targets from geometry.npz, which generated scenes have.")] = (
        False
    )
    limit: Annotated[int | None, Option(min=1, help="Only the first so many scenes.")] = None
    seed: Annotated[int, Option(min=0, help="Seed of the pixel noise.")] = 0


@lru_cache(maxsize=1)
def load_encoders(choice: CacheOptions) -> tuple[FrozenEncoders, str]:
    """Load, freeze and place the encoders, and name their weights by a digest; a process does it once.

    Raises: CheckpointError, OptionError as `load_weights`; RecipeError where the device is not there.
    """
    kind, _, name = choice.weights.partition(":")
    loaded = (
        random_weights(name) if kind == "random" else load_weights(weights_path(choice.weights), family=choice.family)
    )
    networks, there = loaded.diffusion, torch.cuda.is_available()
    if choice.device.startswith("cuda") and not there:
        raise RecipeError(f"device {choice.device} was asked for and this machine has no CUDA device; use auto or cpu")
    device = torch.device(("cuda" if there else "cpu") if choice.device == "auto" else choice.device)
    digest = encoders_digest(networks)
    for module in encoder_parts(networks).values():
        module.to(device, precision(choice.dtype)).requires_grad_(False).eval()
        if device.type == "cpu":
            arrange(module)
    return FrozenEncoders(networks=networks, at_once=choice.batch), digest


class DrivingPictures:
    """The fixed driving path through a set in ParallelDomain-4D's layout, at the size the model takes.

    Source: the forward camera's own picture, cropped and resized. Targets: from the point clouds of all cameras, or
    exactly, see `PictureOptions`. clip_frames: T, which sets where on the path the positions
    lie. origin: names the set and how its pictures are made, wherever it lies.
    Source: Generative Camera Dolly, ParallelDomain-4D, as released.
    """

    def __init__(self, data: Dataset4D, clip_frames: int, options: PictureOptions) -> None:
        self.data, self._options = data, options
        self.scenes, self.fps = data.scenes, data.fps
        kind = "classes" if options.modality == "classes" else "colour"
        self.origin = f"parallel-domain-4d, {kind}, {'exact' if options.exact else 'points'}"
        path = driving_trajectory(frames=clip_frames, move_time=clip_frames - 1)
        self._source_from_target, self._pictures = path.source_from_target.numpy(), pictures_of(data, options)

    def frames(self, scene: str, /) -> int:
        """Time steps of a scene. Raises FileFault."""
        return self.data.frames(scene)

    def moment(self, scene: str, time: int, positions: Sequence[int], /) -> Sample:
        """A frame, whose files are read once, P times: the same source, targets of all positions. Raises FileFault."""
        world_from_source = self.data.pose(scene, self.data.source_camera, time)
        draw = Draw(
            frame_numbers=(time,) * len(positions),
            fps=self.data.fps,
            world_from_source=world_from_source,
            world_from_target=world_from_source @ self._source_from_target[list(positions)],
        )
        made = self._pictures.sample(scene, draw)
        if not self._options.exact:
            return made
        view = self.data.view(scene, self.data.source_camera, time)
        source = trained_picture(view.rgb, *self._options.size)
        return replace(made, source=np.repeat(source[None], len(made.target), axis=0))


def encode_scene(
    encoders: FrozenEncoders, pictures: DrivingPictures, identity: CacheIdentity, scene: str
) -> tuple[dict[str, Tensor], dict[int, str]]:
    """The tensors of a scene's shard: everything its clips need; and why frames that cannot be had are left out.

    Raises: DataError if no frame can be had, or the encoders give what float16 does not hold.
    """
    frames = pictures.frames(scene)
    positions: dict[int, list[int]] = defaultdict(list)
    for moment, position in identity.plan.pairs(frames, range(frames)):
        positions[moment].append(position)
    if not positions:
        raise DataError(f"{scene}: {frames} frames are too few for a clip; generate or download it whole")
    rows: dict[str, list[Tensor]] = defaultdict(list)
    times: list[int] = []
    missing: dict[int, str] = {}
    for moment, wanted in sorted(positions.items()):
        try:
            sample = pictures.moment(scene, moment, wanted)
        except DataError as error:
            missing[moment] = str(error)
            continue
        if {sample.source.shape[1:3], sample.target.shape[1:3]} != {(identity.height, identity.width)}:
            wants = f"{identity.height} x {identity.width}"
            raise DataError(f"{scene}: pictures must be {wants} for these weights, got {sample.target.shape}")
        for name, values in encode_moment(encoders, identity, sample, f"{scene}/{moment}").items():
            rows[name].append(values)
        times.append(moment)
    if not times:
        raise DataError(f"{scene}: none of {len(positions)} frames can be read, first: {next(iter(missing.values()))}")
    tensors = {name: torch.cat(parts).contiguous() for name, parts in rows.items()}
    for name, values in tensors.items():
        if not bool(values.isfinite().all()):
            raise DataError(f"{scene}: {name} does not fit float16; give --dtype float32, or look at the weights")
    pairs = [(moment, position) for moment in times for position in positions[moment]]
    made = {"times": torch.tensor(times, dtype=torch.int16), "pairs": torch.tensor(pairs, dtype=torch.int16)}
    return tensors | made, missing


@torch.no_grad()
def encode_moment(encoders: FrozenEncoders, identity: CacheIdentity, sample: Sample, name: str) -> dict[str, Tensor]:
    """The rows of one frame: source [1, ...], targets [P, ...]. name: of the frame, what its noise follows from."""
    sources, targets = to_network(sample.source), to_network(sample.target)
    source = sources[:1]
    draws = Draws(identity.seed, f"latent cache/{name}", 0, torch.device("cpu"))
    noise = draws.normal(identity.copies, *source.shape[1:])
    posterior = encoders.target(targets)
    rows = {
        "source": encoders.condition(source + identity.augmentation * noise)[None].half(),
        "target_mean": posterior.mean.half(),
        "target_log_variance": log_variance_codes(posterior.log_variance),
    }
    tokens = encoders.tokens(source)
    if tokens is not None:
        rows["tokens"] = tokens.half()
    if identity.splat == "estimated":  # of the one source picture, not of each copy
        metres = estimated_depth(source, sample.lens).numpy()
        sample = replace(sample, source_depth=np.repeat(metres, len(sources), axis=0))
    splat = encoders.splat(splat_of(sample, sources, "none" if identity.splat == "none" else "given"))
    if splat is not None:
        rows["splat"] = splat.half()
    if identity.emphasis:
        size = (posterior.mean.shape[-2], posterior.mean.shape[-1])
        rows["emphasis"] = class_emphasis(targets, PARALLEL_DOMAIN_WEIGHTS, size).half()
    return {name: values.cpu() for name, values in rows.items()}


@dataclass(frozen=True, kw_only=True, slots=True)
class CacheJob:
    """One scene's work, as a worker gets it."""

    folder: Path
    pictures: DrivingPictures
    choice: CacheOptions
    identity: CacheIdentity

    def __call__(self, scene: str) -> SceneShard:
        """Encode a scene and write its shard. Raises TrainError."""
        encoders, digest = load_encoders(self.choice)
        if digest != self.identity.encoders:
            raise RunError(
                f"{self.choice.weights} holds encoders {digest} on this machine, {self.identity.encoders} "
                "where the run was started; copy the same file there"
            )
        started = time.perf_counter()
        tensors, missing = encode_scene(encoders, self.pictures, self.identity, scene)
        return write_shard(
            self.folder,
            scene,
            tensors,
            SceneShard,
            frames=self.pictures.frames(scene),
            times=tuple(tensors["times"].tolist()),
            missing={str(moment): reason for moment, reason in missing.items()},
            seconds=round(time.perf_counter() - started, 3),
        )


def cache_job(data: Path, out: Path, options: CacheOptions) -> CacheJob:
    """What is to be done; its pixel noise is as strong as the checkpoint is sampled with.

    Raises: DataError where there are no such scenes; RecipeError, CheckpointError for options that do not fit.
    """
    if (options.split is None) != (options.split_file is None):
        raise RecipeError("a part of the set is named with both --split and --split-file; give both or neither")
    encoders, digest = load_encoders(options)
    config, whole = encoders.networks.config, ParallelDomain4D(data, classes=options.semantic)
    scenes = whole.scenes
    if options.split_file is not None and options.split is not None:
        scenes = present(read_split(options.split_file, options.split), scenes, Skips(), options.split_file)
    plan = ClipPlan(
        clip_frames=config.frames, paths=("gradual", "direct") if options.path == "both" else (options.path,)
    )
    modality = "classes" if options.semantic else "rgb"
    drawn = PictureOptions(
        size=(config.width, config.height), modality=modality, depth=options.splat == "given", exact=options.exact
    )
    pictures = DrivingPictures(whole.only(scenes[: options.limit]), config.frames, drawn)
    identity = CacheIdentity(
        encoders=digest,
        dtype=options.dtype,
        pictures=pictures.origin,
        fps=pictures.fps,
        plan=plan,
        copies=options.copies,
        augmentation=config.sampling.augmentation,
        seed=options.seed,
        height=config.height,
        width=config.width,
        scale=config.vae.scale,
        emphasis=options.semantic,
        splat=options.splat,
    )
    return CacheJob(folder=out, pictures=pictures, choice=options, identity=identity)


def cache_scenes(
    job: CacheJob, *, workers: int = 1, ray_address: str | None = None
) -> Iterator[Outcome[str, SceneShard]]:
    """What becomes of every scene: its shard, which is in the index then, or its error; those that are there first.

    A damaged shard is made anew. workers, ray_address: see `map_items`.
    Raises: RunError if another run writes there, or the folder holds another cache, naming what differs.
    """
    with only_writer(job.folder):
        index = read_index(job.folder, CacheIndex) or CacheIndex(identity=job.identity)
        there, wanted = (msgspec.structs.asdict(identity) for identity in (index.identity, job.identity))
        differs = [f"{name} {there[name]!r}, now {wanted[name]!r}" for name in there if there[name] != wanted[name]]
        if differs:
            said = f"{job.folder} was cached with {'; '.join(differs)}"
            raise RunError(f"{said}: choose another --out, or delete the folder")
        faults = {scene: fault(job.folder, entry) for scene, entry in index.scenes.items()}
        for reason in filter(None, faults.values()):
            _log.warning("made anew: %s", reason)
        scenes = {scene: entry for scene, entry in index.scenes.items() if faults[scene] is None}
        write_index(job.folder, msgspec.structs.replace(index, scenes=scenes))
        missing = [scene for scene in job.pictures.scenes if scene not in scenes]
        yield from (Outcome(item=scene, value=scenes[scene]) for scene in job.pictures.scenes if scene in scenes)
        for outcome in map_items(job, missing, workers=workers, ray_address=ray_address):
            if outcome.value is not None:
                scenes = dict(sorted({**scenes, outcome.item: outcome.value}.items()))
                write_index(job.folder, msgspec.structs.replace(index, scenes=scenes))
            yield outcome
