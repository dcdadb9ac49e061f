"""What could not be read and was left out: counted and named, so that no fault in the data is silent or fatal."""

import logging
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from gcd_train.errors import DataError

_LOG = logging.getLogger(__name__)
_DISTINCT, _SHOWN = 10_000, 20


class FileFault(DataError):  # noqa: N818  a fault of the data, which readers of it name
    """A file of a data set is missing, damaged or does not fit the others. path: which; reason: what is wrong."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{path} {reason}")
        self.path, self.reason = path, reason

    def __reduce__(self) -> tuple[type["FileFault"], tuple[Path, str]]:
        return FileFault, (self.path, self.reason)  # a fault crosses from loader workers to the main process


@dataclass(frozen=True, kw_only=True, slots=True)
class Skipped:
    """One thing left out. scene: its name. file: the file at fault, or the scene's folder. reason: what is wrong."""

    scene: str
    file: str
    reason: str

    def __str__(self) -> str:
        return f"{self.scene}: {self.file} {self.reason}"


class Skips:
    """Everything left out so far. Each distinct one is logged once, as a warning, unless `logged` is false.

    A loader worker has its own; `Sample.skipped` carries what it left out, for `extend` in the main process.
    """

    def __init__(self, *, logged: bool = True) -> None:
        self._logged = logged
        self._counts: Counter[Skipped] = Counter()
        self._beyond = 0

    def add(self, scene: str, file: Path | str, reason: str) -> Skipped:
        """Count one and return it."""
        skipped = Skipped(scene=scene, file=str(file), reason=reason)
        self.extend([skipped])
        return skipped

    def extend(self, others: Iterable[Skipped]) -> None:
        """Count what was left out elsewhere."""
        for skipped in others:
            if skipped not in self._counts and len(self._counts) >= _DISTINCT:
                self._beyond += 1  # a set in which everything is wrong must not fill the memory
                continue
            self._counts[skipped] += 1
            if self._logged and self._counts[skipped] == 1:
                _LOG.warning("left out %s", skipped)

    @property
    def total(self) -> int:
        """How often something was left out."""
        return self._counts.total() + self._beyond

    def plain_lines(self, most: int = _SHOWN) -> list[str]:
        """The first ones, a line each, and how many more there are."""
        rest = len(self._counts) - most
        return [*map(str, list(self._counts)[:most]), *([f"and {rest} more"] if rest > 0 else [])]

    def lines(self, most: int = _SHOWN) -> list[str]:
        """A short account to print, the most frequent first; empty if nothing was left out."""
        if not self.total:
            return []
        shown, scenes = self._counts.most_common(most), {skipped.scene for skipped in self._counts}
        rows = [f"left out {self.total} times, {len(self._counts)} distinct faults in {len(scenes)} scenes:"]
        rows += [f"  {count} x {skipped}" for skipped, count in shown]
        rest = self.total - sum(count for _, count in shown)
        return rows + ([f"  and {rest} more"] if rest else [])
