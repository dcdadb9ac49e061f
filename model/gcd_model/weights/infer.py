"""From the names and shapes of published weights to a config, and each of our parameters to its place among them.

Pure: tensors are never looked into.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from gcd_model.config import CAMERA_FEATURES, CameraControl, ImageEncoderConfig, ModelConfig, UNetConfig, VAEConfig
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.weights.names import GCD_CONDITION_VAE, GCD_IMAGE, GCD_UNET, GCD_VAE, IMAGE, Levels, Source, assembled

Shapes = Mapping[str, tuple[int, ...]]
"""Published names and their shapes."""

Naming = Callable[[str, Levels], Source | None]
"""Where a layout keeps a parameter of ours: `gcd_source` or `diffusers_source`."""

NO_LEVELS = Levels(attention=(), unet_blocks=0, vae_levels=0, vae_blocks=0, image_layers=0)
"""For names that no block numbers stand in."""

PUBLISHED_GROUPS, PUBLISHED_HEAD_WIDTH, PUBLISHED_IMAGE_HEADS, PUBLISHED_FRAMES = 32, 64, 16, 14


def shapes_of(tensors: Mapping[str, Tensor]) -> Shapes:
    """Names and shapes."""
    return {name: tuple(tensor.shape) for name, tensor in tensors.items()}


@dataclass(frozen=True, kw_only=True, slots=True)
class Hints:
    """What neither names nor shapes tell; None means as published.

    head_width: channels of an attention head of the U-Net; or heads: their number, one for all levels or one each.
    image_heads: attention heads of the image tower. frames: T. latent_scale: see `VAEConfig.scale`.
    """

    head_width: int | None = None
    heads: int | tuple[int, ...] | None = None
    image_heads: int | None = None
    frames: int | None = None
    latent_scale: float | None = None

    def __post_init__(self) -> None:
        for name, least in (("head_width", 1), ("image_heads", 1), ("frames", 2)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise OptionError(f"{name} must be at least {least}, got {value}")


def gcd_levels(names: Iterable[str]) -> Levels:
    """The counts behind Stability's block numbers. Attention is not known yet: see `infer_config`."""
    names = list(names)
    inputs, vae = rf"{re.escape(GCD_UNET)}\.input_blocks\.", rf"{re.escape(GCD_VAE)}\.encoder\.down\."
    downs = sorted(_numbers(names, inputs + r"(\d+)\.0\.op\."))
    blocks = (downs[0] if downs else len(_numbers(names, inputs + r"(\d+)\."))) - 1
    return Levels(
        attention=(False,) * (len(downs) + 1),
        unet_blocks=max(blocks, 1),
        vae_levels=len(_numbers(names, vae + r"(\d+)\.")),
        vae_blocks=len(_numbers(names, vae + r"0\.block\.(\d+)\.")),
        image_layers=len(_numbers(names, rf"{re.escape(GCD_IMAGE)}\.transformer\.resblocks\.(\d+)\.")),
    )


def diffusers_levels(names: Iterable[str]) -> Levels:
    """The same for a diffusers folder."""
    names = list(names)
    return Levels(
        attention=(False,) * len(_numbers(names, r"unet/down_blocks\.(\d+)\.")),
        unet_blocks=len(_numbers(names, r"unet/down_blocks\.0\.resnets\.(\d+)\.")),
        vae_levels=len(_numbers(names, r"vae/encoder\.down_blocks\.(\d+)\.")),
        vae_blocks=len(_numbers(names, r"vae/encoder\.down_blocks\.0\.resnets\.(\d+)\.")),
        image_layers=len(_numbers(names, rf"{re.escape(IMAGE)}\.encoder\.layers\.(\d+)\.")),
    )


def _numbers(names: Iterable[str], pattern: str) -> set[int]:
    """Distinct numbers at the pattern's group, so that a made-up huge number counts once."""
    return {int(match[1]) for match in map(re.compile(pattern).match, names) if match is not None}


def infer_config(shapes: Shapes, naming: Naming, levels: Levels, hints: Hints) -> ModelConfig:
    """The config of published weights, at the size of GCD's checkpoints.

    Args:
        levels: from `gcd_levels` or `diffusers_levels`.
    Raises:
        CheckpointError: a weight the architecture hangs on is missing, or the published rules do not give one.
    """
    probe = _Probe(shapes, naming, levels)
    try:
        unet = _unet(probe, hints)
        return ModelConfig(
            frames=hints.frames or PUBLISHED_FRAMES,
            camera=_camera_control(probe, unet.camera_width),
            unet=unet,
            vae=_vae(probe, hints),
            image_encoder=_image_encoder(probe, unet.context_width, hints),
        )
    except OptionError as error:
        raise CheckpointError(f"the weights fit no architecture known here: {error}") from error


