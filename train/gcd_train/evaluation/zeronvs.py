"""ZeroNVS (Sargent et al. 2024): one picture seen by another camera, frame by frame, with weights that a user brings.

A latent diffusion network of Stable Diffusion's size, which sees the source's latents beside the noisy ones and is told
of source and camera by one token. The networks are diffusers' and transformers' own, filled from the published file.
What the paper leaves open is from
    zeronvs_config.yaml: 19 camera numbers, 256 x 256, guidance 3, 100 steps, eta 1, noise levels;
    github.com/kylesargent/ZeroNVS and zeronvs_diffusion: how the 19 are made, moving averages of the weights;
    Zero-1-to-3, which it was made from (issue 86 of cvlab-columbia/zero123): unscaled source latents, and nothing but
    zeros as the condition that guidance leads away from;
    its users' code and threestudio, which it was made with: cameras with OpenGL's axes.
Assumed: each frame has noise of its own, as the paper made frames one at a time; CLIP's pictures are resized
bicubically, corner on corner.
"""

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gcd_model.diffusion import unit_noise
from gcd_model.errors import CheckpointError
from gcd_model.loading import placement
from gcd_model.weights.card import precision
from gcd_model.weights.read import read_file
from gcd_train.data.sample import to_network
from gcd_train.errors import RecipeError
from gcd_train.evaluation.clips import EvaluationSet
from gcd_train.evaluation.predictors import Prediction, SourceClip, fitted, middle, require_one_lens, resized
from gcd_train.evaluation.runs import gather
from gcd_train.evaluation.store import Run

ZERONVS = "zeronvs"
CAMERA_NUMBERS, STEPS, GUIDANCE, ETA = 19, 100, 3.0, 1.0
LATENT_SCALE = 0.18215
_GAIN, _REACH = 0.5, 10.0
_HEADS, _HEAD_WIDTH = 8, 64  # of the U-Net, and of a head of the image encoder: no shape of a tensor tells these
_CLIP_MEAN, _CLIP_DEVIATION = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
_UNET, _VAE = "model.diffusion_model.", "first_stage_model."
_CONVERTERS = "diffusers.loaders.single_file_utils"
_IMAGE, _PROJECTION = "cond_stage_model.model.visual.", "cc_projection."


def camera_numbers(source_from_target: Tensor, vfov_deg: float, scale: float) -> Tensor:
    """What the network is told of a camera: 4 x 4 pose row by row, then field of view, its sine and its cosine.

        t' = 5 tanh(t / (10 scale)),   axes x right, y up, z back

    Args:
        source_from_target: [T, 4, 4], metres, axes x right, y down, z ahead. vfov_deg: of the square picture, one for
            both cameras. scale: metres that count as one; in training the 20th percentile of the source's depth.
    Returns:
        float32 [T, 19].
    Source: Sargent et al. 2024, section 3, "6DoF+1" normalized by the viewer.
    """
    flip = torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=source_from_target.dtype)
    pose = flip[:, None] * source_from_target * flip
    pose[:, :3, 3] = _GAIN * _REACH * torch.tanh(pose[:, :3, 3] / scale / _REACH)
    angle = math.radians(vfov_deg)
    lens = pose.new_tensor([angle, math.sin(angle), math.cos(angle)]).expand(len(pose), 3)
    return torch.cat([pose.flatten(1), lens], dim=1).float()


