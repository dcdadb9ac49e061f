"""Where a run computes, and how often it speaks."""

from typing import Literal

import msgspec

from gcd_train.recipe.values import Count, Positive


class ComputeRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where and how to compute.

    precision: of the networks' arithmetic while training on CUDA; weights and losses stay float32. The CPU always
    computes in float32.
    resident: keep the encoded clips in the device's memory.
    """

    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["float32", "bfloat16"] = "float32"
    channels_last: bool = True
    resident: bool = False


class LogRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How often a run speaks. log_s: a line of the log. save_s: the state. measure_s: metrics and sample pictures.

    valid_clips: held-out clips to measure on.
    """

    log_s: Positive = 15.0
    save_s: Positive = 120.0
    measure_s: Positive = 300.0
    valid_clips: Count = 4
