"""Where a run computes, and how often it speaks and saves."""

from typing import Annotated, Literal, TypeAlias

import msgspec
from msgspec import Meta

from gcd_train.recipe.values import Count, Positive

Parallel: TypeAlias = Literal["none", "ddp", "fsdp"]


class ComputeRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where and how to compute.

    precision: of the networks' arithmetic while training on CUDA; weights and losses stay float32. The CPU always
    computes in float32.
    resident: keep the encoded clips in the device's memory.
    weights: what the trained weights, their gradients and plain optimisers' moments are kept in; "bfloat16" rounds
    stochastically (torchao) and keeps the moving average in float32.
    frozen: what weights that the U-Net stage does not train are kept in: encoders and, beside adapters, the U-Net;
    "bfloat16" halves their memory and computes in it.
    parallel: how the processes that `torchrun` starts share the U-Net stage: each with all weights ("ddp"), or each
    with its share of weights and moments ("fsdp"). Without torchrun there is one process, whatever it says.
    timeout_s: how long a process waits for the others before it gives up.
    checkpoint_activations: compute the U-Net's blocks anew in the backward pass instead of keeping what they made:
    all of them (true), or every n-th.
    compile: compile the U-Net's blocks (torch.compile); minutes at the start, faster afterwards.
    """

    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["float32", "bfloat16"] = "float32"
    channels_last: bool = True
    resident: bool = False
    weights: Literal["float32", "bfloat16"] = "float32"
    frozen: Literal["float32", "bfloat16"] = "float32"
    parallel: Parallel = "none"
    timeout_s: Positive = 1800.0
    checkpoint_activations: bool | Annotated[int, Meta(ge=1)] = False
    compile: bool = False


class LogRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How often a run speaks. log_s: a line of the log. save_s: the state. measure_s: metrics and sample pictures.

    valid_clips: held-out clips to measure on. tensorboard: write losses, metrics and samples for TensorBoard, too.
    keep: how many states are kept, the newest ones. keep_every: save after so many updates, too, and keep those states
    for ever. save: "async" writes the states of several processes beside training; one process always waits.
    """

    log_s: Positive = 15.0
    save_s: Positive = 120.0
    measure_s: Positive = 300.0
    valid_clips: Count = 4
    tensorboard: bool = False
    keep: Count = 3
    keep_every: Count | None = None
    save: Literal["sync", "async"] = "sync"
