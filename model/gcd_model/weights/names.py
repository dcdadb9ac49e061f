"""Published weight names and ours: pure renaming, one table for all published layouts.

`gcd_source(name, levels)` says where a parameter of `Networks` stands in a Lightning checkpoint of GCD or in
`svd.safetensors` (both use the names of Stability's code); `diffusers_source(name, levels)` where in a diffusers
folder, whose three parts we write as `unet/NAME`, `vae/NAME` and `image_encoder/NAME`. `Levels.of(config)` holds the
counts that block numbers depend on. `assembled` makes our tensor of the published ones.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, Self

import torch
from torch import Tensor

from gcd_model.config import ModelConfig

Form = Literal["same", "pixelwise", "transposed", "stacked"]
"""How the published tensors relate to ours.

pixelwise: a linear layer [C', C] is our 1x1 convolution [C', C, 1, 1]; biases stay. transposed: a matrix.
stacked: several tensors, joined along the first axis.
"""

GCD_UNET = "model.diffusion_model"
GCD_CLIP = "conditioner.embedders.0.open_clip.model"
GCD_IMAGE = f"{GCD_CLIP}.visual"
GCD_CONDITION_VAE = "conditioner.embedders.3.encoder"
GCD_CAMERA = "conditioner.embedders.5"
GCD_VAE = "first_stage_model"
IMAGE = "image_encoder/vision_model"


@dataclass(frozen=True, slots=True)
class Source:
    """Where one of our parameters comes from: published names, and what to do with their tensors."""

    names: tuple[str, ...]
    form: Form = "same"


@dataclass(frozen=True, slots=True)
class Levels:
    """The counts that published block numbers depend on.

    attention: for each U-Net level, shallowest first, whether it attends.
    """

    attention: tuple[bool, ...]
    unet_blocks: int
    vae_levels: int
    vae_blocks: int
    image_layers: int

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


@dataclass(frozen=True, slots=True)
class Row:
    """One module (or bare parameter) by its three names; "" where a layout has none.

    A stacked row's diffusers name has a gap for q, k and v.
    """

    own: str
    gcd: str
    diffusers: str
    form: Form = "same"

    def under(self, own: str, gcd: str, diffusers: str) -> "Row":
        """The row with all three names put below others."""
        return Row(_join(own, self.own), _join(gcd, self.gcd), _join(diffusers, self.diffusers), self.form)


def _join(above: str, below: str) -> str:
    return f"{above}.{below}" if above and below else above or below


def gcd_source(name: str, levels: Levels) -> Source | None:
    """Where Stability's names keep our parameter; None if they have no such parameter."""
    row, leaf = _find(name, levels)
    return Source((_join(row.gcd, leaf),)) if row is not None and row.gcd else None


def diffusers_source(name: str, levels: Levels) -> Source | None:
    """Where a diffusers folder keeps our parameter; None if it has no such parameter."""
    row, leaf = _find(name, levels)
    if row is None or not row.diffusers:
        return None
    if row.form == "stacked":
        return Source(tuple(row.diffusers.format(part) for part in "qkv"), "stacked")
    form: Form = "same" if row.form == "pixelwise" and leaf == "bias" else row.form
    return Source((_join(row.diffusers, leaf),), form)


def own_source(name: str, levels: Levels) -> Source | None:
    """Our own files keep our names."""
    del levels
    return Source((name,))


def assembled(tensors: Sequence[Tensor], form: Form) -> Tensor:
    """Our tensor made of the published ones; a view wherever that is possible."""
    if form == "stacked":
        return torch.cat(tuple(tensors))
    if form == "transposed":
        return tensors[0].T
    if form == "pixelwise" and tensors[0].ndim == 2:
        return tensors[0][..., None, None]
    return tensors[0]


def _find(name: str, levels: Levels) -> tuple[Row | None, str]:
    """The row of a parameter, and what its name adds to the row's; no row for what is ours alone."""
    table = _table(levels)
    if name in table:
        return table[name], ""
    module, _, leaf = name.rpartition(".")
    return table.get(module), leaf


