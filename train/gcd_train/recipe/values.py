"""Kinds of numbers that recipes are made of, and budgets."""

from typing import Annotated, Literal, TypeAlias

import msgspec
from msgspec import Meta

Positive: TypeAlias = Annotated[float, Meta(gt=0)]
NotNegative: TypeAlias = Annotated[float, Meta(ge=0)]
Count: TypeAlias = Annotated[int, Meta(ge=1)]
Share: TypeAlias = Annotated[float, Meta(ge=0, le=1)]
StageName: TypeAlias = Literal["vae", "latents", "unet", "export"]
DistillStageName: TypeAlias = Literal["latents", "paired", "export"]
LiveStageName: TypeAlias = Literal["depth", "paint", "detail"]
AnyStageName: TypeAlias = StageName | DistillStageName | LiveStageName


class Budget(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How long a stage trains: a number of updates, or minutes of wall time (measurements not counted)."""

    updates: Count | None = None
    minutes: Positive | None = None

    def __post_init__(self) -> None:
        if (self.updates is None) == (self.minutes is None):
            raise ValueError("a budget is either updates or minutes: give one of them")

    def share(self, updates: int, seconds: float) -> float:
        """How much of it is used, 0 to 1."""
        used = updates / self.updates if self.updates is not None else seconds / (60 * (self.minutes or 1.0))
        return min(used, 1.0)
