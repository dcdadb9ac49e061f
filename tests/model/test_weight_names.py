"""Published names: a bijection, at full size and at others, and the facts the manifest's shapes cannot tell."""

from functools import lru_cache

import msgspec
import pytest
import torch
from published import HEADS, SMALL_GCD, fixed_view, manifest, shared_vae

from gcd_model.config import SVD_14, ModelConfig, UNetConfig
from gcd_model.errors import CheckpointError
from gcd_model.networks import empty_networks
from gcd_model.weights.card import Hints
from gcd_model.weights.infer import Shapes, infer_config, match_weights
from gcd_model.weights.names import Levels, Naming, assembled, published_names, published_shape, taken_apart

UNET = "model.diffusion_model"
STEM, CAMERA = f"{UNET}.input_blocks.0.0.weight", "conditioner.embedders.5.proj.weight"
SMALL_HEADS = Hints(**HEADS)
DEEP = msgspec.structs.replace(
    SMALL_GCD,
    unet=UNetConfig(
        width=32,
        multipliers=(1, 2, 3),
        attention=(True, False, True),
        blocks_per_level=3,
        embedding_width=64,
        head_width=32,
        context_width=48,
        vector_width=48,
        camera_width=24,
    ),
)
"""Other numbers of levels and blocks than published, and a level without attention between two with."""


@lru_cache
def own_shapes(config: ModelConfig) -> dict[str, tuple[int, ...]]:
    return {name: tuple(tensor.shape) for name, tensor in empty_networks(config).state_dict().items()}


def sources_of(config: ModelConfig, naming: Naming) -> dict[str, tuple[str, ...]]:
    return {name: published_names(name, naming, Levels.of(config)) for name in own_shapes(config)}


def published_shapes(config: ModelConfig, naming: Naming) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    for name, names in sources_of(config, naming).items():
        parts = taken_apart(names, torch.empty(own_shapes(config)[name], device="meta"))
        shapes |= {published: tuple(part.shape) for published, part in parts.items()}
    return shapes


@pytest.mark.parametrize("config", [SMALL_GCD, DEEP, SVD_14], ids=["small", "deep", "full"])
def test_no_two_parameters_share_a_published_name(config: ModelConfig) -> None:
    for naming, variant in (("gcd", config), ("diffusers", shared_vae(config))):
        sources = sources_of(variant, naming).values()
        names = [name for source in sources for name in source]
        assert all(sources)
        assert len(names) == len(set(names))


@pytest.mark.parametrize(
    ("shape", "names"),
    [
        ((6, 4), ("q", "k", "v")),
        ((5, 3), ("image_encoder/visual_projection.weight",)),
        ((5, 3, 1, 1), ("vae/decoder.mid_block.attentions.0.to_q.weight",)),
        ((5, 3, 1, 1), ("w",)),
    ],
    ids=["stacked", "transposed", "pixelwise", "same"],
)
def test_a_tensor_taken_apart_and_assembled_is_itself(shape: tuple[int, ...], names: tuple[str, ...]) -> None:
    tensor = torch.randn(shape)
    parts = taken_apart(names, tensor)
    assert list(parts) == list(names)
    assert torch.equal(assembled(names, list(parts.values()), tensor.ndim), tensor)
    assert {published_shape(names, shape, part.ndim) for part in parts.values()} == {
        tuple(part.shape) for part in parts.values()
    }


@pytest.mark.parametrize("config", [SMALL_GCD, DEEP], ids=["small", "deep"])
def test_the_architecture_is_told_by_names_and_shapes(config: ModelConfig) -> None:
    hints = Hints(head_width=config.unet.head_width, image_heads=16)
    for naming, variant in (("gcd", config), ("gcd", fixed_view(config)), ("diffusers", shared_vae(config))):
        assert infer_config(published_shapes(variant, naming), naming, hints) == variant


@pytest.mark.parametrize(
    ("file", "naming", "config", "weights", "leftovers"),
    [
        (
            "gcd_ckpt",
            "gcd",
            SVD_14,
            {f"{UNET}.": 1432, "": 2306},
            {"CLIP text tower": 6, "decoder of the condition VAE": 140, "LPIPS": 33},
        ),
        (
            "svd_safetensors",
            "gcd",
            fixed_view(SVD_14),
            {f"{UNET}.": 1428},
            {"CLIP text tower": 6, "decoder of the condition VAE": 140},
        ),
        (
            "diffusers",
            "diffusers",
            shared_vae(SVD_14),
            {"unet/": 1428, "vae/": 374, "image_": 520},
            {"position numbers": 1},
        ),
    ],
)
def test_published_files_fit_at_full_size_and_tell_their_heads(
    file: str, naming: Naming, config: ModelConfig, weights: dict[str, int], leftovers: dict[str, int]
) -> None:
    shapes = manifest(file)
    assert infer_config(shapes, naming, Hints()) == config
    sources = sources_of(config, naming)
    left = match_weights(sources, own_shapes(config), shapes)
    used = [name for names in sources.values() for name in names]
    assert {start: sum(name.startswith(start) for name in used) for start in weights} == weights
    assert {kind: len(names) for kind, names in left.items()} == leftovers


