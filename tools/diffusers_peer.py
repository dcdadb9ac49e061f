"""The same checkpoint computed by diffusers' and transformers' own modules: the peer that our engines are measured by.

The modules are built without storage and are then given our tensors, so both sides share them. What diffusers has no
part for is refused. Needs diffusers and transformers, so it is imported only where a peer is asked for.
"""

from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from diffusers.models.autoencoders.autoencoder_kl_temporal_decoder import AutoencoderKLTemporalDecoder
from diffusers.models.unets.unet_3d_blocks import MidBlockTemporalDecoder
from diffusers.models.unets.unet_spatio_temporal_condition import UNetSpatioTemporalConditionModel
from msgspec.structs import replace
from torch import Tensor, nn
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from gcd_model.conditioning import Conditioning, clip_pixels
from gcd_model.config import ImageEncoderConfig, ModelConfig, UNetConfig, VAEConfig
from gcd_model.engines.torch import Engine
from gcd_model.errors import OptionError
from gcd_model.geometry import Trajectory
from gcd_model.networks import Networks, empty_networks
from gcd_model.unet import UNetPlan
from gcd_model.weights.names import Levels, published_names, taken_apart

_DEFAULT_GROUPS = 32


@dataclass(frozen=True, kw_only=True, slots=True)
class DiffusersModules:
    """One checkpoint as diffusers has it. image_size: side of the tower's square pictures, pixels."""

    unet: UNetSpatioTemporalConditionModel
    vae: AutoencoderKLTemporalDecoder
    tower: CLIPVisionModelWithProjection
    image_size: int


def require_published(config: ModelConfig) -> None:
    """Raises OptionError for what diffusers has no module for."""
    unet = config.unet
    lacks = {
        "camera control": config.camera != "none",
        "switches of ours (patches, x0-prediction)": config.is_ours,
        "a U-Net without image tower": config.image_encoder is None,
        "an embedding that is not four times as wide as the first level": unet.embedding_width != 4 * unet.width,
    }
    found = [what for what, present in lacks.items() if present]
    if found:
        raise OptionError(
            f"diffusers has no module for {', nor for '.join(found)}; measure this model without --peer, or another "
            "one with it: random:full, random:kubric90 or a published checkpoint"
        )


def without_camera(networks: Networks) -> Networks:
    """The same networks, sharing all tensors, without the camera's embedding: diffusers knows none.

    It is a small map of one vector per frame, computed once a window.
    """
    config = networks.config
    if config.camera == "none":
        return networks
    bare = empty_networks(replace(config, camera="none", unet=replace(config.unet, camera_width=0)))
    kept = {
        name: value
        for name, value in networks.state_dict().items()
        if not name.startswith(("camera.", "unet.embed_camera."))
    }
    bare.load_state_dict(kept, strict=True, assign=True)
    return bare


def diffusers_modules(networks: Networks) -> DiffusersModules:
    """Diffusers' modules on the tensors of `networks`, which must be without camera control.

    On the meta device if the networks are. Raises OptionError where diffusers has no such network.
    """
    config = networks.config
    require_published(config)
    assert config.image_encoder is not None  # `require_published` looked
    modules = DiffusersModules(
        unet=_empty_unet(config),
        vae=_empty_vae(config.vae),
        tower=_empty_tower(config.image_encoder),
        image_size=config.image_encoder.image_size,
    )
    states = published_states(networks)
    for part, module in {"unet": modules.unet, "vae": modules.vae, "image_encoder": modules.tower}.items():
        module.load_state_dict(states[part], strict=True, assign=True)
        module.requires_grad_(False).eval()
    _number_positions(modules.tower, networks.unet.stem.weight.device)
    _move_dormant(modules.unet, networks.unet.stem.weight)
    return modules


def published_states(networks: Networks) -> dict[str, dict[str, Tensor]]:
    """Tensors under diffusers' names, by part; views of ours wherever that is possible.

    The condition encoder stands in for the only encoder diffusers has.
    """
    levels = Levels.of(networks.config)
    states: dict[str, dict[str, Tensor]] = {"unet": {}, "vae": {}, "image_encoder": {}}
    for name, value in networks.state_dict().items():
        names = published_names(_encoder_named(name, networks), "diffusers", levels)
        for published, part in taken_apart(names, value).items() if names else ():
            folder, _, inner = published.partition("/")
            states[folder][inner] = part
    return states


def _encoder_named(name: str, networks: Networks) -> str:
    """Our name as if the condition encoder were the only one."""
    if networks.own_condition_encoder is None:
        return name
    if name.startswith("own_condition_encoder."):
        return name.replace("own_condition_encoder.", "target_encoder.", 1)
    return name.replace("target_encoder.", "camera.proj.", 1) if name.startswith("target_encoder.") else name


@contextmanager
def _norms_in(groups: int) -> Generator[None]:
    """While this holds, a GroupNorm that asks for diffusers' 32 groups is made with `groups`; it cannot be told."""
    plain = nn.GroupNorm

    class Regrouped(plain):
        def __init__(self, num_groups: int, num_channels: int, eps: float = 1e-5, affine: bool = True) -> None:
            super().__init__(groups if num_groups == _DEFAULT_GROUPS else num_groups, num_channels, eps, affine)

    nn.GroupNorm = Regrouped
    try:
        yield
    finally:
        nn.GroupNorm = plain


