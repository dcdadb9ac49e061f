"""Batches from samples of a data set: which samples, what each clip is told, and that a resumed run has the same."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
import torch
from torch.testing import assert_close

from gcd_model.conditioning import micro_conditioning, relative_pose_features, spherical_features
from gcd_model.config import SMALL, ModelConfig
from gcd_model.geometry import Intrinsics
from gcd_model.networks import Networks, random_networks
from gcd_model.weights.card import FAMILIES
from gcd_train.data.batches import SampleBatches, SampleLoader, SampleOrder
from gcd_train.data.files import Skips
from gcd_train.data.sample import Sample
from gcd_train.errors import DataError, RunError
from gcd_train.recipe import OptimiserRecipe, UNetRecipe
from gcd_train.recipe_data import Budget, LoaderRecipe
from gcd_train.training.setup import Conditioner, Draws, Precision

CPU = torch.device("cpu")
PRECISION = Precision(CPU, half=False, channels_last=False)
FRAMES, HEIGHT, WIDTH = 3, 16, 32
UNET = UNetRecipe(
    budget=Budget(updates=2), optimiser=OptimiserRecipe(rate=1e-3), source="pixels", augmentation=0.02, dropout=0.0
)
HERE = LoaderRecipe()


class CountedSamples:
    """Samples that show their own number."""

    def __init__(self, length: int = 7, broken: frozenset[int] = frozenset()) -> None:
        self.length, self.broken, self.skips = length, broken, Skips()

    def __len__(self) -> int:
        return self.length

    def sample(self, index: int) -> Sample:
        if index in self.broken:
            raise DataError(f"sample {index} is gone")
        picture = np.full((FRAMES, HEIGHT, WIDTH, 3), index % 256, np.uint8)
        deltas = np.linspace(0, 1, FRAMES)[:, None] * np.array([10.0 * (index % 9), 5.0, -1.0])
        poses = np.tile(np.eye(4), (FRAMES, 1, 1))
        poses[:, 0, 3] = index
        return Sample(
            source=picture,
            target=255 - picture,
            source_from_target=poses,
            deltas=deltas,
            fps=24.0 / (1 + index % 4),
            scene=f"scn{index % 3:05d}",
            frame_numbers=tuple(range(FRAMES)),
            lens=Intrinsics.from_hfov(53.13, WIDTH, HEIGHT),
        )


def config(camera: str = "spherical") -> ModelConfig:
    unet = msgspec.structs.replace(SMALL.unet, camera_width=0 if camera == "none" else 32)
    unet = msgspec.structs.replace(unet, width=16, multipliers=(1, 2), attention=(False, True), head_width=16)
    return msgspec.structs.replace(
        SMALL, frames=FRAMES, height=HEIGHT, width=WIDTH, camera=camera, unet=unet, image_encoder=SMALL.image_encoder
    )


@cache
def networks(camera: str = "spherical") -> Networks:
    return random_networks(config(camera), seed=1)


def batches(model: Networks, *, family: str = "kubric90", **changes: object) -> SampleBatches:
    recipe = msgspec.structs.replace(UNET, **changes)
    return SampleBatches(CountedSamples(), model, recipe, FAMILIES[family], PRECISION, HERE, 5)


def draws(number: int) -> Draws:
    return Draws(1, "unet", number, CPU)


# which samples


def test_a_round_takes_every_sample_once_and_the_next_round_others() -> None:
    order = SampleOrder(7, seed=3)
    first = [order.batch(number, 2) for number in range(7)]  # two rounds
    taken = [index for batch in first for index in batch]
    assert sorted(taken[:7]) == list(range(7))
    assert sorted(taken[7:]) == list(range(7, 14))
    assert [index - 7 for index in taken[7:]] != taken[:7]
    assert SampleOrder(7, seed=4).batch(0, 7) != SampleOrder(7, seed=3).batch(0, 7)


@pytest.mark.parametrize("numbers", [(0, 1, 2, 3), (4, 5), (2, 5, 8, 11), (3, 1, 2, 2), (20, 0, 4, 40)])
def test_whatever_was_asked_for_before_a_loader_gives_the_same_batch(numbers: tuple[int, ...]) -> None:
    loader = SampleLoader(CountedSamples(), 3, HERE)
    for number in numbers:
        loaded, numbers = loader.batch(number, 2)
        assert numbers == SampleOrder(7, seed=3).batch(number, 2)
        assert loaded.source[:, 0, 0, 0, 0].tolist() == numbers


@pytest.mark.parametrize(
    ("numbers", "turns", "parts"),
    [
        ((0, 1, 2, 3, 4), (0,), 1),
        ((6, 10, 12, 16), (0, 4), 6),  # of four processes that share six batches the first
        ((1, 1, 6, 6, 11, 11), (1, 1), 5),  # the second of four that share five: one that counts nothing
    ],
)
def test_batches_are_made_ahead_as_processes_share_them(
    numbers: tuple[int, ...], turns: tuple[int, ...], parts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    loader, started = SampleLoader(CountedSamples(), 3, HERE, turns, parts), list[int]()
    start = loader._start
    monkeypatch.setattr(loader, "_start", lambda number, count: (started.append(number), start(number, count)))
    for number in numbers:
        assert loader.batch(number, 2)[1] == SampleOrder(7, seed=3).batch(number, 2)
    assert started == [numbers[0]]


@pytest.mark.slow
def test_processes_give_the_batches_that_are_made_here() -> None:
    """Two spawned processes, batches in order and after a jump; what they cannot read ends as it does here."""
    there = SampleLoader(CountedSamples(), 3, LoaderRecipe(workers=2))
    here = SampleLoader(CountedSamples(), 3, HERE)
    for number in (0, 1, 2, 9, 11, 13):
        (one, numbers), (other, wanted) = there.batch(number, 2), here.batch(number, 2)
        assert numbers == wanted
        assert torch.equal(one.source, other.source)
        assert [sample.scene for sample in one.samples] == [sample.scene for sample in other.samples]
    broken = SampleLoader(CountedSamples(broken=frozenset(range(7))), 3, LoaderRecipe(workers=1))
    with pytest.raises(DataError, match=r"^sample \d is gone$"):
        broken.batch(0, 2)


def test_a_killed_process_is_told_with_what_to_do() -> None:
    loader = SampleLoader(CountedSamples(), 3, HERE)

    def killed() -> Iterator[object]:
        raise RuntimeError("DataLoader worker (pid 1) is killed by signal: Killed.")
        yield

    loader.batch(0, 2)
    loader._batches = killed()  # pyright: ignore
    with pytest.raises(RunError, match=r"data\.loader\.workers"):
        loader.batch(1, 2)


# what each clip is told


@pytest.mark.parametrize("camera", ["spherical", "relative_pose", "none"])
def test_each_clip_is_told_its_own_camera_rate_and_motion(camera: str) -> None:
    model = networks(camera)
    batch = batches(model).batch(draws(4), 3)
    numbers = SampleOrder(7, seed=5).batch(4, 3)
    samples = [CountedSamples().sample(number) for number in numbers]
    assert batch.target.shape == batch.condition.shape == (3 * FRAMES, 4, HEIGHT // 8, WIDTH // 8)
    assert batch.tokens is not None
    assert batch.tokens.shape[0] == 3 * FRAMES
    for clip, sample in enumerate(samples):
        rows = slice(clip * FRAMES, (clip + 1) * FRAMES)
        assert sample.deltas is not None
        motion = round(255 * np.hypot(*sample.deltas[-1, :2]) / np.hypot(90, 30))
        told = micro_conditioning(sample.fps, motion, 0.02, SMALL.unet.vector_width)
        assert_close(batch.vector[rows], told.expand(FRAMES, -1))
        if camera == "none":
            assert batch.camera is None
            continue
        assert batch.camera is not None
        wanted = spherical_features(torch.from_numpy(sample.deltas))
        if camera == "relative_pose":
            wanted = relative_pose_features(torch.from_numpy(sample.source_from_target))
        assert_close(batch.camera[rows], wanted)
    assert batch.ids == tuple(f"scn{number % 3:05d} (sample {number})" for number in numbers)
    assert batch.wait_s is not None


def test_the_same_number_is_the_same_batch_to_the_bit() -> None:
    model = networks()
    source = batches(model, dropout=0.5)
    for number in (3, 4, 5):
        batch = source.batch(draws(number), 2)
    again = batches(model, dropout=0.5).batch(draws(5), 2)
    for name in ("target", "condition", "vector", "tokens", "camera"):
        assert torch.equal(getattr(batch, name), getattr(again, name)), name


def test_the_network_sees_what_the_encoders_make_of_source_and_target() -> None:
    model = networks()
    batch = batches(model, augmentation=0.0).batch(draws(1), 1)
    sample = CountedSamples().sample(SampleOrder(7, seed=5).batch(1, 1)[0])
    pixels = torch.from_numpy(sample.source).permute(0, 3, 1, 2) / 127.5 - 1
    with torch.no_grad():
        assert_close(batch.condition, model.condition_encoder(pixels).mean, atol=1e-5, rtol=1e-4)
        posterior = model.target_encoder(-pixels)  # 255 - source
    spread = (0.5 * posterior.log_variance).exp()
    away = (batch.target / model.config.vae.scale - posterior.mean) / spread
    assert 0.8 < float(away.std()) < 1.2  # drawn from the posterior, not its mean


def test_what_samples_cannot_give_is_refused() -> None:
    other = random_networks(msgspec.structs.replace(config(), frames=4), seed=1)
    with pytest.raises(DataError, match=r"\[4, 16, 32\] for this model, got \[3, 16, 32\]"):
        batches(other).batch(draws(0), 1)
    with pytest.raises(DataError, match="not on a sphere"):
        Conditioner(config(), UNET, PRECISION).camera(replace(CountedSamples().sample(1), deltas=None).trajectory)
