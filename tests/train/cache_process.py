"""Caches the fake set into a folder; told to, it kills itself at the n-th time something settles on the disk.

python cache_process.py FOLDER KILL_AT [KILL_AT ...]      each in a child of its own, in FOLDER/KILL_AT; 0: never
"""

import os
import signal
import sys
from pathlib import Path

import torch
from cached_sets import CHOICE, FakePictures, tiny_identity

from gcd_train.latent_cache import CacheJob, cache_scenes, only_writer

RENAME = Path.replace


def run(folder: Path, kill_at: int) -> None:
    settled = 0

    def replace(self: Path, target: Path) -> Path:
        """Odd numbers die before a file appears, even ones right after."""
        nonlocal settled
        settled += 1
        if kill_at and 2 * settled - 1 == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)
        moved = RENAME(self, target)
        if kill_at and 2 * settled == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)
        return moved

    Path.replace = replace  # type: ignore[method-assign]
    pictures = FakePictures()
    job = CacheJob(folder=folder, pictures=pictures, choice=CHOICE, identity=tiny_identity())
    with only_writer(folder):
        for _ in cache_scenes(job, pictures.scenes):
            pass


def main() -> None:
    torch.set_num_threads(1)
    tiny_identity()  # the networks, once for all children
    for kill_at in map(int, sys.argv[2:]):
        child = os.fork()
        if child == 0:
            run(Path(sys.argv[1]) / str(kill_at), kill_at)
            os._exit(0)
        _, status = os.waitpid(child, 0)
        print(kill_at, "killed" if os.WIFSIGNALED(status) else "ended", flush=True)


if __name__ == "__main__":
    main()
