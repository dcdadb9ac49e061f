"""Batches of the diffusion objective: from a run's own latents, from samples of a data set, or from a latent cache.

Each clip has its own camera, rate and motion. From samples, the frozen networks run on every batch: with fresh
augmentation noise, and targets drawn from their posterior. From latents and a cache they never run.
"""

import signal
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count as counting
from itertools import islice
from multiprocessing import get_context

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from gcd_model.config import ModelConfig
from gcd_model.networks import Networks
from gcd_model.weights.card import Family
from gcd_train.data.cache import CachedLatents, ClipPlace, EncodedRows, FrozenEncoders, PathKind, encoders_digest
from gcd_train.data.latents import LatentClips
from gcd_train.data.sample import Sample, SampleBatch, Samples, collate, splat_of, to_network
from gcd_train.errors import DataError, RecipeError, RunError, TrainError
from gcd_train.parallel import one_thread_each
from gcd_train.recipe import UNetRecipe
from gcd_train.recipe_data import LoaderRecipe
from gcd_train.training.losses import COLOUR_WEIGHTS, class_emphasis
from gcd_train.training.objective import Batch, BatchSource, drop_streams
from gcd_train.training.setup import Conditioner, Draws, Precision


@torch.no_grad()
def encode_frames(
    networks: Networks, recipe: UNetRecipe, source: Tensor, target: Tensor, draws: Draws, splats: Tensor | None = None
) -> EncodedRows:
    """What the frozen networks make of frames [N, 3, H, W] in [-1, 1]. splats: see `splat_of`.

    The augmentation is noise on the pixels that the condition encoder sees, and on nothing else; the image tower sees
    clean frames, and a splat is clean. Source: Generative Camera Dolly, as released.
    """
    encoders = FrozenEncoders(networks=networks)
    noisy = source + recipe.augmentation * draws.normal(*source.shape)
    posterior = encoders.target(target)
    latents = posterior.sample(draws.normal(*posterior.mean.shape)) * networks.config.vae.scale
    by_colour, size = COLOUR_WEIGHTS[recipe.loss.class_weights], (latents.shape[-2], latents.shape[-1])
    return EncodedRows(
        source=encoders.condition(noisy),
        target=latents,
        tokens=encoders.tokens(source),
        emphasis=class_emphasis(target, by_colour, size) if by_colour else None,
        splat=encoders.splat(splats),
    )


class Batches(BatchSource):
    """What all batches have in common: what the network is told of their clips."""

    def __init__(
        self, config: ModelConfig, recipe: UNetRecipe, precision: Precision, family: Family | None = None
    ) -> None:
        self._config, self._recipe, self._precision = config, recipe, precision
        self._conditioner = Conditioner(config, recipe, precision, family)

    def _together(
        self,
        rows: EncodedRows,
        fps: Sequence[float],
        motion: Tensor,
        ids: Sequence[str],
        draws: Draws,
        wait_s: float | None = None,
    ) -> Batch:
        """B clips, with what the network is told of them. fps, motion, ids: of each."""
        device, per_clip = self._precision.device, len(rows.source) // len(fps)
        source = self._precision.frames(rows.source if rows.splat is None else torch.cat([rows.source, rows.splat], 1))
        tokens = None if rows.tokens is None else rows.tokens.to(device)
        condition, tokens = drop_streams(source, tokens, per_clip, draws, self._recipe)
        return Batch(
            target=self._precision.frames(rows.target),
            condition=condition,
            vector=self._conditioner.vector(torch.tensor(fps), motion).repeat_interleave(per_clip, dim=0),
            tokens=tokens,
            emphasis=None if rows.emphasis is None else rows.emphasis.to(device),
            frames=per_clip,
            camera=None if rows.camera is None else rows.camera.to(device),
            ids=tuple(ids),
            wait_s=wait_s,
        )


class EncodedBatches(Batches):
    """Batches of what the latents stage wrote."""

    def __init__(self, clips: LatentClips, config: ModelConfig, recipe: UNetRecipe, precision: Precision) -> None:
        super().__init__(config, recipe, precision)
        self._clips = clips

    def batch(self, draws: Draws, count: int, *, single: bool = False) -> Batch:
        """See BatchSource."""
        meta = self._clips.meta
        clips = draws.below(meta.clips, count)
        frames = draws.below(meta.frames, count) if single else torch.arange(meta.frames).repeat(count)
        per_clip = 1 if single else meta.frames
        flip = draws.below(meta.flips, count).bool()
        rows = self._clips.rows(
            clips.repeat_interleave(per_clip), frames, flip.repeat_interleave(per_clip), self._precision.device
        )
        assert rows.motion is not None
        names = [f"clip {meta.seeds[number]}" for number in clips.tolist()]
        return self._together(rows, [self._recipe.fps] * count, rows.motion[::per_clip], names, draws)


