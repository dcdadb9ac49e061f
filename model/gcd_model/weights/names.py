"""Published weight names and ours: pure renaming, one table for all layouts.

`published_names(name, naming, levels)` says where a parameter of `Networks` stands in a Lightning checkpoint of GCD or
in `svd.safetensors` (both use the names of Stability's code: naming "gcd"), or in a diffusers folder, whose three parts
we write as `unet/NAME`, `vae/NAME` and `image_encoder/NAME`. `assembled` makes our tensor of the published ones.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Literal, Self

import torch
from torch import Tensor

from gcd_model.config import ModelConfig

Naming = Literal["own", "gcd", "diffusers"]

GCD_UNET = "model.diffusion_model"
PROJECTION = "image_encoder/visual_projection.weight"
"""The one matrix that diffusers has transposed."""


@dataclass(frozen=True, slots=True)
class Levels:
    """The counts that published block numbers depend on.

    attention: for each U-Net level, shallowest first, whether it attends.
    """

    attention: tuple[bool, ...] = ()
    unet_blocks: int = 0
    vae_levels: int = 0
    vae_blocks: int = 0
    image_layers: int = 0

    @classmethod
    def of(cls, config: ModelConfig) -> Self:
        """The counts of a config."""
        return cls(
            attention=config.unet.attention,
            unet_blocks=config.unet.blocks_per_level,
            vae_levels=len(config.vae.multipliers),
            vae_blocks=config.vae.blocks_per_level,
            image_layers=0 if config.image_encoder is None else config.image_encoder.layers,
        )


@lru_cache(maxsize=1 << 14)
def published_names(name: str, naming: Naming, levels: Levels) -> tuple[str, ...]:
    """Where a layout keeps our parameter: one tensor, or three (q, k, v) to be joined; none if it has no such one."""
    if naming == "own":
        return (name,)
    found = _translated(name, "", naming, levels)
    if found is None:
        return ()
    return tuple(found.replace("?", part) for part in "qkv") if "?" in found else (found,)


def assembled(names: Sequence[str], tensors: Sequence[Tensor], axes: int) -> Tensor:
    """Our tensor, of so many axes, made of the published ones; a view wherever that is possible.

    A linear layer [C', C] is our 1x1 convolution [C', C, 1, 1].
    """
    tensor = tensors[0] if len(tensors) == 1 else torch.cat(tuple(tensors))
    if names[0] == PROJECTION:
        return tensor.T
    return tensor[..., None, None] if (tensor.ndim, axes) == (2, 4) else tensor


def published_shape(names: Sequence[str], shape: tuple[int, ...], axes: int) -> tuple[int, ...]:
    """Shape of each published tensor, of so many axes, that makes ours: the inverse of `assembled`."""
    if names[0] == PROJECTION:
        return shape[::-1]
    if len(names) > 1:
        return (shape[0] // len(names), *shape[1:])
    return shape[:2] if axes == 2 and shape[2:] == (1, 1) else shape


def taken_apart(names: Sequence[str], tensor: Tensor) -> dict[str, Tensor]:
    """The published tensors that make ours, views: the inverse of `assembled`, for those who write other layouts."""
    if names[0] == PROJECTION:
        return {names[0]: tensor.T}
    linear = tensor.ndim == 4 and ".attentions." in names[0]
    return dict(zip(names, (tensor.flatten(1) if linear else tensor).chunk(len(names)), strict=True))


# --- the table -------------------------------------------------------------------------------------------------------


_TABLE = """
[]
unet                        model.diffusion_model                                unet/ unet
camera.proj                 conditioner.embedders.5.proj                         -
image_encoder.projection    conditioner.embedders.0.open_clip.model.visual.proj  image_encoder/visual_projection.weight
image_encoder               conditioner.embedders.0.open_clip.model.visual       image_encoder/vision_model tower
target_encoder.quant        -                                                    vae/quant_conv
target_encoder              first_stage_model.encoder                            vae/encoder encoder
own_condition_encoder.quant conditioner.embedders.3.encoder.quant_conv           -
own_condition_encoder       conditioner.embedders.3.encoder.encoder              - encoder
decoder                     first_stage_model.decoder                            vae/decoder decoder

