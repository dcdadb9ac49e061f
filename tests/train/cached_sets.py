"""A driving set small enough to cache in a blink: three scenes of seven frames, clips of three."""

import multiprocessing
import os
import signal
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from gcd_model.geometry import Intrinsics, driving_trajectory
from gcd_train.data.cache import CacheIdentity, ClipPlan, FrozenEncoders, SceneShard
from gcd_train.data.cache_writer import CacheJob, CacheOptions, cache_scenes, load_encoders
from gcd_train.data.sample import Sample
from gcd_train.errors import DataError
from gcd_train.parallel import Outcome

HEIGHT, WIDTH, FRAMES, CLIP = 32, 48, 7, 3
PLAN = ClipPlan(clip_frames=CLIP)
CHOICE = CacheOptions(weights="random:driving", device="cpu", batch=8)


@dataclass(frozen=True)
class FakePictures:
    """Flat colours that say scene, frame and position. broken: (scene, frame) that cannot be read."""

    scenes: tuple[str, ...] = tuple(f"scene_{number:06d}" for number in range(3))
    broken: frozenset[tuple[str, int]] = frozenset()
    origin: str = "fake"
    fps: float = 10.0
    length: int = FRAMES

    def frames(self, scene: str, /) -> int:
        return self.length

    def moment(self, scene: str, time: int, positions: tuple[int, ...], /) -> Sample:
        if (scene, time) in self.broken:
            raise DataError(f"{scene}/rgb/yaw-0/{time}.png is cut")
        shade = 20 * self.scenes.index(scene) + 10 * time
        path = driving_trajectory(frames=CLIP, move_time=CLIP - 1).source_from_target[list(positions)]
        return Sample(
            source=np.stack([_picture(shade, 0)] * len(positions)),
            target=np.stack([_picture(shade, 1 + position) for position in positions]),
            source_from_target=path.numpy(),
            fps=self.fps,
            scene=scene,
            frame_numbers=(time,) * len(positions),
            lens=Intrinsics.from_hfov(85.0, WIDTH, HEIGHT),
            source_depth=np.full((len(positions), HEIGHT, WIDTH), 5.0 + time, np.float32),
        )


def _picture(shade: int, hue: int) -> np.ndarray:
    picture = np.full((HEIGHT, WIDTH, 3), shade, np.uint8)
    picture[:, : WIDTH // 2, 1] = 30 * hue
    return picture


def tiny_encoders() -> FrozenEncoders:
    return load_encoders(CHOICE)[0]


def tiny_identity(**changes: object) -> CacheIdentity:
    told: dict[str, object] = {
        "encoders": load_encoders(CHOICE)[1],
        "dtype": "float32",
        "pictures": "fake",
        "fps": 10.0,
        "plan": PLAN,
        "copies": 2,
        "augmentation": 0.02,
        "seed": 5,
        "height": HEIGHT,
        "width": WIDTH,
        "scale": 0.18215,
    }
    return CacheIdentity(**(told | changes))


def cached(folder: Path, pictures: FakePictures | None = None, **identity: object) -> list[Outcome[str, SceneShard]]:
    """Make the cache of a set; what became of each scene."""
    pictures = pictures or FakePictures()
    job = CacheJob(folder=folder, pictures=pictures, choice=CHOICE, identity=tiny_identity(**identity))  # pyright: ignore[reportArgumentType]
    return list(cache_scenes(job))


# a child that kills itself at the n-th time something settles on the disk

RENAME = Path.replace
_HANG_S = 100


def killed_run(folder: Path, kill_at: int) -> int | None:
    """How the child ended: -9 if it was killed. Odd numbers kill before a file appears, even ones right after."""
    tiny_identity()  # the networks are loaded here; a fork has them
    child = multiprocessing.get_context("fork").Process(target=_run, args=(folder, kill_at))
    child.start()
    child.join(_HANG_S)
    if child.exitcode is None:
        child.kill()
    return child.exitcode


def _run(folder: Path, kill_at: int) -> None:
    torch.set_num_threads(1)  # the parent's other threads are not here
    settled = 0

    def replace(self: Path, target: Path) -> Path:
        nonlocal settled
        settled += 1
        if 2 * settled - 1 == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)
        moved = RENAME(self, target)
        if 2 * settled == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)
        return moved

    Path.replace = replace  # type: ignore[method-assign]
    cached(folder)