@dataclass(slots=True)
class SampleOrder:
    """Which samples a batch takes: of all samples in an order shuffled by the seed, then of all again in another.

    Batch n of `count` clips takes the places n * count and on, so a batch follows from its number alone.
    """

    length: int
    seed: int
    _round: int = -1
    _places: Sequence[int] = ()

    def batch(self, number: int, count: int) -> list[int]:
        """Numbers of the samples."""
        return [self._at(place) for place in range(number * count, (number + 1) * count)]

    def _at(self, place: int) -> int:
        round_, within = divmod(place, self.length)
        if round_ != self._round:
            self._round = round_
            self._places = np.random.default_rng((self.seed, round_)).permutation(self.length).tolist()
        return round_ * self.length + self._places[within]


class SampleLoader:
    """Batches by number; those that follow are made ahead.

    turns, parts: of an update's `parts` batches this process computes those of these numbers, see `Processes.batches`.
    Worker processes are spawned, not forked: a fork would share OpenGL's and torch's state.
    """

    def __init__(
        self, samples: Samples, seed: int, recipe: LoaderRecipe, turns: Sequence[int] = (0,), parts: int = 1
    ) -> None:
        self._samples, self._recipe, self._turns, self._parts = samples, recipe, turns, parts
        self._order = SampleOrder(len(samples), seed)
        self._count = 0
        self._expected: Iterator[int] = iter(())
        self._batches: Iterator[SampleBatch | TrainError] = iter(())

    def batch(self, number: int, count: int) -> tuple[SampleBatch, list[int]]:
        """Batch `number` of `count` samples, and their numbers.

        Raises: as `Samples.sample`; RunError if a process was killed.
        """
        if count != self._count or number != next(self._expected):
            self._start(number, count)
        batch = self._following()
        if self._recipe.workers:  # each worker has its own account
            self._samples.skips.extend(skipped for sample in batch.samples for skipped in sample.skipped)
        return batch, self._order.batch(number, count)

    def _following(self) -> SampleBatch:
        try:
            samples = next(self._batches)
        except RuntimeError as error:  # what torch makes of a process that is gone
            raise RunError(
                f"a process that makes samples was killed, most likely for want of memory ({error}); give fewer "
                "data.loader.workers, or more room in /dev/shm, and run again"
            ) from error
        if isinstance(samples, TrainError):
            raise samples
        return samples

    def _start(self, number: int, count: int) -> None:
        """From this number on, in this process's turns."""
        self._count = count
        self._expected, numbers = islice(self._from(number), 1, None), self._from(number)
        if self._recipe.workers:
            self._batches = iter(self._loader(numbers))
        else:
            ahead = (self._order.batch(each, count) for each in numbers)
            self._batches = (collate([self._samples.sample(index) for index in batch]) for batch in ahead)

    def _from(self, number: int) -> Iterator[int]:
        update, part = divmod(number, self._parts)
        first = self._turns.index(part) if part in self._turns else 0
        yield from (update * self._parts + turn for turn in self._turns[first:])
        for later in counting(update + 1):
            yield from (later * self._parts + turn for turn in self._turns)

    def _loader(self, numbers: Iterator[int]) -> DataLoader[Sample | TrainError]:
        recipe, size = self._recipe, self._count
        order = SampleOrder(self._order.length, self._order.seed)  # read ahead, so not the one that is looked up
        return DataLoader(
            _Numbered(self._samples),
            batch_sampler=(order.batch(number, size) for number in numbers),
            num_workers=recipe.workers,
            collate_fn=_collated,
            pin_memory=torch.cuda.is_available(),
            multiprocessing_context=get_context("spawn"),
            worker_init_fn=_settle,
        )


class _Numbered(Dataset[Sample | TrainError]):
    """Samples as torch's loader takes them; an error is handed over as it is, torch would bury it in a trace."""

    def __init__(self, samples: Samples) -> None:
        self._samples = samples

    def __getitem__(self, index: int) -> Sample | TrainError:
        try:
            return self._samples.sample(index)
        except TrainError as error:
            return error


def _collated(samples: list[Sample | TrainError]) -> SampleBatch | TrainError:
    failed = [sample for sample in samples if isinstance(sample, TrainError)]
    return failed[0] if failed else collate([sample for sample in samples if isinstance(sample, Sample)])


