"""Stops a run whose loss or gradient is no number any more, and says on which clips it happened."""

import json
import math
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from gcd_train.errors import TrainError

_NAMED = 6


@dataclass(frozen=True, slots=True)
class _Seen:
    update: int
    what: str
    value: Tensor
    ids: tuple[str, ...]


class FiniteGuard:
    """Remembers losses and gradient norms without looking at them, so that a GPU need not wait; `check` looks.

    stage: for the message. note: a JSON file that is written when something is wrong, with all clips' names.
    at_once: look at values on the CPU right away, before anything is done with them.
    """

    def __init__(self, stage: str, note: Path, *, at_once: bool = True) -> None:
        self._stage, self._note, self._at_once = stage, note, at_once
        self._seen: list[_Seen] = []

    def saw(self, update: int, what: str, value: Tensor, ids: tuple[str, ...] = ()) -> None:
        """A value that must be finite. Raises TrainError as `check`."""
        self._seen.append(_Seen(update, what, value.detach(), ids))
        if self._at_once and value.device.type == "cpu":
            self.check()

    def check(self) -> None:
        """Raises TrainError for the first value since the last check that is no number, or infinite."""
        seen, self._seen = self._seen, []
        for each in seen:
            value = float(each.value)
            if not math.isfinite(value):
                self._stop(each, value, [name for other in seen if other.update == each.update for name in other.ids])

    def _stop(self, wrong: _Seen, value: float, ids: list[str]) -> None:
        told = {"stage": self._stage, "update": wrong.update, "what": wrong.what, "value": str(value), "clips": ids}
        with suppress(OSError):  # a full disk must not hide what is wrong
            self._note.parent.mkdir(parents=True, exist_ok=True)
            self._note.write_text(json.dumps(told, indent=1))
        named = ", ".join(ids[:_NAMED]) + (f" and {len(ids) - _NAMED} more" if len(ids) > _NAMED else "")
        raise TrainError(
            f"the {wrong.what} of {self._stage} is {value} at update {wrong.update}"
            f"{f', on clips {named}' if ids else ''} (see {self._note}); the state saved before is untouched: look at "
            "these clips, or lower the learning rate in the recipe, and run again"
        )