@lru_cache(maxsize=8)
def _table(levels: Levels) -> dict[str, Row]:
    rows = (*_unet_rows(levels), *_image_rows(levels), *_vae_rows(levels), Row("camera.proj", f"{GCD_CAMERA}.proj", ""))
    return {row.own: row for row in rows}


# --- the U-Net -----------------------------------------------------------------------------------------------------

_RES = (
    Row("norm1", "in_layers.0", "norm1"),
    Row("conv1", "in_layers.2", "conv1"),
    Row("embed", "emb_layers.1", "time_emb_proj"),
    Row("norm2", "out_layers.0", "norm2"),
    Row("conv2", "out_layers.3", "conv2"),
    Row("skip", "skip_connection", "conv_shortcut"),
)
_STAGE = (
    *(row.under("res.spatial", "", "spatial_res_block") for row in _RES),
    *(row.under("res.temporal", "time_stack", "temporal_res_block") for row in _RES),
    Row("res.share.mix", "time_mixer.mix_factor", "time_mixer.mix_factor"),
)
_BLOCK = tuple(
    Row(own, published, published)
    for own, published in {
        "norm_first": "norm_in",
        "feed_first.expand": "ff_in.net.0.proj",
        "feed_first.contract": "ff_in.net.2",
        "norm_attention": "norm1",
        "attention.query": "attn1.to_q",
        "attention.key": "attn1.to_k",
        "attention.value": "attn1.to_v",
        "attention.out": "attn1.to_out.0",
        "token.dormant.norm_weight": "norm2.weight",
        "token.dormant.norm_bias": "norm2.bias",
        "token.dormant.query": "attn2.to_q.weight",
        "token.dormant.key": "attn2.to_k.weight",
        "token.value": "attn2.to_v",
        "token.out": "attn2.to_out.0",
        "norm_feed": "norm3",
        "feed.expand": "ff.net.0.proj",
        "feed.contract": "ff.net.2",
    }.items()
)
_TRANSFORMER = (
    Row("norm", "norm", "norm"),
    Row("proj_in", "proj_in", "proj_in"),
    *(row.under("spatial", "transformer_blocks.0", "transformer_blocks.0") for row in _BLOCK),
    Row("positions.mlp.0", "time_pos_embed.0", "time_pos_embed.linear_1"),
    Row("positions.mlp.2", "time_pos_embed.2", "time_pos_embed.linear_2"),
    *(row.under("temporal", "time_stack.0", "temporal_transformer_blocks.0") for row in _BLOCK),
    Row("share.mix", "time_mixer.mix_factor", "time_mixer.mix_factor"),
    Row("proj_out", "proj_out", "proj_out"),
)
_UNET_ENDS = (
    Row("embed_noise.0", "time_embed.0", "time_embedding.linear_1"),
    Row("embed_noise.2", "time_embed.2", "time_embedding.linear_2"),
    Row("embed_vector.0", "label_emb.0.0", "add_embedding.linear_1"),
    Row("embed_vector.2", "label_emb.0.2", "add_embedding.linear_2"),
    Row("stem", "input_blocks.0.0", "conv_in"),
    Row("norm_out", "out.0", "conv_norm_out"),
    Row("conv_out", "out.2", "conv_out"),
)


def _unet_rows(levels: Levels) -> Iterator[Row]:
    for layer in (0, 2):  # the camera vector's own embedding: GCD adds it, diffusers has none
        yield Row(f"unet.embed_camera.{layer}", f"{GCD_UNET}.aux_label_emb.{layer}", "")
    for row in (*_UNET_ENDS, *_down_rows(levels), *_middle_rows(), *_up_rows(levels)):
        yield Row(f"unet.{row.own}", f"{GCD_UNET}.{row.gcd}", f"unet/{row.diffusers}", row.form)