def _settle(_worker: int) -> None:
    """In a new process: one thread; Ctrl-C is for the main process, which finishes its update and saves."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    one_thread_each()
    cv2.setNumThreads(1)


class SampleBatches(Batches):
    """Batches of whole clips. Batch n, by `Draws.number`, always has the same samples.

    samples: `ViewPairs`, `LeRobotPairs`, or a set of clips. family: says what the network is told of a camera's way.
    turns: see `SampleLoader`.
    """

    def __init__(
        self,
        samples: Samples,
        networks: Networks,
        recipe: UNetRecipe,
        family: Family,
        precision: Precision,
        loader: LoaderRecipe = LoaderRecipe(),  # noqa: B008  it is frozen
        seed: int = 0,
        turns: Sequence[int] = (0,),
    ) -> None:
        super().__init__(networks.config, recipe, precision, family)
        self._networks, self._loader = networks, SampleLoader(samples, seed, loader, turns, recipe.parts)

    def batch(self, draws: Draws, count: int, *, single: bool = False) -> Batch:
        """See BatchSource. Raises DataError if samples cannot be read or do not fit the model."""
        assert not single, "the recipe refuses it"
        started, config, recipe = time.perf_counter(), self._config, self._recipe
        loaded, numbers = self._loader.batch(draws.number, count)
        wait_s = time.perf_counter() - started
        given, wanted = list(loaded.source.shape[1:4]), [config.frames, config.height, config.width]
        if given != wanted:
            raise DataError(f"samples must be T, H, W = {wanted} for this model, got {given}")
        device, conditioner = self._precision.device, self._conditioner
        source, target = (
            self._precision.frames(to_network(clips.to(device, non_blocking=True).flatten(0, 1)))
            for clips in (loaded.source, loaded.target)
        )
        clips = zip(loaded.samples, source.split(config.frames), strict=True)
        splats = [each for sample, video in clips if (each := splat_of(sample, video, config.splat)) is not None]
        rows = encode_frames(self._networks, recipe, source, target, draws, torch.cat(splats) if splats else None)
        paths = [sample.trajectory for sample in loaded.samples]
        cameras = [camera for path in paths if (camera := conditioner.camera(path)) is not None]
        motion = [recipe.motion_bucket if path.delta is None else conditioner.motion(path) for path in paths]
        names = [f"{s.scene} (sample {number})" for s, number in zip(loaded.samples, numbers, strict=True)]
        rows = replace(rows, camera=torch.cat(cameras) if cameras else None)
        return self._together(rows, [s.fps for s in loaded.samples], torch.tensor(motion), names, draws, wait_s)


class CachedBatches(Batches):
    """Batches of whole clips: noise copy of every frame, posterior sample and dropout drawn anew each time.

    The frame rate of a clip is its own, after the stride; the recipe's `fps` is not used.
    Raises RecipeError unless the cache was made with these networks' encoders.
    """

    def __init__(
        self, cache: CachedLatents, networks: Networks, recipe: UNetRecipe, precision: Precision, path: PathKind
    ) -> None:
        super().__init__(networks.config, recipe, precision)
        kept, given = cache.index.identity.encoders, encoders_digest(networks)
        if kept != given:
            raise RecipeError(
                f"{cache.folder} was made with other encoders ({kept}) than the run's ({given}); give the same "
                "model.weights, or make the cache anew"
            )
        self._cache = cache
        self._path: PathKind = path

    def batch(self, draws: Draws, count: int, *, single: bool = False) -> Batch:
        """See BatchSource."""
        assert not single, "the recipe refuses it"
        started, on_cpu = time.perf_counter(), Draws(int(draws.below(2**31, 1)), "latent cache", 0, torch.device("cpu"))
        places, clips = list[tuple[str, ClipPlace]](), list[EncodedRows]()
        for _ in range(count):
            places.append(self._cache.drawn_place(on_cpu))
            clips.append(self._cache.clip(*places[-1], self._path, on_cpu))
        wait_s, by_class = time.perf_counter() - started, self._recipe.loss.class_weights != "none"
        tokens = [clip.tokens for clip in clips if clip.tokens is not None]
        emphasis = [clip.emphasis for clip in clips if clip.emphasis is not None]
        splats = [clip.splat for clip in clips if clip.splat is not None]
        rows = EncodedRows(
            source=torch.cat([clip.source for clip in clips]),
            target=torch.cat([clip.target for clip in clips]),
            tokens=torch.cat(tokens) if tokens else None,
            emphasis=torch.cat(emphasis) if emphasis and by_class else None,
            splat=torch.cat(splats) if splats else None,
        )
        fps = [self._cache.index.identity.fps / place.stride for _, place in places]
        names = [f"{scene} from {place.start} by {place.stride}" for scene, place in places]
        return self._together(rows, fps, torch.full((count,), self._recipe.motion_bucket), names, draws, wait_s)
