"""Published names: a bijection, at full size and at others, and the facts the manifest's shapes cannot tell."""

from functools import lru_cache

import msgspec
import pytest
import torch
from naming import taken_apart
from published import SMALL_GCD, diffusers_manifest, fixed_view, manifest, shared_vae

from gcd_model.config import SVD_14, ModelConfig, UNetConfig
from gcd_model.errors import CheckpointError
from gcd_model.networks import empty_networks
from gcd_model.weights.infer import (
    Hints,
    Match,
    Naming,
    Shapes,
    diffusers_levels,
    gcd_levels,
    infer_config,
    match_weights,
)
from gcd_model.weights.names import Levels, Source, assembled, diffusers_source, gcd_source

UNET = "model.diffusion_model"
SVD_FIXED = fixed_view(SVD_14)
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


def matched(config: ModelConfig, shapes: Shapes, naming: Naming) -> Match:
    return match_weights(own_shapes(config), shapes, naming, Levels.of(config))


def used(match: Match) -> list[str]:
    return [name for source in match.sources.values() for name in source.names]


def counts(match: Match) -> dict[str, int]:
    return {kind: len(names) for kind, names in match.leftovers.items()}


@pytest.mark.parametrize("config", [SMALL_GCD, DEEP, SVD_14], ids=["small", "deep", "full"])
def test_no_two_parameters_share_a_published_name(config: ModelConfig) -> None:
    for naming, variant in ((gcd_source, config), (diffusers_source, shared_vae(config))):
        sources = [naming(name, Levels.of(variant)) for name in own_shapes(variant)]
        names = [name for source in sources if source is not None for name in source.names]
        assert None not in sources
        assert len(names) == len(set(names))


@pytest.mark.parametrize(
    ("shape", "source"),
    [
        ((6, 4), Source(("q", "k", "v"), "stacked")),
        ((5, 3), Source(("p",), "transposed")),
        ((5, 3, 1, 1), Source(("w",), "pixelwise")),
        ((5, 3, 3), Source(("w",))),
    ],
    ids=["stacked", "transposed", "pixelwise", "same"],
)
def test_a_tensor_taken_apart_and_assembled_is_itself(shape: tuple[int, ...], source: Source) -> None:
    tensor = torch.randn(shape)
    parts = taken_apart(tensor, source)
    assert list(parts) == list(source.names)
    torch.testing.assert_close(assembled(list(parts.values()), source.form), tensor, rtol=0, atol=0)


@pytest.mark.parametrize("config", [SMALL_GCD, DEEP], ids=["small", "deep"])
def test_the_architecture_is_told_by_names_and_shapes(config: ModelConfig) -> None:
    hints = Hints(head_width=config.unet.head_width)
    for naming, levels_of, variant in (
        (gcd_source, gcd_levels, config),
        (gcd_source, gcd_levels, fixed_view(config)),
        (diffusers_source, diffusers_levels, shared_vae(config)),
    ):
        shapes = published_shapes(variant, naming)
        assert infer_config(shapes, naming, levels_of(shapes), hints) == variant


def published_shapes(config: ModelConfig, naming: Naming) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    for name, shape in own_shapes(config).items():
        source = naming(name, Levels.of(config))
        assert source is not None
        shapes |= {n: tuple(t.shape) for n, t in taken_apart(torch.empty(shape, device="meta"), source).items()}
    return shapes


def test_the_gcd_checkpoint_fits_at_full_size() -> None:
    shapes = manifest("gcd_ckpt")
    assert infer_config(shapes, gcd_source, gcd_levels(shapes), Hints()) == SVD_14
    match = matched(SVD_14, shapes, gcd_source)
    assert len([name for name in used(match) if name.startswith(f"{UNET}.")]) == 1432
    assert len(used(match)) == 2306
    assert counts(match) == {"CLIP text tower": 6, "decoder of the condition VAE": 140, "LPIPS": 33}


def test_the_base_model_fits_at_full_size() -> None:
    shapes = manifest("svd_safetensors")
    assert infer_config(shapes, gcd_source, gcd_levels(shapes), Hints()) == SVD_FIXED
    match = matched(SVD_FIXED, shapes, gcd_source)
    assert len([name for name in used(match) if name.startswith(f"{UNET}.")]) == 1428
    assert counts(match) == {"CLIP text tower": 6, "decoder of the condition VAE": 140}


def test_the_diffusers_folder_fits_at_full_size() -> None:
    shapes = diffusers_manifest()
    config = shared_vae(SVD_14)
    assert infer_config(shapes, diffusers_source, diffusers_levels(shapes), Hints()) == config
    match = matched(config, shapes, diffusers_source)
    by_part = {part: len([n for n in used(match) if n.startswith(part)]) for part in ("unet/", "vae/", "image_")}
    assert by_part == {"unet/": 1428, "vae/": 374, "image_": 520}
    assert counts(match) == {"position numbers": 1}