@dataclass(frozen=True, kw_only=True, slots=True)
class ZeroNvsNetworks:
    """The four networks of a checkpoint; the U-Net may be of another precision than the others."""

    unet: Any
    vae: Any
    image_encoder: Any
    projection: nn.Linear

    @torch.no_grad()
    def view(self, picture: Tensor, camera: Tensor, *, seed: int, steps: int = STEPS) -> Tensor:
        """One picture as another camera sees it.

        Args:
            picture: [3, H, W] in [-1, 1]. camera: [19], see `camera_numbers`. seed: of all noise. steps: of DDIM.
        Returns:
            float32 [3, H, W] in [0, 1], on the CPU.
        Source: DDIM (Song et al. 2021, Eq. 12), classifier-free guidance (Ho and Salimans 2022).
        """
        scheduler = _library("diffusers").DDIMScheduler(
            beta_start=0.00085,
            beta_end=0.012,
            beta_schedule="scaled_linear",
            clip_sample=False,
            set_alpha_to_one=False,
            steps_offset=1,
        )
        scheduler.set_timesteps(steps)
        device, dtype = self.projection.weight.device, self.unet.dtype
        picture = picture[None].to(device)
        seen = self.vae.encode(picture).latent_dist.mode()  # [1, 4, h, w]
        token = self.projection(torch.cat([self._embedded(picture), camera[None].to(device)], dim=1))[:, None]
        seen, token = (torch.cat([torch.zeros_like(each), each]).to(dtype) for each in (seen, token))  # [2, ...]
        latents, random = unit_noise((1, *seen.shape[1:]), seed).to(device), torch.Generator().manual_seed(seed)
        for t in scheduler.timesteps:
            both = torch.cat([latents.to(dtype).expand(2, -1, -1, -1), seen], dim=1)
            free, told = self.unet(both, t, encoder_hidden_states=token).sample.float().chunk(2)
            noise = free + GUIDANCE * (told - free)
            latents = scheduler.step(noise, t, latents, eta=ETA, generator=random).prev_sample
        made = self.vae.decode(latents / LATENT_SCALE).sample[0]
        return ((made + 1) / 2).clamp(0, 1).cpu()

    def _embedded(self, picture: Tensor) -> Tensor:
        """CLIP's embedding of [1, 3, H, W]: [1, D]."""
        side = self.image_encoder.config.image_size
        small = F.interpolate(picture, size=(side, side), mode="bicubic", align_corners=True)
        mean, deviation = (small.new_tensor(each).view(3, 1, 1) for each in (_CLIP_MEAN, _CLIP_DEVIATION))
        return self.image_encoder(((small + 1) / 2 - mean) / deviation).image_embeds


@dataclass(frozen=True, kw_only=True, slots=True)
class ZeroNVS:
    """Each frame of a clip seen from its target camera, on its own: nothing holds the frames together, so it flickers.

    The middle of each frame is resized to the network's 256 x 256, as in the paper, and what comes out to the same part
    of the target, where it is measured in the target's own pixels (see `Prediction.crop`).

    networks: give the weights. scale: of the camera's translation, metres, see `camera_numbers` and `best_scale`.
    steps: of the sampler. size: a side of the network's pictures. samples: draws of each clip. seed: all noise comes
    from it, the frame's number and, but for `shared_noise`, the clip's key. details: see Predictor.
    Source: Van Hoorick et al. 2024 (GCD), section 5, "ZeroNVS".
    """

    networks: Callable[[], ZeroNvsNetworks]
    scale: float
    steps: int = STEPS
    size: int = 256
    samples: int = 1
    seed: int = 0
    shared_noise: bool = False
    privileged: bool = False
    details: dict[str, str] = field(default_factory=dict[str, str])

    @property
    def name(self) -> str:
        """With the scale, so that several stand in one report."""
        return f"{ZERONVS} (scale {self.scale:g})"

    def predict(self, clip: SourceClip) -> Prediction:
        """See Predictor. No class map. Raises DataError where a lens changes."""
        require_one_lens(clip, self.name)
        lens, networks = clip.cameras.target, self.networks()
        crop = middle(lens, 1.0)
        square = lens if crop is None else lens.cropped(*crop)
        cameras = camera_numbers(clip.cameras.source_from_target, square.vfov_deg, self.scale)
        pictures = fitted(to_network(clip.source), self.size, self.size)
        draws, key = list[Prediction](), "" if self.shared_noise else clip.key
        for number in range(self.samples):
            frames = [
                networks.view(picture, camera, seed=self._seed(f"{key}#{number}.{t}"), steps=self.steps)
                for t, (picture, camera) in enumerate(zip(pictures, cameras, strict=True))
            ]
            draws.append(Prediction(video=resized(torch.stack(frames), square.height, square.width), crop=crop))
        return replace(draws[0], more=tuple(draws[1:]))

    def _seed(self, name: str) -> int:
        return int.from_bytes(hashlib.sha256(f"{self.seed}:{name}".encode()).digest()[:6])


