"""One scene, encoded: from pictures to the tensors of a safetensors file.

times                 int16  [N]                  frames that are in
pairs                 int16  [R, 2]               time and path position of every target row
source                f16    [N, K, C, h, w]      condition latents of the noised source, K draws of the noise
tokens                f16    [N, D]               image tokens of the clean source; only with an image tower
target_mean           f16    [R, C, h, w]         posterior of the target latents, not scaled
target_log_variance   u8     [R, C, h, w]         of it, -30..20 in 255 steps: the deviation to 5 %; only with moments
emphasis              f16    [R, 1, h, w]         class emphasis of semantic targets; only for semantic targets
"""

from collections import defaultdict
from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_train.datasets.clip_source import to_network
from gcd_train.errors import DataError
from gcd_train.latent_cache.encoders import Encoders
from gcd_train.latent_cache.index import CacheIdentity
from gcd_train.latent_cache.pictures import MomentPictures, PathPictures
from gcd_train.training.draws import Draws
from gcd_train.training.losses import PARALLEL_DOMAIN_WEIGHTS, class_emphasis

_LOWEST, _SPAN, _CODES = -30.0, 50.0, 255


@dataclass(frozen=True, kw_only=True, slots=True)
class EncodedScene:
    """tensors: see the module. frames: time steps of the scene. missing: reason by time, of what was wanted."""

    tensors: dict[str, Tensor]
    frames: int
    missing: dict[int, str]


def encode_scene(encoders: Encoders, pictures: PathPictures, identity: CacheIdentity, scene: str) -> EncodedScene:
    """Encode everything the clips of a scene need; a frame that cannot be had is left out and named.

    Raises: DataError if no frame can be had, or the encoders give what float16 does not hold.
    """
    frames = pictures.frames(scene)
    positions: dict[int, list[int]] = defaultdict(list)
    for time, position in identity.plan.pairs(frames, range(frames)):
        positions[time].append(position)
    if not positions:
        raise DataError(f"{scene}: {frames} frames are too few for a clip; generate or download it whole")
    rows: dict[str, list[Tensor]] = defaultdict(list)
    times: list[int] = []
    pairs: list[tuple[int, int]] = []
    missing: dict[int, str] = {}
    for time, wanted in sorted(positions.items()):
        try:
            moment = pictures.moment(scene, time, wanted)
        except DataError as error:
            missing[time] = str(error)
            continue
        _require_size(identity, scene, moment)
        for name, values in encode_moment(encoders, identity, moment, f"{scene}/{time}").items():
            rows[name].append(values)
        times.append(time)
        pairs += [(time, position) for position in wanted]
    if not times:
        raise DataError(f"{scene}: none of {len(positions)} frames can be read, first: {next(iter(missing.values()))}")
    tensors = {name: torch.cat(parts).contiguous() for name, parts in rows.items()}
    tensors |= {"times": torch.tensor(times, dtype=torch.int16), "pairs": torch.tensor(pairs, dtype=torch.int16)}
    _require_finite(scene, tensors)
    return EncodedScene(tensors=tensors, frames=frames, missing=missing)


@torch.no_grad()
def encode_moment(encoders: Encoders, identity: CacheIdentity, moment: MomentPictures, name: str) -> dict[str, Tensor]:
    """The rows of one frame: source [1, ...], targets [P, ...]. name: of the frame, what its noise follows from."""
    source, targets = to_network(moment.source[None]), to_network(moment.targets)
    draws = Draws(identity.seed, f"latent cache/{name}", 0, torch.device("cpu"))
    noise = draws.normal(identity.copies, *source.shape[1:])
    posterior = encoders.posterior(targets)
    rows = {
        "source": encoders.condition_mean(source + identity.augmentation * noise)[None].half(),
        "target_mean": posterior.mean.half(),
    }
    if identity.moments == "both":
        rows["target_log_variance"] = log_variance_codes(posterior.log_variance)
    tokens = encoders.tokens(source)
    if tokens is not None:
        rows["tokens"] = tokens.half()
    if identity.emphasis:
        size = (posterior.mean.shape[-2], posterior.mean.shape[-1])
        rows["emphasis"] = class_emphasis(targets, PARALLEL_DOMAIN_WEIGHTS, size).half()
    return rows


def log_variance_codes(log_variance: Tensor) -> Tensor:
    """Log-variances -30..20 as u8."""
    return ((log_variance - _LOWEST) * (_CODES / _SPAN)).round().clamp(0, _CODES).to(torch.uint8)


def log_variance_of(codes: Tensor) -> Tensor:
    """Inverse of `log_variance_codes`, float32; off by 0.1 at most."""
    return codes.float() * (_SPAN / _CODES) + _LOWEST


def _require_size(identity: CacheIdentity, scene: str, moment: MomentPictures) -> None:
    wanted = (identity.height, identity.width)
    given = {moment.source.shape[:2], moment.targets.shape[1:3]}
    if given != {wanted}:
        raise DataError(f"{scene}: pictures must be {wanted} (height, width) for these weights, got {sorted(given)}")


def _require_finite(scene: str, tensors: dict[str, Tensor]) -> None:
    for name, values in tensors.items():
        if not bool(values.isfinite().all()):
            raise DataError(
                f"{scene}: {name} holds values that float16 does not; give --dtype float32, or look at the weights"
            )