def _stage_rows(own: str, gcd: str, diffusers: str, index: int) -> Iterator[Row]:
    """gcd: the numbered block; diffusers: the level, which lists residual blocks and transformers apart."""
    yield from (row.under(own, f"{gcd}.0", f"{diffusers}.resnets.{index}") for row in _STAGE)
    yield from (row.under(f"{own}.attention", f"{gcd}.1", f"{diffusers}.attentions.{index}") for row in _TRANSFORMER)


def _down_rows(levels: Levels) -> Iterator[Row]:
    """Block 0 is the stem; each level has its stages and then, but for the last, the down-sampling."""
    per_level = levels.unet_blocks + 1
    for level in range(len(levels.attention)):
        first, place = 1 + level * per_level, f"down_blocks.{level}"
        for i in range(levels.unet_blocks):
            yield from _stage_rows(f"down.{level}.stages.{i}", f"input_blocks.{first + i}", place, i)
        last = first + levels.unet_blocks
        yield Row(f"down.{level}.down.conv", f"input_blocks.{last}.0.op", f"{place}.downsamplers.0.conv")


def _middle_rows() -> Iterator[Row]:
    yield from _stage_rows("middle.0", "middle_block", "mid_block", 0)
    yield from (row.under("middle.1", "middle_block.2", "mid_block.resnets.1") for row in _STAGE)


def _up_rows(levels: Levels) -> Iterator[Row]:
    """Deepest level first; the up-sampling is appended to a level's last block, after its transformer if it has one."""
    per_level = levels.unet_blocks + 1
    for up, attends in enumerate(reversed(levels.attention)):
        first, place = up * per_level, f"up_blocks.{up}"
        for i in range(per_level):
            yield from _stage_rows(f"up.{up}.stages.{i}", f"output_blocks.{first + i}", place, i)
        last = f"output_blocks.{first + levels.unet_blocks}.{2 if attends else 1}.conv"
        yield Row(f"up.{up}.up.conv", last, f"{place}.upsamplers.0.conv")


# --- the image tower -----------------------------------------------------------------------------------------------

_IMAGE_ENDS = (
    Row("patches", f"{GCD_IMAGE}.conv1", f"{IMAGE}.embeddings.patch_embedding"),
    Row("class_token", f"{GCD_IMAGE}.class_embedding", f"{IMAGE}.embeddings.class_embedding"),
    Row("positions", f"{GCD_IMAGE}.positional_embedding", f"{IMAGE}.embeddings.position_embedding.weight"),
    Row("norm_in", f"{GCD_IMAGE}.ln_pre", f"{IMAGE}.pre_layrnorm"),
    Row("norm_out", f"{GCD_IMAGE}.ln_post", f"{IMAGE}.post_layernorm"),
    Row("projection", f"{GCD_IMAGE}.proj", "image_encoder/visual_projection.weight", "transposed"),
)
_IMAGE_LAYER = (
    Row("norm_attention", "ln_1", "layer_norm1"),
    Row("out", "attn.out_proj", "self_attn.out_proj"),
    Row("norm_feed", "ln_2", "layer_norm2"),
    Row("expand", "mlp.c_fc", "mlp.fc1"),
    Row("contract", "mlp.c_proj", "mlp.fc2"),
)


def _image_rows(levels: Levels) -> Iterator[Row]:
    yield from (row.under("image_encoder", "", "") for row in _IMAGE_ENDS)
    for i in range(levels.image_layers):
        own, gcd = f"image_encoder.layers.{i}", f"{GCD_IMAGE}.transformer.resblocks.{i}"
        diffusers = f"{IMAGE}.encoder.layers.{i}"
        yield from (row.under(own, gcd, diffusers) for row in _IMAGE_LAYER)
        for leaf in ("weight", "bias"):  # one matrix, whose names end in no module, or three modules
            apart = diffusers + ".self_attn.{}_proj." + leaf
            yield Row(f"{own}.query_key_value.{leaf}", f"{gcd}.attn.in_proj_{leaf}", apart, "stacked")


