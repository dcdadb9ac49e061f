"""From the names and shapes of published weights to a config, and each of our parameters to its place among them.

Pure: tensors are never looked into. What names and shapes do not tell (heads) is told or refused, never guessed.
"""

import re
from collections.abc import Callable, Iterable, Mapping

from msgspec.structs import replace
from torch import Tensor

from gcd_model.config import (
    CAMERA_FEATURES,
    SVD_14,
    CameraControl,
    ImageEncoderConfig,
    ModelConfig,
    UNetConfig,
    VAEConfig,
)
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.weights.card import Family, Hints
from gcd_model.weights.names import Levels, Naming, published_names, published_shape

Shapes = Mapping[str, tuple[int, ...]]
"""Names and their shapes."""

_PUBLISHED_GROUPS = UNetConfig().norm_groups  # of every group norm, in the VAE too


def shapes_of(tensors: Mapping[str, Tensor]) -> Shapes:
    """Names and shapes."""
    return {name: tuple(tensor.shape) for name, tensor in tensors.items()}


RELEASED = Hints(head_width=SVD_14.unet.head_width, image_heads=16)
"""What the released code builds, whatever the widths."""


def levels_of(names: Iterable[str], naming: Naming) -> Levels:
    """The counts behind a layout's block numbers. Attention is not known yet: see `infer_config`."""
    names = list(names)

    def count(pattern: str) -> int:  # distinct numbers, so that a made-up huge number counts once
        return len({match[1] for match in map(re.compile(pattern).match, names) if match is not None})

    if naming == "diffusers":
        levels, blocks = count(r"unet/down_blocks\.(\d+)\."), count(r"unet/down_blocks\.0\.resnets\.(\d+)\.")
        vae, res, tower = r"vae/encoder\.down_blocks", "resnets", r"image_encoder/vision_model\.encoder\.layers"
    else:
        inputs = r"model\.diffusion_model\.input_blocks\.(\d+)\."
        levels = 1 + count(inputs + r"0\.op\.")
        blocks = max(1, count(inputs) // levels - 1)  # each level has one more: the stem, then the resampling before it
        vae, res = r"first_stage_model\.encoder\.down", "block"
        tower = r"conditioner\.embedders\.0\.open_clip\.model\.visual\.transformer\.resblocks"
    return Levels(
        attention=(False,) * levels,
        unet_blocks=blocks,
        vae_levels=count(rf"{vae}\.(\d+)\."),
        vae_blocks=count(rf"{vae}\.0\.{res}\.(\d+)\."),
        image_layers=count(rf"{tower}\.(\d+)\."),
    )


def infer_config(shapes: Shapes, naming: Naming, hints: Hints) -> ModelConfig:
    """The config of published weights, at the size and with the guidance of their family.

    Raises CheckpointError: a weight the architecture hangs on is missing, the published rules do not give one, or the
    number of heads is not told.
    """
    levels = levels_of(shapes, naming)

    def found(name: str, axis: int) -> int | None:
        """One side of a published tensor, by our name; None where it is absent."""
        published = published_names(name, naming, levels)
        shape = shapes.get(published[0], ()) if published else ()
        return shape[axis] if axis < len(shape) and shape[axis] > 0 else None

    def size(name: str, axis: int) -> int:
        if (side := found(name, axis)) is None:
            place = published_names(name, naming, levels)[0]
            raise CheckpointError(f"1 weight that tells the architecture is missing or misshapen: {place}")
        return side

    places = [f"unet.down.{level}.stages.0" for level in range(len(levels.attention))]
    width, latent_channels = size("unet.stem.weight", 0), size("unet.conv_out.weight", 0)
    widths = tuple(size(f"{place}.res.spatial.conv2.weight", 0) for place in places)
    attention = tuple(found(f"{place}.attention.proj_in.weight", 0) is not None for place in places)
    places = [f"target_encoder.levels.{level}.blocks.0" for level in range(levels.vae_levels)]
    pixels, vae_widths = size("target_encoder.stem.weight", 0), tuple(size(f"{p}.conv2.weight", 0) for p in places)
    camera_width = found("unet.embed_camera.0.weight", 1) or 0
    token = found("unet.middle.0.attention.spatial.token.value.weight", 1)
    try:
        unet = UNetConfig(
            latent_channels=latent_channels,
            condition_channels=size("unet.stem.weight", 1) - latent_channels,
            width=width,
            multipliers=_multipliers("the U-Net", width, widths),
            attention=attention,
            blocks_per_level=levels.unet_blocks,
            embedding_width=size("unet.embed_noise.0.weight", 0),
            head_width=_head_width(attention, widths, hints),
            context_width=token,
            vector_width=size("unet.embed_vector.0.weight", 1),
            camera_width=camera_width,
        )
        vae = VAEConfig(
            latent_channels=size("target_encoder.conv_out.weight", 0) // 2,
            width=pixels,
            multipliers=_multipliers("the VAE", pixels, vae_widths),
            blocks_per_level=levels.vae_blocks,
            scale=VAEConfig().scale if hints.latent_scale is None else hints.latent_scale,
            shared=naming == "diffusers",
        )
        config = ModelConfig(
            frames=hints.frames or SVD_14.frames,
            camera=_camera_control(camera_width, found("camera.proj.weight", 1)),
            unet=unet,
            vae=vae,
            image_encoder=None if token is None else _image_encoder(found, size, token, levels.image_layers, hints),
        )
    except OptionError as error:
        raise CheckpointError(f"the weights fit no architecture known here: {error}") from error
    return config if hints.family is None else _at_trained_size(config, hints.family)


def _at_trained_size(config: ModelConfig, family: Family) -> ModelConfig:
    sampling = replace(config.sampling, guidance=family.guidance)
    return replace(config, height=family.height, width=family.width, sampling=sampling)


def _multipliers(what: str, width: int, widths: tuple[int, ...]) -> tuple[int, ...]:
    if any(level % width for level in widths) or width % _PUBLISHED_GROUPS:
        raise CheckpointError(
            f"{what} has level widths {list(widths)} over {width}; published layouts have multiples of "
            f"{_PUBLISHED_GROUPS}, the groups of every group norm. Use our own format for other networks"
        )
    return tuple(level // width for level in widths)


def _head_width(attends: tuple[bool, ...], widths: tuple[int, ...], hints: Hints) -> int:
    """The given head width, or the published one of published widths."""
    if hints.head_width is not None:
        return hints.head_width
    if hints.heads is not None:
        heads = (hints.heads,) * len(widths) if isinstance(hints.heads, int) else hints.heads
        if len(heads) == len(widths) and min(heads) > 0:
            there = zip(widths, heads, (*attends[:-1], True), strict=True)  # the middle, as the deepest level, attends
            found = {width / number for width, number, attending in there if attending}
            if len(found) == 1 and (head_width := found.pop()).is_integer():
                return int(head_width)
        raise CheckpointError(f"config.json's heads {heads} over widths {widths} are not of one width; {_GIVE_WIDTH}")
    if widths == SVD_14.unet.widths:
        return SVD_14.unet.head_width
    raise CheckpointError(f"a U-Net of widths {list(widths)} does not tell its attention heads; {_GIVE_WIDTH}")


_STATED = "; `gcd-node weights convert` writes a file that states it"
_GIVE_WIDTH = f"give the width of one with --head-width{_STATED}"


def _camera_control(camera_width: int, features: int | None) -> CameraControl:
    """The control whose number of features the camera embedder takes."""
    if not camera_width or features is None:
        return "spherical" if camera_width else "none"  # of a camera with half its weights, the check names the rest
    for control, count in CAMERA_FEATURES.items():
        if features == count:
            return control
    raise CheckpointError(
        f"the camera embedder takes {features} numbers; known are 13 (angles and radius) and 12 (relative pose)"
    )


def _image_encoder(
    found: Callable[[str, int], int | None],
    size: Callable[[str, int], int],
    output_width: int,
    layers: int,
    hints: Hints,
) -> ImageEncoderConfig:
    """Of a U-Net with cross-attention; the published one where it is absent, whose weights are found missing later."""
    tokens, published = found("image_encoder.positions", 0), ImageEncoderConfig(output_width=output_width)
    if tokens is None:
        return published
    patch, width = size("image_encoder.patches.weight", 2), size("image_encoder.patches.weight", 0)
    if hints.image_heads is None and width != published.width:
        raise CheckpointError(
            f"an image tower {width} wide does not tell its attention heads; give their number with "
            f"--image-heads{_STATED}"
        )
    return replace(
        published,
        image_size=round((tokens - 1) ** 0.5) * patch,
        patch=patch,
        width=width,
        layers=layers,
        heads=hints.image_heads or published.heads,
        hidden_width=size("image_encoder.layers.0.expand.weight", 0),
    )


# --- strict matching: nothing missing, nothing unknown, all of one shape ---------------------------------------------


_FIRST = 5  # names an error lists

LEFTOVERS = {
    "CLIP text tower": r"conditioner\.embedders\.0\.open_clip\.model\.(positional_embedding|text_projection|logit_scale"
    r"|attn_mask|token_embedding\.weight|ln_final\.(weight|bias)|transformer\..+)",
    "decoder of the condition VAE": r"conditioner\.embedders\.3\.encoder\.(decoder|post_quant_conv)\..+",
    "LPIPS": r"lpips\..+",
    "EMA": r"model_ema\..+",
    "noise table": r"denoiser\.sigmas",
    "position numbers": r"image_encoder/vision_model\.embeddings\.position_ids",
}
"""Published weights that inference does not use, by the whole name. Anything else that is left over is an error."""


def match_weights(sources: Mapping[str, tuple[str, ...]], expected: Shapes, shapes: Shapes) -> dict[str, list[str]]:
    """Whether a file holds exactly what is expected of it.

    Args:
        sources: for each of our names, the file's; see `published_names`. expected: our names and shapes.
        shapes: those of the file.
    Returns:
        Names that stay behind, by the kinds of LEFTOVERS that occur.
    Raises:
        CheckpointError: says how many weights are missing, unknown and misshapen, and the first five of each.
    """
    missing = [each for names in sources.values() for each in names if each not in shapes]
    misshapen: list[str] = []
    for name, names in sources.items():
        given = [shapes[each] for each in names if each in shapes]
        published = published_shape(names, expected[name], len(given[0]) if given else 0)
        if len(given) == len(names) and any(shape != published for shape in given):
            misshapen.append(f"{names[0]} wants {list(published)}, got {list(given[0])}")
    used = {each for names in sources.values() for each in names}
    leftovers: dict[str, list[str]] = {}
    unknown: list[str] = []
    for name in (name for name in shapes if name not in used):
        kind = next((kind for kind, pattern in LEFTOVERS.items() if re.fullmatch(pattern, name)), None)
        (unknown if kind is None else leftovers.setdefault(kind, [])).append(name)
    faults = [
        f"{len(names)} {what}, first: {', '.join(names[:_FIRST])}"
        for what, names in (
            (f"of {len(expected)} weights are missing", missing),
            (f"of {len(expected)} weights are misshapen", misshapen),
            ("unexpected names", unknown),
        )
        if names
    ]
    if faults:
        raise CheckpointError(f"{'; '.join(faults)}. Nothing was loaded: it is damaged, or of another architecture")
    return leftovers
