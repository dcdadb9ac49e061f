"""Where a run comes from: programs, machine, weights and recording, each by a name or a digest."""

import hashlib
import platform
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

import cv2
import kornia
import numpy as np
import torch

from gcd_model import Traits
from gcd_node.config import SourceConfig
from gcd_node.errors import SourceError
from gcd_node.frame import SourceInfo
from gcd_node.replay.manifest import MachineEntry, SourceEntry, WeightsEntry
from gcd_node.sources import resolve_path

_PIECE = 1 << 20


def versions() -> dict[str, str]:
    """Of Python and of the packages that take part in a replay."""
    return {
        "gcd-node": version("gcd-node"),
        "python": platform.python_version(),
        "torch": str(torch.__version__),
        "kornia": kornia.__version__,
        "opencv": cv2.__version__,
        "numpy": np.__version__,
    }


def machine(device: str, threads: int) -> MachineEntry:
    """This machine as a run on `device` with so many CPU threads sees it."""
    return MachineEntry(
        system=f"{platform.system()} {platform.machine()}",
        device=device,
        processor=_processor(device),
        instructions=torch.backends.cpu.get_cpu_capability(),
        threads=threads,
    )


def weights(traits: Traits) -> WeightsEntry:
    """The model of a run."""
    return WeightsEntry(
        name=traits.name,
        family="unknown" if traits.family is None else traits.family.name,
        sha256_12=traits.sha256_12,
        precision=traits.precision,
        trained=traits.trained,
    )


def source(section: SourceConfig, info: SourceInfo) -> SourceEntry:
    """The recording of a run. Raises SourceError if it cannot be read any more."""
    return SourceEntry(
        kind=info.kind,
        id=info.id,
        width=info.width,
        height=info.height,
        fps=info.fps_nominal,
        codec=info.codec,
        sha256=None if section.path is None else digest_of(resolve_path(section.path)),
        calibration_sha256=None if section.calibration is None else digest_of(Path(section.calibration).expanduser()),
    )


def digest_of(path: Path) -> str:
    """SHA-256 of a file, 64 hex digits; of a folder, over the names and contents of all files in it, by name.

    Raises:
        SourceError: it cannot be read.
    """
    total = hashlib.sha256()
    try:
        if not path.is_dir():
            for piece in _pieces(path):
                total.update(piece)
            return total.hexdigest()
        for file in sorted(each for each in path.rglob("*") if each.is_file()):
            total.update(file.relative_to(path).as_posix().encode() + b"\0")
            total.update(bytes.fromhex(digest_of(file)))
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror}; is it still there?") from error
    return total.hexdigest()


def _pieces(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while piece := file.read(_PIECE):
            yield piece


def _processor(device: str) -> str:
    if device.startswith("cuda"):
        return torch.cuda.get_device_name(device)
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or "unknown")
