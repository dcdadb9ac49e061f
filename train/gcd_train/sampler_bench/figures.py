"""What was measured of samplers, as it goes into JSON and comes back."""

import msgspec

from gcd_model import SolverName
from gcd_model.clip import Guidance, NoiseInterval


class Apart(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How far a way lies from a reference, mean over clips.

    latents: norm of the difference over the norm of the reference. psnr_db: of the pictures, all frames; equal ones
    score 100.
    """

    latents: float
    psnr_db: float


class WayFigures(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One way to sample.

    evaluations: of the network, guided steps counted twice. apart: from each of the references, in their order.
    What follows is against the truth, frames 2 to the last, and None where there is nothing to measure: psnr_db,
    gradient_energy (views over targets) and miou; ahead_db, ahead_miou: over the checkpoint's own way, with
    ahead_error_db, ahead_error_miou, paired standard errors over scenes (None for a single scene).
    """

    steps: int
    solver: SolverName
    guidance: Guidance
    guidance_interval: NoiseInterval | None
    evaluations: int
    apart: tuple[Apart, ...]
    psnr_db: float | None
    gradient_energy: float | None
    miou: float | None
    ahead_db: float | None
    ahead_error_db: float | None
    ahead_miou: float | None
    ahead_error_miou: float | None


class SamplerBench(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Ways to sample one checkpoint, the first its own.

    command: that made it. date: YYYY-MM-DD. torch: its version. weights, sha256_12: name and digest. prediction: "v" or
    "x0". data_identity: digest of the clips, of which `clips` were measured. seed: of the noise, the same for every way
    and clip. references: what `WayFigures.apart` is counted from, in words.
    """

    command: str
    date: str
    torch: str
    weights: str
    sha256_12: str
    prediction: str
    sigma_max: float
    sigma_min: float
    data: tuple[str, ...]
    data_identity: str
    clips: int
    seed: int
    references: tuple[str, ...]
    ways: tuple[WayFigures, ...]