def best_scale(run: Path, clips: EvaluationSet, weights: str) -> tuple[float, str]:
    """The scale that did best in a run on validation clips, one for all clips; and how it was chosen, in words.

    Best is the highest mean PSNR of frames 2 to the last, over the clips that all scales were measured on. The paper
    chose one for each video by eye.

    Args:
        clips: that it is to be used on: of the same kind, and of other scenes. weights: digest of those to be used.
    Raises:
        RunError: there is no such run. RecipeError: it is of other clips than wanted, or has no two scales.
    """
    (of,) = gather([Run.read(run)])
    found = {
        float(each.details["scale"]): each
        for each in of.methods
        if each.details.get("baseline") == ZERONVS and each.details.get("weights") == weights
    }
    scenes = {record.scene for each in found.values() for record in each.records}
    shared = sorted(scenes & {name for key in clips.keys for name in (key, key.partition(".")[0])})
    if shared or of.note.data_identity == clips.identity or of.note.kind != clips.kind:
        held = of.note.kind if of.note.kind != clips.kind else f"{shared[0]}, too" if shared else "the very clips"
        raise RecipeError(
            f"a scale is chosen on validation clips of the same kind, {clips.kind}, and of other scenes, and {run} "
            f"holds {held}; give another run, or the number"
        )
    common = set.intersection(*(set(each.places) for each in found.values())) if len(found) > 1 else set[str]()
    if not common:
        raise RecipeError(
            f"{run} holds no clips measured with two scales of these weights; evaluate there with several"
        )
    keys = sorted(common)
    psnr_db = {scale: each.sums(keys=keys).value("psnr_db") for scale, each in sorted(found.items())}
    best = max(psnr_db, key=lambda scale: psnr_db[scale])
    each = ", ".join(f"{scale:g}: {value:.2f}" for scale, value in psnr_db.items())
    return best, f"best mean PSNR of {len(keys)} clips with digest {of.note.data_identity} ({each} dB)"


# --- the published file ----------------------------------------------------------------------------------------------


def published_tensors(path: Path) -> Mapping[str, Tensor]:
    """The file's tensors by name, mapped. Nothing in it is executed. Raises CheckpointError where it is no ZeroNVS."""
    try:
        tensors = read_file(path).tensors
    except (CheckpointError, OSError) as error:
        raise CheckpointError(f"{path}: {error}") from error
    lacks = [part for part in (_UNET, _VAE, _IMAGE, _PROJECTION) if not any(name.startswith(part) for name in tensors)]
    if lacks:
        raise CheckpointError(f"{path} is of another method, it has no tensors {lacks[0]}*; give zeronvs.ckpt")
    projection = tensors.get(f"{_PROJECTION}weight")
    if projection is None or projection.ndim != 2:
        raise CheckpointError(f"{path} has no matrix {_PROJECTION}weight; fetch it again")
    token, inputs = projection.shape
    if inputs - token != CAMERA_NUMBERS:
        raise CheckpointError(
            f"{path} is told of a camera in {inputs - token} numbers, ZeroNVS in {CAMERA_NUMBERS} (Zero-1-to-3 in 4); "
            "give zeronvs.ckpt"
        )
    return tensors


@lru_cache(maxsize=1)
def open_zeronvs(path: str, device: str, dtype: str | None) -> ZeroNvsNetworks:
    """Networks of the sizes that the file's tensors have. dtype: of the U-Net.

    Raises:
        CheckpointError: the file is none of ZeroNVS, or a tensor is missing or of another shape.
        RecipeError: diffusers or transformers is not installed. OptionError: no such device or dtype.
    """
    tensors = published_tensors(Path(path))
    place, name = placement(device, None, dtype, live=False)
    try:
        parts = {"U-Net": _unet(tensors), "autoencoder": _vae(tensors), "image encoder": _image_encoder(tensors)}
    except (KeyError, AttributeError, TypeError, ValueError) as error:  # what converters raise where a tensor is absent
        raise CheckpointError(f"{path} lacks tensors of ZeroNVS, for one {error}; fetch it again") from error
    token, inputs = tensors[f"{_PROJECTION}weight"].shape
    projection = nn.Linear(inputs, token, device="meta")
    parts["projection"] = projection, _of(tensors, _PROJECTION)
    for part, (network, weights) in parts.items():
        blanks = network.state_dict()
        wrong = [key for key, blank in blanks.items() if key not in weights or weights[key].shape != blank.shape]
        if wrong:
            raise CheckpointError(f"{path}: the {part} lacks {wrong[0]}, or has it in another shape; fetch it again")
        kind = precision(name) if part == "U-Net" else torch.float32
        network.load_state_dict({key: weights[key].to(place, kind) for key in blanks}, assign=True)
        network.eval().requires_grad_(False).to(place)
    unet, vae, image_encoder = (network for network, _ in list(parts.values())[:3])
    return ZeroNvsNetworks(unet=unet, vae=vae, image_encoder=image_encoder, projection=projection)


def _library(name: str) -> Any:
    """A module of the extra. Raises RecipeError where it is not installed."""
    try:
        return import_module(name)
    except ImportError as error:
        raise RecipeError(f"{ZERONVS} needs {name}: pip install 'gcd-node[zeronvs]' ({error})") from error


Part = tuple[nn.Module, Mapping[str, Tensor]]
"""A network without weights, and the weights by its own names."""


def _of(tensors: Mapping[str, Tensor], part: str) -> dict[str, Tensor]:
    return {name.removeprefix(part): tensor for name, tensor in tensors.items() if name.startswith(part)}