[unet]
embed_noise.0              time_embed.0                     time_embedding.linear_1
embed_noise.2              time_embed.2                     time_embedding.linear_2
embed_vector.0             label_emb.0.0                    add_embedding.linear_1
embed_vector.2             label_emb.0.2                    add_embedding.linear_2
embed_camera               aux_label_emb                    -
stem                       input_blocks.0.0                 conv_in
norm_out                   out.0                            conv_norm_out
conv_out                   out.2                            conv_out
down.*.stages.*.res        input_blocks.{down}.0            down_blocks.{level}.resnets.{i}          res
down.*.stages.*.attention  input_blocks.{down}.1            down_blocks.{level}.attentions.{i}       transformer
down.*.down.conv           input_blocks.{down}.0.op         down_blocks.{level}.downsamplers.0.conv
middle.0.res               middle_block.0                   mid_block.resnets.0                      res
middle.0.attention         middle_block.1                   mid_block.attentions.0                   transformer
middle.1.res               middle_block.2                   mid_block.resnets.1                      res
up.*.stages.*.res          output_blocks.{up}.0             up_blocks.{level}.resnets.{i}            res
up.*.stages.*.attention    output_blocks.{up}.1             up_blocks.{level}.attentions.{i}         transformer
up.*.up.conv               output_blocks.{up}.{after}.conv  up_blocks.{level}.upsamplers.0.conv

[res]
spatial    .                      spatial_res_block      half
temporal   time_stack             temporal_res_block     half
share.mix  time_mixer.mix_factor  time_mixer.mix_factor

[half]
norm1  in_layers.0      norm1
conv1  in_layers.2      conv1
embed  emb_layers.1     time_emb_proj
norm2  out_layers.0     norm2
conv2  out_layers.3     conv2
skip   skip_connection  conv_shortcut

[transformer]
spatial          transformer_blocks.0   transformer_blocks.0           block
temporal         time_stack.0           temporal_transformer_blocks.0  block
positions.mlp.0  time_pos_embed.0       time_pos_embed.linear_1
positions.mlp.2  time_pos_embed.2       time_pos_embed.linear_2
share.mix        time_mixer.mix_factor  time_mixer.mix_factor

[block]
norm_first                 norm_in            norm_in
feed_first.expand          ff_in.net.0.proj   ff_in.net.0.proj
feed_first.contract        ff_in.net.2        ff_in.net.2
norm_attention             norm1              norm1
attention.query            attn1.to_q         attn1.to_q
attention.key              attn1.to_k         attn1.to_k
attention.value            attn1.to_v         attn1.to_v
attention.out              attn1.to_out.0     attn1.to_out.0
token.dormant.norm_weight  norm2.weight       norm2.weight
token.dormant.norm_bias    norm2.bias         norm2.bias
token.dormant.query        attn2.to_q.weight  attn2.to_q.weight
token.dormant.key          attn2.to_k.weight  attn2.to_k.weight
token.value                attn2.to_v         attn2.to_v
token.out                  attn2.to_out.0     attn2.to_out.0
norm_feed                  norm3              norm3
feed.expand                ff.net.0.proj      ff.net.0.proj
feed.contract              ff.net.2           ff.net.2

[tower]
patches      conv1                          embeddings.patch_embedding
class_token  class_embedding                embeddings.class_embedding
positions    positional_embedding           embeddings.position_embedding.weight
norm_in      ln_pre                         pre_layrnorm
norm_out     ln_post                        post_layernorm
layers.*     transformer.resblocks.{level}  encoder.layers.{level}                layer

[layer]
norm_attention          ln_1                 layer_norm1
query_key_value.weight  attn.in_proj_weight  self_attn.?_proj.weight
query_key_value.bias    attn.in_proj_bias    self_attn.?_proj.bias
out                     attn.out_proj        self_attn.out_proj
norm_feed               ln_2                 layer_norm2
expand                  mlp.c_fc             mlp.fc1
contract                mlp.c_proj           mlp.fc2