def _empty_unet(config: ModelConfig) -> UNetSpatioTemporalConditionModel:
    unet = config.unet
    with torch.device("meta"), _norms_in(unet.norm_groups):
        made = UNetSpatioTemporalConditionModel(
            in_channels=unet.latent_channels + unet.condition_channels,
            out_channels=unet.latent_channels,
            down_block_types=tuple(f"{_attending(each)}DownBlockSpatioTemporal" for each in unet.attention),
            up_block_types=tuple(f"{_attending(each)}UpBlockSpatioTemporal" for each in reversed(unet.attention)),
            block_out_channels=unet.widths,
            addition_time_embed_dim=unet.vector_width // 3,
            projection_class_embeddings_input_dim=unet.vector_width,
            layers_per_block=unet.blocks_per_level,
            cross_attention_dim=unet.context_width or 0,
            num_attention_heads=_heads(unet),
            num_frames=config.frames,
        )
    _give_published_epsilon(made)
    made.register_module("add_time_proj", nn.Identity())  # the conditioning holds the sinusoids already
    return made


def _attending(attends: bool) -> str:
    return "CrossAttn" if attends else ""


def _heads(unet: UNetConfig) -> tuple[int, ...]:
    return tuple(max(1, width // unet.head_width) for width in unet.widths)


def _give_published_epsilon(unet: nn.Module) -> None:
    """1e-5 in every residual norm, as the published weights were trained; diffusers has 1e-6 in some blocks."""
    for name, module in unet.named_modules():
        if isinstance(module, nn.GroupNorm) and ".resnets." in name:
            module.eps = 1e-5


def _empty_vae(vae: VAEConfig) -> AutoencoderKLTemporalDecoder:
    with torch.device("meta"), _norms_in(vae.norm_groups):
        made = AutoencoderKLTemporalDecoder(
            down_block_types=("DownEncoderBlock2D",) * len(vae.multipliers),
            block_out_channels=vae.widths,
            layers_per_block=vae.blocks_per_level,
            latent_channels=vae.latent_channels,
            scaling_factor=vae.scale,
        )
        width = vae.widths[-1]  # the middle has two blocks as published, however many a level has
        made.decoder.mid_block = MidBlockTemporalDecoder(width, width, attention_head_dim=width, num_layers=2)
    return made


def _empty_tower(tower: ImageEncoderConfig) -> CLIPVisionModelWithProjection:
    with torch.device("meta"):
        return CLIPVisionModelWithProjection(
            CLIPVisionConfig(
                image_size=tower.image_size,
                patch_size=tower.patch,
                hidden_size=tower.width,
                intermediate_size=tower.hidden_width,
                num_hidden_layers=tower.layers,
                num_attention_heads=tower.heads,
                projection_dim=tower.output_width,
                hidden_act="gelu",
            )
        )


def _number_positions(tower: CLIPVisionModelWithProjection, device: torch.device) -> None:
    """The one buffer that is no weight: it was made without storage."""
    for name, buffer in list(tower.named_buffers()):
        place, _, leaf = name.rpartition(".")
        tower.get_submodule(place).register_buffer(
            leaf, torch.arange(buffer.numel(), device=device).view(buffer.shape), persistent=False
        )


def _move_dormant(unet: nn.Module, like: Tensor) -> None:
    """Queries and keys to a single token: we never need them and leave them on the CPU; diffusers computes them."""
    for module in unet.modules():
        for name, parameter in module.named_parameters(recurse=False):
            if parameter.device != like.device or parameter.dtype != like.dtype:
                setattr(module, name, nn.Parameter(parameter.to(like.device, like.dtype), requires_grad=False))


class DiffusersEngine(Engine):
    """One token per clip is all that diffusers knows: it takes that of the first frame for all."""

    def __init__(self, modules: DiffusersModules) -> None:
        self._modules = modules

    @property
    def like(self) -> Tensor:
        return self._modules.unet.conv_in.weight

    def tokens(self, frames: Tensor) -> Tensor | None:
        pixels = clip_pixels(frames.to(self.like.device), self._modules.image_size)
        return self._modules.tower(pixels.to(self.like)).image_embeds

    def condition_mean(self, frames: Tensor) -> Tensor:
        (posterior,) = self._modules.vae.encode(frames.to(self.like), return_dict=False)
        return posterior.mean

    def camera(self, path: Trajectory) -> Tensor | None:
        return None

    def plan(self, labels: Tensor, given: Conditioning) -> UNetPlan:
        """The noise level before the conditioning vector: diffusers embeds them itself, in every step."""
        vector = given.vector.float().expand(len(labels), -1, -1)  # [S, K*T, V]
        level = labels.to(vector.device)[:, None, None].expand(-1, vector.shape[1], 1)
        return UNetPlan(torch.cat([level, vector], dim=2), given.tokens)

    def predict(self, rows: Tensor, condition: Tensor, embeddings: Tensor, crosses: Tensor | None) -> Tensor:
        frames = self._modules.unet.config["num_frames"]
        assert crosses is not None  # `require_published` looked
        clips, source = (each.to(self.like).unflatten(0, (-1, frames)) for each in (rows, condition))
        first = embeddings[::frames]  # [R*K, 1 + V], of every clip's first frame
        (raw,) = self._modules.unet(
            torch.cat([clips, source], dim=2),
            first[0, 0],
            crosses[::frames, None],
            first[:, 1:].to(self.like),
            return_dict=False,
        )
        return raw.float().flatten(0, 1)

    def decode(self, latents: Tensor) -> Tensor:
        vae, frames = self._modules.vae, len(latents)
        (decoded,) = vae.decode(latents.to(vae.decoder.conv_in.weight), num_frames=frames, return_dict=False)
        return decoded


def compile_modules(modules: DiffusersModules) -> DiffusersModules:
    """Put every network behind torch.compile, in place; the first windows then compile. On a GPU as one tunes it there:
    channels last, and every kernel the fastest that is found."""
    for module in (modules.unet, modules.vae.encoder, modules.vae.decoder, modules.tower):
        if next(module.parameters()).is_cuda:
            module.to(memory_format=torch.channels_last).compile(mode="max-autotune")
        else:
            module.compile()
    return modules
