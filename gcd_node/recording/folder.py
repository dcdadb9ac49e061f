"""Where recordings go: names that sort by time and are never taken twice, and how much room is left."""

import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from gcd_node.config import RecordConfig

_MB = 10**6
SUFFIX = ".mcap"


class LimitReachedError(Exception):
    """A recording must end before it takes more room than it may. code: stable, of the event."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


def new_folder(root: Path, node_id: str, boot_id: str) -> Path:
    """A folder for one recording, such as `20261121T184000Z_gcd_1a2b3c4d`. Raises OSError."""
    name = f"{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}_{node_id}_{boot_id[:8]}"
    for count in range(1, 1000):
        folder = root / (name if count == 1 else f"{name}_{count}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        return folder
    raise FileExistsError(f"{root / name} and 999 more are taken")


def part_path(folder: Path, part: int) -> Path:
    """The file of one part, counted from 0, as rosbag2 names them."""
    return folder / f"{folder.name}_{part:04d}{SUFFIX}"


@dataclass(frozen=True, kw_only=True, slots=True)
class Limits:
    """How much room a recording may take. others: bytes of other recordings in `root` when it began."""

    root: Path
    config: RecordConfig
    others: int

    def check(self, own: int) -> None:
        """own: bytes of this recording so far. Raises LimitReachedError, OSError."""
        most_mb, keep_mb = self.config.max_total_mb, self.config.keep_free_mb
        if most_mb and self.others + own > most_mb * _MB:
            taken_mb = (self.others + own) / _MB
            raise LimitReachedError(
                "TOTAL_LIMIT",
                f"recordings in {self.root} take {taken_mb:.0f} MB, max_total_mb is {most_mb:g}: move some away",
            )
        disk = os.statvfs(self.root)
        free_mb = disk.f_bavail * disk.f_frsize / _MB
        if free_mb < keep_mb:
            raise LimitReachedError(
                "DISK_LOW",
                f"the disk of {self.root} has {free_mb:.0f} MB left, keep_free_mb is {keep_mb:g}: make room on it",
            )


def limits_of(root: Path, config: RecordConfig) -> Limits:
    """What holds for a recording that begins now. Raises OSError."""
    found = root.rglob(f"*{SUFFIX}") if config.max_total_mb else ()
    return Limits(root=root, config=config, others=sum(each.stat().st_size for each in found))


def check_folder(root: Path, config: RecordConfig) -> float:
    """Whether a recording could begin: makes the folder if there is none, and writes a file that is gone at once.

    Returns:
        MB that are free on its disk.
    Raises:
        LimitReachedError, OSError.
    """
    root.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=root) as file:
        file.write(b"\0")
    limits_of(root, config).check(0)
    disk = os.statvfs(root)
    return disk.f_bavail * disk.f_frsize / _MB


def is_due(config: RecordConfig, size: int, age_s: float) -> bool:
    """Whether a file of `size` bytes that is `age_s` old is to be followed by another."""
    too_large = config.rotate_mb > 0 and size >= config.rotate_mb * _MB
    return too_large or (config.rotate_s > 0 and age_s >= config.rotate_s)