@pytest.mark.parametrize(
    ("own", "gcd", "diffusers"),
    [
        (
            "decoder.levels.0.blocks.1.temporal.norm2.bias",
            "decoder.up.3.block.1.time_stack.out_layers.0.bias",
            "decoder.up_blocks.0.resnets.1.temporal_res_block.norm2.bias",
        ),
        (
            "decoder.levels.2.up.conv.bias",
            "decoder.up.1.upsample.conv.bias",
            "decoder.up_blocks.2.upsamplers.0.conv.bias",
        ),
        (
            "decoder.middle_out.share.mix",
            "decoder.mid.block_2.mix_factor",
            "decoder.mid_block.resnets.1.time_mixer.mix_factor",
        ),
        (
            "decoder.middle_attention.value.bias",
            "decoder.mid.attn_1.v.bias",
            "decoder.mid_block.attentions.0.to_v.bias",
        ),
        (
            "target_encoder.levels.1.blocks.0.skip.bias",
            "encoder.down.1.block.0.nin_shortcut.bias",
            "encoder.down_blocks.1.resnets.0.conv_shortcut.bias",
        ),
    ],
)
def test_autoencoder_names_of_equal_shape_are_told_apart(own: str, gcd: str, diffusers: str) -> None:
    levels = Levels.of(SVD_14)
    assert gcd_source(own, levels) == Source((f"first_stage_model.{gcd}",))
    assert diffusers_source(own, levels) == Source((f"vae/{diffusers}",))


def test_source_frames_go_through_the_condition_encoder_of_the_conditioner() -> None:
    levels = Levels.of(SVD_14)
    assert gcd_source("own_condition_encoder.quant.bias", levels) == Source(
        ("conditioner.embedders.3.encoder.quant_conv.bias",)
    )
    assert diffusers_source("target_encoder.quant.bias", levels) == Source(("vae/quant_conv.bias",))
    assert gcd_source("target_encoder.quant.bias", levels) is None
    assert diffusers_source("camera.proj.weight", levels) is None


def test_heads_follow_from_their_number_where_it_is_told() -> None:
    shapes = published_shapes(shared_vae(DEEP), diffusers_source)
    levels = diffusers_levels(shapes)
    assert infer_config(shapes, diffusers_source, levels, Hints(heads=(1, 2, 3))).unet.head_width == 32
    with pytest.raises(CheckpointError):
        infer_config(shapes, diffusers_source, levels, Hints(heads=2))


def test_what_names_and_shapes_do_not_tell_is_refused() -> None:
    small, deep = published_shapes(SMALL_GCD, gcd_source), published_shapes(DEEP, gcd_source)
    for shapes, hints in (
        (small | {f"{UNET}.input_blocks.0.0.weight": (16, 8, 3, 3)}, Hints()),  # no multiple of the groups
        (small | {"conditioner.embedders.5.proj.weight": (24, 9)}, Hints()),  # no camera control known
        (deep, Hints()),  # heads of no published width
        (deep, Hints(head_width=32, image_heads=7)),
    ):
        with pytest.raises(CheckpointError):
            infer_config(shapes, gcd_source, gcd_levels(shapes), hints)


@pytest.mark.parametrize(("features", "control"), [(13, "spherical"), (12, "relative_pose")])
def test_camera_control_is_told_by_the_number_of_features(features: int, control: str) -> None:
    shapes = published_shapes(SMALL_GCD, gcd_source) | {"conditioner.embedders.5.proj.weight": (24, features)}
    assert infer_config(shapes, gcd_source, gcd_levels(shapes), Hints()).camera == control


def test_a_made_up_block_number_costs_nothing() -> None:
    shapes = published_shapes(SMALL_GCD, gcd_source)
    huge = "conditioner.embedders.0.open_clip.model.visual.transformer.resblocks.99999999999.ln_1.weight"
    config = infer_config(shapes | {huge: (64,)}, gcd_source, gcd_levels([*shapes, huge]), Hints())
    assert config.image_encoder is not None
    assert config.image_encoder.layers == 3


def test_further_condition_channels_are_told_by_the_stem() -> None:
    shapes = published_shapes(SMALL_GCD, gcd_source) | {f"{UNET}.input_blocks.0.0.weight": (32, 11, 3, 3)}
    config = infer_config(shapes, gcd_source, gcd_levels(shapes), Hints())
    assert config.extra_condition_channels == 3
