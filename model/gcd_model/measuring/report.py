"""What was measured of a model, as it goes into JSON and comes back."""

from typing import Literal, get_args

import msgspec

StageName = Literal["tower", "encode", "step", "decode", "window"]
"""tower: image tokens of all frames, their resizing included. encode: source latents of all frames. step: one network
evaluation with its guidance; the first of a window, which also prepares what is constant over it, only where it is the
only one. decode: latents to pictures, a plane mix included. window: a clip in memory to a view in memory."""

STAGES: tuple[StageName, ...] = get_args(StageName)


class StageFigures(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One stage of one implementation.

    runs: how often it was measured. median_s, p95_s: by the clock. cpu_s: of all cores together, median.
    tflop: counted from shapes on the meta device, multiplications and additions apart.
    """

    stage: StageName
    runs: int
    median_s: float
    p95_s: float
    cpu_s: float
    tflop: float


class MemoryFigures(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The most that a fresh process held that did this and nothing else, GB (1e9 bytes).

    resident_gb: pages of mapped weight files included. private_gb: without them. device_gb: of the GPU's allocator;
    None on a CPU.
    """

    resident_gb: float
    private_gb: float
    device_gb: float | None = None


class Implementation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One way of computing the same networks. memory: None where it was not measured."""

    name: str
    stages: tuple[StageFigures, ...]
    memory: MemoryFigures | None = None


class Difference(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How far another implementation's window lies from ours: largest difference over our largest value.

    pictures: None where nothing was decoded.
    """

    name: str
    latents: float
    pictures: float | None


class ModelBench(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="model", tag_field="kind"):
    """Everything measured of one model. parameters: of the networks, in millions. device: as torch calls it.

    guidance: scale of the first and the last frame. implementations: ours first.
    """

    model: str
    parameters: float
    frames: int
    height: int
    width: int
    steps: int
    guidance: tuple[float, float]
    precision: str
    device: str
    threads: int
    implementations: tuple[Implementation, ...]
    differences: tuple[Difference, ...] = ()