[encoder]
stem                conv_in                       conv_in
norm_out            norm_out                      conv_norm_out
levels.*.blocks.*   down.{level}.block.{i}        down_blocks.{level}.resnets.{i}          picture
levels.*.down.conv  down.{level}.downsample.conv  down_blocks.{level}.downsamplers.0.conv
middle.0            mid.block_1                   mid_block.resnets.0                      picture
middle.1            mid.attn_1                    mid_block.attentions.0                   pixels
middle.2            mid.block_2                   mid_block.resnets.1                      picture

[decoder]
stem               conv_in                    conv_in
norm_out           norm_out                   conv_norm_out
mix_frames         conv_out.time_mix_conv     time_conv_out
levels.*.blocks.*  up.{height}.block.{i}      up_blocks.{level}.resnets.{i}        video
levels.*.up.conv   up.{height}.upsample.conv  up_blocks.{level}.upsamplers.0.conv
middle_in          mid.block_1                mid_block.resnets.0                  video
middle_attention   mid.attn_1                 mid_block.attentions.0               pixels
middle_out         mid.block_2                mid_block.resnets.1                  video

[video]
spatial    .           spatial_res_block      picture
temporal   time_stack  temporal_res_block     half
share.mix  mix_factor  time_mixer.mix_factor

[picture]
skip  nin_shortcut  conv_shortcut

[pixels]
norm   norm      group_norm
query  q         to_q
key    k         to_k
value  v         to_v
out    proj_out  to_out.0
"""
"""By kind of module: a part of ours, what Stability and diffusers call it ("-": has none, ".": adds nothing), and of
which kind it is, if its own parts have other names. What is not listed keeps its name. Numbers stand in braces, see
`_numbers`."""


@dataclass(frozen=True, slots=True)
class _Row:
    own: re.Pattern[str]
    published: dict[Naming, str]
    kind: str | None


@cache
def _table() -> dict[str, list[_Row]]:
    rows: dict[str, list[_Row]] = {}
    for section in _TABLE.strip().split("\n\n"):
        head, *lines = section.splitlines()
        parts = rows.setdefault(head[1:-1], [])
        for own, gcd, diffusers, *kind in map(str.split, lines):
            pattern = re.compile(re.escape(own).replace(r"\*", r"(\d+)") + r"(?:\.(?P<rest>.+))?")
            parts.append(_Row(pattern, {"gcd": gcd, "diffusers": diffusers}, kind[0] if kind else None))
    return rows


def _translated(name: str, kind: str, naming: Naming, levels: Levels) -> str | None:
    """The published name of a part of a module of that kind; None if there is none."""
    for row in _table()[kind]:
        match = row.own.fullmatch(name)
        if match is None:
            continue
        rest, template = match["rest"] or "", row.published[naming]
        if template == "-":
            return None
        place = "" if template == "." else template.format(**_numbers(match.groups()[:-1], levels))
        below = rest if row.kind is None else _translated(rest, row.kind, naming, levels)
        return None if below is None else f"{place}{'.' if below and place[-1:] not in ('', '/') else ''}{below}"
    return name


def _numbers(found: Sequence[str], levels: Levels) -> dict[str, int]:
    """What stands for the numbers of one of our names.

    Stability numbers the blocks of all levels through: the stem is block 0, and a level's resampling comes after its
    stages; up, it is appended to the last of them, after its transformer if it has one. Of its decoder's levels, the
    shallowest is 0.
    """
    level, i = ([int(number) for number in found] + [levels.unet_blocks, 0])[:2]
    block = level * (levels.unet_blocks + 1) + i
    return {
        "level": level,
        "i": i,
        "down": 1 + block,
        "up": block,
        "after": 1 + any(levels.attention[::-1][level : level + 1]),
        "height": levels.vae_levels - 1 - level,
    }