def _unet(tensors: Mapping[str, Tensor]) -> Part:
    """With the moving averages of the weights where the file has them, as its authors sample."""
    plain = {name: tensor for name, tensor in tensors.items() if name.startswith(_UNET)}
    averages = {name: "model_ema." + name.removeprefix("model.").replace(".", "") for name in plain}
    if all(name in tensors for name in averages.values()):
        plain = {name: tensors[averages[name]] for name in plain}
    widths = list[int]()
    while (halving := f"{_UNET}input_blocks.{3 * len(widths) + 3}.0.op.weight") in plain:
        widths.append(plain[halving].shape[0])
    widths.append(plain[f"{_UNET}middle_block.0.in_layers.0.weight"].shape[0])
    with torch.device("meta"):
        network = _library("diffusers").UNet2DConditionModel(
            in_channels=8,
            block_out_channels=tuple(widths),
            down_block_types=(*("CrossAttnDownBlock2D",) * (len(widths) - 1), "DownBlock2D"),
            up_block_types=("UpBlock2D", *("CrossAttnUpBlock2D",) * (len(widths) - 1)),
            cross_attention_dim=tensors[f"{_PROJECTION}weight"].shape[0],
            attention_head_dim=_HEADS,  # diffusers' name for their number
        )
    return network, _library(_CONVERTERS).convert_ldm_unet_checkpoint(plain, network.config)


def _vae(tensors: Mapping[str, Tensor]) -> Part:
    weights, widths = {name: tensor for name, tensor in tensors.items() if name.startswith(_VAE)}, list[int]()
    while (block := f"{_VAE}encoder.down.{len(widths)}.block.0.conv2.weight") in weights:
        widths.append(weights[block].shape[0])
    with torch.device("meta"):
        network = _library("diffusers").AutoencoderKL(
            block_out_channels=tuple(widths),
            down_block_types=("DownEncoderBlock2D",) * len(widths),
            up_block_types=("UpDecoderBlock2D",) * len(widths),
            layers_per_block=2,
            latent_channels=4,
        )
    return network, _library(_CONVERTERS).convert_ldm_vae_checkpoint(weights, network.config)


_LAYERS = {
    "ln_1": "layer_norm1",
    "ln_2": "layer_norm2",
    "attn.out_proj": "self_attn.out_proj",
    "mlp.c_fc": "mlp.fc1",
    "mlp.c_proj": "mlp.fc2",
}


def _image_encoder(tensors: Mapping[str, Tensor]) -> Part:
    """CLIP's image tower under the names of its first publication (Radford et al. 2021)."""
    given, inner = _of(tensors, _IMAGE), "vision_model."
    weights = {
        f"{inner}embeddings.class_embedding": given["class_embedding"],
        f"{inner}embeddings.patch_embedding.weight": given["conv1.weight"],
        f"{inner}embeddings.position_embedding.weight": given["positional_embedding"],
        "visual_projection.weight": given["proj"].T,
    }
    layers = 0
    while f"transformer.resblocks.{layers}.ln_1.weight" in given:
        layers += 1
    for kind in ("weight", "bias"):
        weights[f"{inner}pre_layrnorm.{kind}"] = given[f"ln_pre.{kind}"]
        weights[f"{inner}post_layernorm.{kind}"] = given[f"ln_post.{kind}"]
        for number in range(layers):
            old, new = f"transformer.resblocks.{number}.", f"{inner}encoder.layers.{number}."
            weights |= {f"{new}{ours}.{kind}": given[f"{old}{theirs}.{kind}"] for theirs, ours in _LAYERS.items()}
            joined = given[f"{old}attn.in_proj_{kind}"].chunk(3)
            weights |= {f"{new}self_attn.{each}_proj.{kind}": part for each, part in zip("qkv", joined, strict=True)}
    width, _, patch, _ = given["conv1.weight"].shape
    config = _library("transformers").CLIPVisionConfig(
        hidden_size=width,
        intermediate_size=given["transformer.resblocks.0.mlp.c_fc.weight"].shape[0],
        num_hidden_layers=layers,
        num_attention_heads=max(width // _HEAD_WIDTH, 1),
        image_size=math.isqrt(len(given["positional_embedding"]) - 1) * patch,
        patch_size=patch,
        projection_dim=given["proj"].shape[1],
        hidden_act="quick_gelu",
    )
    with torch.device("meta"):
        network = _library("transformers").CLIPVisionModelWithProjection(config)
    places = torch.arange(len(given["positional_embedding"]))[None]
    network.vision_model.embeddings.register_buffer("position_ids", places, persistent=False)
    return network, weights