# --- the autoencoders ----------------------------------------------------------------------------------------------

_IMAGE_RES = (
    *(Row(name, name, name) for name in ("norm1", "conv1", "norm2", "conv2")),
    Row("skip", "nin_shortcut", "conv_shortcut"),
)
_VIDEO_RES = (
    *(row.under("spatial", "", "spatial_res_block") for row in _IMAGE_RES),
    *(row.under("temporal", "time_stack", "temporal_res_block") for row in _RES),
    Row("share.mix", "mix_factor", "time_mixer.mix_factor"),
)
_PIXEL_ATTENTION = (
    Row("norm", "norm", "group_norm"),
    Row("query", "q", "to_q", "pixelwise"),
    Row("key", "k", "to_k", "pixelwise"),
    Row("value", "v", "to_v", "pixelwise"),
    Row("out", "proj_out", "to_out.0", "pixelwise"),
)
_CODER_ENDS = (
    Row("stem", "conv_in", "conv_in"),
    Row("norm_out", "norm_out", "conv_norm_out"),
    Row("conv_out", "conv_out", "conv_out"),
)


def _vae_rows(levels: Levels) -> Iterator[Row]:
    encoder = list(_encoder_rows(levels))
    yield from (row.under("target_encoder", f"{GCD_VAE}.encoder", "vae/encoder") for row in encoder)
    yield Row("target_encoder.quant", "", "vae/quant_conv")
    for row in (*encoder, Row("quant", "quant_conv", "")):  # diffusers has no second encoder
        below = f"{GCD_CONDITION_VAE}." + ("" if row.own == "quant" else "encoder.")
        yield Row(f"own_condition_encoder.{row.own}", below + row.gcd, "")
    yield from (row.under("decoder", f"{GCD_VAE}.decoder", "vae/decoder") for row in _decoder_rows(levels))


def _encoder_rows(levels: Levels) -> Iterator[Row]:
    yield from _CODER_ENDS
    for level in range(levels.vae_levels):
        own, gcd, diffusers = f"levels.{level}", f"down.{level}", f"down_blocks.{level}"
        for i in range(levels.vae_blocks):
            place = (f"{own}.blocks.{i}", f"{gcd}.block.{i}", f"{diffusers}.resnets.{i}")
            yield from (row.under(*place) for row in _IMAGE_RES)
        yield Row(f"{own}.down.conv", f"{gcd}.downsample.conv", f"{diffusers}.downsamplers.0.conv")
    yield from _vae_middle_rows(("middle.0", "middle.1", "middle.2"), _IMAGE_RES)


def _vae_middle_rows(own: tuple[str, str, str], res: Sequence[Row]) -> Iterator[Row]:
    yield from (row.under(own[0], "mid.block_1", "mid_block.resnets.0") for row in res)
    yield from (row.under(own[1], "mid.attn_1", "mid_block.attentions.0") for row in _PIXEL_ATTENTION)
    yield from (row.under(own[2], "mid.block_2", "mid_block.resnets.1") for row in res)


def _decoder_rows(levels: Levels) -> Iterator[Row]:
    """Ours and diffusers count levels from the deepest, Stability's from the shallowest."""
    yield from (*_CODER_ENDS, Row("mix_frames", "conv_out.time_mix_conv", "time_conv_out"))
    for up in range(levels.vae_levels):
        gcd = f"up.{levels.vae_levels - 1 - up}"
        for i in range(levels.vae_blocks + 1):
            place = (f"levels.{up}.blocks.{i}", f"{gcd}.block.{i}", f"up_blocks.{up}.resnets.{i}")
            yield from (row.under(*place) for row in _VIDEO_RES)
        yield Row(f"levels.{up}.up.conv", f"{gcd}.upsample.conv", f"up_blocks.{up}.upsamplers.0.conv")
    yield from _vae_middle_rows(("middle_in", "middle_attention", "middle_out"), _VIDEO_RES)