@pytest.mark.parametrize(
    ("own", "gcd", "diffusers"),
    [
        (
            "decoder.levels.0.blocks.1.temporal.norm2.bias",
            "first_stage_model.decoder.up.3.block.1.time_stack.out_layers.0.bias",
            "vae/decoder.up_blocks.0.resnets.1.temporal_res_block.norm2.bias",
        ),
        (
            "decoder.levels.2.up.conv.bias",
            "first_stage_model.decoder.up.1.upsample.conv.bias",
            "vae/decoder.up_blocks.2.upsamplers.0.conv.bias",
        ),
        (
            "decoder.middle_out.share.mix",
            "first_stage_model.decoder.mid.block_2.mix_factor",
            "vae/decoder.mid_block.resnets.1.time_mixer.mix_factor",
        ),
        (
            "decoder.middle_attention.value.bias",
            "first_stage_model.decoder.mid.attn_1.v.bias",
            "vae/decoder.mid_block.attentions.0.to_v.bias",
        ),
        (
            "target_encoder.levels.1.blocks.0.skip.bias",
            "first_stage_model.encoder.down.1.block.0.nin_shortcut.bias",
            "vae/encoder.down_blocks.1.resnets.0.conv_shortcut.bias",
        ),
        ("target_encoder.quant.bias", None, "vae/quant_conv.bias"),
        ("own_condition_encoder.quant.bias", "conditioner.embedders.3.encoder.quant_conv.bias", None),
        ("camera.proj.weight", CAMERA, None),
    ],
)
def test_names_of_equal_shape_are_told_apart(own: str, gcd: str | None, diffusers: str | None) -> None:
    for naming, name in (("gcd", gcd), ("diffusers", diffusers)):
        assert published_names(own, naming, Levels.of(SVD_14)) == (() if name is None else (name,))


def test_heads_follow_from_their_number_where_it_is_told() -> None:
    shapes = published_shapes(shared_vae(DEEP), "diffusers")
    hints = Hints(heads=(1, 2, 3), image_heads=16)
    assert infer_config(shapes, "diffusers", hints).unet.head_width == 32
    for heads in (2, (1, 2), (0, 0, 0)):
        with pytest.raises(CheckpointError):
            infer_config(shapes, "diffusers", Hints(heads=heads, image_heads=16))


SMALL = published_shapes(SMALL_GCD, "gcd")


@pytest.mark.parametrize(
    ("shapes", "hints"),
    [
        (SMALL | {STEM: (16, 8, 3, 3)}, SMALL_HEADS),  # no multiple of the groups
        (SMALL | {STEM: (32, 11, 3, 3)}, SMALL_HEADS),  # more condition channels than latents have
        (SMALL | {CAMERA: (24, 9)}, SMALL_HEADS),  # no camera control known
        (SMALL, Hints(head_width=64)),  # heads are never guessed
        (SMALL, Hints(image_heads=16)),
        (SMALL, Hints(head_width=48, image_heads=16)),
        (SMALL, Hints(head_width=64, image_heads=7)),
    ],
)
def test_what_names_and_shapes_do_not_tell_is_refused(shapes: Shapes, hints: Hints) -> None:
    with pytest.raises(CheckpointError):
        infer_config(shapes, "gcd", hints)


def test_camera_control_is_told_by_shapes() -> None:
    for features, control in ((13, "spherical"), (12, "relative_pose")):
        config = infer_config(SMALL | {CAMERA: (24, features)}, "gcd", SMALL_HEADS)
        assert config.camera == control


def test_a_made_up_block_number_costs_nothing() -> None:
    huge = "conditioner.embedders.0.open_clip.model.visual.transformer.resblocks.99999999999.ln_1.weight"
    config = infer_config(SMALL | {huge: (64,)}, "gcd", SMALL_HEADS)
    assert config.image_encoder is not None
    assert config.image_encoder.layers == 3
