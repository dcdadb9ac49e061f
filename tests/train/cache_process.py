"""Caches the fake set into a folder, in a child that kills itself at the n-th time something settles on the disk."""

import multiprocessing
import os
import signal
from pathlib import Path

import torch
from cached_sets import CHOICE, FakePictures, tiny_identity

from gcd_train.data.cache_writer import CacheJob, cache_scenes
from gcd_train.data.latents import only_writer

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
    pictures = FakePictures()
    job = CacheJob(folder=folder, pictures=pictures, choice=CHOICE, identity=tiny_identity())
    with only_writer(folder):
        for _ in cache_scenes(job, pictures.scenes):
            pass
