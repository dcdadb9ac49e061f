"""May the decoder compute in bfloat16? Asked of the decoder itself, on one clip, before it is used."""

import copy
import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from gcd_model.networks import Networks
from gcd_model.noise import unit_noise
from gcd_model.vae import TemporalDecoder, to_pixels

WANTED_DB = 50.0
"""PSNR against float32 from which bfloat16 is used: less than one level of 8 bits, on average."""

_COARSE = 16
_SEED = 11
_FRAMES = 4  # decoding all of a clip in float32 without graphs takes more memory than anything else does


@dataclass(frozen=True, kw_only=True, slots=True)
class DecoderChoice:
    """The decoder that is used. psnr_db: of its pictures in bfloat16 against float32."""

    decoder: TemporalDecoder
    psnr_db: float


@torch.inference_mode()
def checked_decoder(networks: Networks) -> DecoderChoice:
    """The decoder in bfloat16 if its pictures of a test clip are good enough for that, else as it is."""
    config, full = networks.config, networks.decoder
    frames = drifting_clip(min(config.frames, _FRAMES), config.height, config.width)
    encoder = networks.condition_encoder
    latents = torch.cat([encoder(each[None].to(encoder.stem.weight)).mean for each in frames]).float()
    half = copy.deepcopy(full).to(torch.bfloat16)
    psnr = psnr_db(*(to_pixels(each(latents.to(each.stem.weight), len(latents))) for each in (half, full)))
    return DecoderChoice(decoder=half if psnr > WANTED_DB else full, psnr_db=psnr)


def drifting_clip(frames: int, height: int, width: int) -> Tensor:
    """A smooth random picture with a fine pattern that moves by a pixel a frame: [frames, 3, height, width]."""
    coarse = unit_noise((1, 3, max(2, height // _COARSE), max(2, width // _COARSE)), _SEED)
    smooth = F.interpolate(coarse, size=(height, width), mode="bilinear")[0]
    fine = 0.2 * unit_noise((3, height, width), _SEED, 1)
    return torch.stack([(smooth + fine).roll(t, dims=-1) for t in range(frames)]).clamp(-1, 1)


def psnr_db(ours: Tensor, truth: Tensor) -> float:
    """Peak signal to noise ratio of pictures in [0, 1]; infinite for equal ones, 0 if there is NaN or Inf."""
    error = F.mse_loss(ours.float(), truth.float()).item()
    if not math.isfinite(error):
        return 0.0
    return math.inf if error == 0 else -10 * math.log10(error)