@dataclass(frozen=True, slots=True)
class _Probe:
    """Asks for sizes by our names."""

    shapes: Shapes
    naming: Naming
    levels: Levels

    def optional(self, name: str, axis: int) -> int | None:
        """One side of our parameter; None where it is absent."""
        source = self.naming(name, self.levels)
        if source is None or any(each not in self.shapes for each in source.names):
            return None
        shape = assembled([torch.empty(self.shapes[each], device="meta") for each in source.names], source.form).shape
        return shape[axis] if axis < len(shape) and shape[axis] > 0 else None

    def size(self, name: str, axis: int) -> int:
        """The same, of one that must be there."""
        found = self.optional(name, axis)
        if found is None:
            source = self.naming(name, self.levels) or Source((name,))
            raise CheckpointError(f"1 weight that tells the architecture is missing or misshapen: {source.names[0]}")
        return found


def _multipliers(what: str, width: int, widths: tuple[int, ...]) -> tuple[int, ...]:
    if any(level % width for level in widths) or width % PUBLISHED_GROUPS:
        raise CheckpointError(
            f"{what} has level widths {list(widths)} over {width}; published layouts have multiples of "
            f"{PUBLISHED_GROUPS}, the groups of every group norm. Use our own format for other networks"
        )
    return tuple(level // width for level in widths)


def _unet(probe: _Probe, hints: Hints) -> UNetConfig:
    places = [f"unet.down.{level}.stages.0" for level in range(len(probe.levels.attention))]
    width, latent_channels = probe.size("unet.stem.weight", 0), probe.size("unet.conv_out.weight", 0)
    widths = tuple(probe.size(f"{place}.res.spatial.conv2.weight", 0) for place in places)
    attention = tuple(probe.optional(f"{place}.attention.proj_in.weight", 0) is not None for place in places)
    return UNetConfig(
        latent_channels=latent_channels,
        condition_channels=probe.size("unet.stem.weight", 1) - latent_channels,
        width=width,
        multipliers=_multipliers("the U-Net", width, widths),
        attention=attention,
        blocks_per_level=probe.levels.unet_blocks,
        embedding_width=probe.size("unet.embed_noise.0.weight", 0),
        head_width=_head_width(attention, widths, hints),
        context_width=probe.optional("unet.middle.0.attention.spatial.token.value.weight", 1),
        vector_width=probe.size("unet.embed_vector.0.weight", 1),
        camera_width=probe.optional("unet.embed_camera.0.weight", 1) or 0,
        norm_groups=PUBLISHED_GROUPS,
    )


def _head_width(attends: tuple[bool, ...], widths: tuple[int, ...], hints: Hints) -> int:
    """The given head width, or the published one. The middle, as wide as the deepest level, always attends."""
    there = [level for level, attending in enumerate((*attends[:-1], True)) if attending]
    head_width = hints.head_width or PUBLISHED_HEAD_WIDTH
    if hints.head_width is None and hints.heads is not None:
        heads = (hints.heads,) * len(widths) if isinstance(hints.heads, int) else hints.heads
        if len(heads) != len(widths) or min(heads) < 1:
            raise CheckpointError(f"config.json gives heads {heads} for {len(widths)} levels")
        found = {widths[level] / heads[level] for level in there}
        if len(found) > 1 or not all(width.is_integer() for width in found):
            raise CheckpointError(f"heads {heads} over widths {widths} are not all of one width; give --head-width")
        head_width = int(found.pop())
    for level in there:
        if widths[level] % head_width:
            raise CheckpointError(
                f"an attention level is {widths[level]} wide, no multiple of the head width {head_width}, which the "
                "weights do not tell; give --head-width"
            )
    return head_width


def _camera_control(probe: _Probe, camera_width: int) -> CameraControl:
    """The control whose number of features the camera embedder takes."""
    features = probe.optional("camera.proj.weight", 1)
    if not camera_width or features is None:
        return "spherical" if camera_width else "none"  # of a camera with half its weights, the check names the rest
    for control, count in CAMERA_FEATURES.items():
        if features == count:
            return control
    raise CheckpointError(
        f"the camera embedder takes {features} numbers; known are 13 (angles and radius) and 12 (relative pose)"
    )


def _vae(probe: _Probe, hints: Hints) -> VAEConfig:
    width, levels = probe.size("target_encoder.stem.weight", 0), range(probe.levels.vae_levels)
    widths = tuple(probe.size(f"target_encoder.levels.{level}.blocks.0.conv2.weight", 0) for level in levels)
    return VAEConfig(
        latent_channels=probe.size("target_encoder.conv_out.weight", 0) // 2,
        width=width,
        multipliers=_multipliers("the VAE", width, widths),
        blocks_per_level=probe.levels.vae_blocks,
        norm_groups=PUBLISHED_GROUPS,
        scale=VAEConfig().scale if hints.latent_scale is None else hints.latent_scale,
        shared=probe.naming("target_encoder.quant.weight", probe.levels) is not None,
    )


def _image_encoder(probe: _Probe, context_width: int | None, hints: Hints) -> ImageEncoderConfig | None:
    """None only for a U-Net without cross-attention: a tower that is wanted and absent is found missing later."""
    tokens = probe.optional("image_encoder.positions", 0)
    if tokens is None:
        return None if context_width is None else ImageEncoderConfig(output_width=context_width)
    patch, width = probe.size("image_encoder.patches.weight", 2), probe.size("image_encoder.patches.weight", 0)
    heads = hints.image_heads or PUBLISHED_IMAGE_HEADS
    if width % heads:
        raise CheckpointError(
            f"the image tower is {width} wide, no multiple of its {heads} heads, which the weights do not tell; "
            "give --image-heads"
        )
    return ImageEncoderConfig(
        image_size=round((tokens - 1) ** 0.5) * patch,
        patch=patch,
        width=width,
        layers=probe.levels.image_layers,
        heads=heads,
        hidden_width=probe.size("image_encoder.layers.0.expand.weight", 0),
        output_width=probe.size("image_encoder.projection", 1),
    )


# --- strict matching: nothing missing, nothing unknown, all of one shape ---------------------------------------------


_FIRST = 5  # names an error lists

_TEXT_TOWER = (
    r"positional_embedding|text_projection|logit_scale|attn_mask|token_embedding\.weight"
    r"|ln_final\.(weight|bias)|transformer\..+"
)
LEFTOVERS = {
    "CLIP text tower": rf"conditioner\.embedders\.0\.open_clip\.model\.({_TEXT_TOWER})",
    "decoder of the condition VAE": rf"{re.escape(GCD_CONDITION_VAE)}\.(decoder|post_quant_conv)\..+",
    "LPIPS": r"lpips\..+",
    "EMA": r"model_ema\..+",
    "noise table": r"denoiser\.sigmas",
    "position numbers": rf"{re.escape(IMAGE)}\.embeddings\.position_ids",
}
"""Published weights that inference does not use, by the whole name. Anything else that is left over is an error."""


@dataclass(frozen=True, slots=True)
class Match:
    """Where every parameter comes from, and what stays behind.

    sources: our names. leftovers: the kinds of LEFTOVERS that occur, each with its published names.
    """

    sources: dict[str, Source]
    leftovers: dict[str, list[str]]


def match_weights(expected: Shapes, shapes: Shapes, naming: Naming, levels: Levels) -> Match:
    """Pair our parameters with published weights.

    Args:
        expected: our names and shapes. shapes: those of the file.
    Raises:
        CheckpointError: says how many weights are missing, unknown and misshapen, and the first five of each.
    """
    sources = {name: naming(name, levels) or Source((name,)) for name in expected}
    used = {published for source in sources.values() for published in source.names}
    missing = [published for source in sources.values() for published in source.names if published not in shapes]
    misshapen = [line for name, source in sources.items() for line in _misfit(expected[name], source, shapes)]
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
    return Match(sources, leftovers)


def _misfit(wanted: tuple[int, ...], source: Source, shapes: Shapes) -> list[str]:
    """One line if the published tensors do not make ours; none if they do or are missing anyway."""
    given = [shapes[name] for name in source.names if name in shapes]
    published = wanted
    if source.form == "stacked":
        published = (wanted[0] // len(source.names), *wanted[1:])
    elif source.form == "transposed":
        published = wanted[::-1]
    elif source.form == "pixelwise" and given[:1] != [wanted]:  # some converters keep the 1x1 convolution
        published = wanted[:2]
    if len(given) < len(source.names) or all(shape == published for shape in given):
        return []
    return [f"{source.names[0]} wants {list(published)}, got {list(given[0])}"]
