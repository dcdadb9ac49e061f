"""From the names and shapes of published weights to a config. Pure: tensors are never looked into."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch

from gcd_model.config import CAMERA_FEATURES, CameraControl, ImageEncoderConfig, ModelConfig, UNetConfig, VAEConfig
from gcd_model.errors import CheckpointError, OptionError
from gcd_model.weights.names import (
    GCD_CONDITION_VAE,
    GCD_IMAGE,
    GCD_UNET,
    GCD_VAE,
    IMAGE,
    Form,
    Levels,
    Source,
    assembled,
)

Shapes = Mapping[str, tuple[int, ...]]
"""Published names and their shapes."""

Naming = Callable[[str, Levels], Source | None]
"""Where a layout keeps a parameter of ours: `gcd_source` or `diffusers_source`."""

PUBLISHED_GROUPS = 32
PUBLISHED_HEAD_WIDTH = 64
PUBLISHED_IMAGE_HEADS = 16
PUBLISHED_FRAMES = 14


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
        for name, value in (("head_width", self.head_width), ("image_heads", self.image_heads)):
            if value is not None and value < 1:
                raise OptionError(f"{name} must be at least 1, got {value}")
        if self.frames is not None and self.frames < 2:
            raise OptionError(f"frames must be at least 2, got {self.frames}")


def gcd_levels(names: Iterable[str]) -> Levels:
    """The counts behind Stability's block numbers. Attention is not known yet: see `infer_config`."""
    names = list(names)
    inputs = _numbers(names, rf"{re.escape(GCD_UNET)}\.input_blocks\.(\d+)\.")
    downs = sorted(_numbers(names, rf"{re.escape(GCD_UNET)}\.input_blocks\.(\d+)\.0\.op\."))
    blocks = (downs[0] if downs else len(inputs)) - 1
    vae = rf"{re.escape(GCD_VAE)}\.encoder\.down\."
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
    matches = map(re.compile(pattern).match, names)
    return {int(match[1]) for match in matches if match is not None}


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

    def shape(self, parameter: str) -> tuple[int, ...] | None:
        """Shape our parameter would have; None if it is not there."""
        source = self.naming(parameter, self.levels)
        if source is None or any(name not in self.shapes for name in source.names):
            return None
        return tuple(assembled([_hollow(self.shapes[name]) for name in source.names], source.form).shape)

    def size(self, module: str, axis: int, *, leaf: str = "weight") -> int:
        """One side of a module's weight. Output widths can be read off the bias too."""
        found = self.optional(module, axis, leaf=leaf)
        if found is None:
            source = self.naming(f"{module}.{leaf}" if leaf else module, self.levels)
            name = module if source is None else source.names[0]
            raise CheckpointError(f"1 weight that tells the architecture is missing or misshapen: {name}")
        return found

    def optional(self, module: str, axis: int, *, leaf: str = "weight") -> int | None:
        """The same, or None where the module is absent."""
        shape = self.shape(f"{module}.{leaf}" if leaf else module)
        if shape is None and axis == 0 and leaf:
            shape = self.shape(f"{module}.bias")
        return None if shape is None or len(shape) <= axis or shape[axis] < 1 else shape[axis]


def _hollow(shape: tuple[int, ...]) -> torch.Tensor:
    """A tensor without storage."""
    return torch.empty(shape, device="meta")


def _multipliers(what: str, width: int, widths: tuple[int, ...]) -> tuple[int, ...]:
    if any(level % width for level in widths) or width % PUBLISHED_GROUPS:
        raise CheckpointError(
            f"{what} has level widths {list(widths)} over {width}; published layouts have multiples of "
            f"{PUBLISHED_GROUPS}, the groups of every group norm. Use our own format for other networks"
        )
    return tuple(level // width for level in widths)


def _unet(probe: _Probe, hints: Hints) -> UNetConfig:
    places = [f"unet.down.{level}.stages.0" for level in range(len(probe.levels.attention))]
    width, latent_channels = probe.size("unet.stem", 0), probe.size("unet.conv_out", 0)
    widths = tuple(probe.size(f"{place}.res.spatial.conv2", 0) for place in places)
    attention = tuple(probe.optional(f"{place}.attention.proj_in", 0) is not None for place in places)
    multipliers = _multipliers("the U-Net", width, widths)
    return UNetConfig(
        latent_channels=latent_channels,
        condition_channels=probe.size("unet.stem", 1) - latent_channels,
        width=width,
        multipliers=multipliers,
        attention=attention,
        blocks_per_level=probe.levels.unet_blocks,
        embedding_width=probe.size("unet.embed_noise.0", 0),
        head_width=_head_width(attention, widths, hints),
        context_width=_context_width(probe),
        vector_width=probe.size("unet.embed_vector.0", 1),
        camera_width=_camera_width(probe),
        norm_groups=PUBLISHED_GROUPS,
    )


def _head_width(attends: tuple[bool, ...], widths: tuple[int, ...], hints: Hints) -> int:
    """The given head width, or the published one. The middle, as wide as the deepest level, always attends."""
    attending = [width for width, there in zip(widths, (*attends[:-1], True), strict=True) if there]
    head_width = hints.head_width or _width_of_heads(attends, widths, hints.heads) or PUBLISHED_HEAD_WIDTH
    for width in attending:
        if width % head_width:
            raise CheckpointError(
                f"an attention level is {width} wide, no multiple of the head width {head_width}, which the weights "
                "do not tell; give --head-width"
            )
    return head_width


def _width_of_heads(
    attends: tuple[bool, ...], widths: tuple[int, ...], heads: int | tuple[int, ...] | None
) -> int | None:
    """Head width from numbers of heads; None without them."""
    if heads is None:
        return None
    counts = (heads,) * len(widths) if isinstance(heads, int) else heads
    if len(counts) != len(widths) or min(counts) < 1:
        raise CheckpointError(f"config.json gives heads {counts} for {len(widths)} levels")
    found = {width / count for width, count, there in zip(widths, counts, (*attends[:-1], True), strict=True) if there}
    if len(found) > 1 or not all(width.is_integer() for width in found):
        raise CheckpointError(f"heads {counts} over widths {widths} are not all of one width; give --head-width")
    return int(found.pop())


def _context_width(probe: _Probe) -> int | None:
    """Width of the image token, None without cross-attention; any of the middle's four matrices tells."""
    for branch in ("spatial", "temporal"):
        token = f"unet.middle.0.attention.{branch}.token"
        width = probe.optional(f"{token}.value", 1) or probe.optional(f"{token}.dormant.key", 1, leaf="")
        if width is not None:
            return width
    return None


def _camera_width(probe: _Probe) -> int:
    """Width of the camera vector, 0 without one; either of its two modules tells."""
    width = probe.optional("unet.embed_camera.0", 1)
    return width or probe.optional("camera.proj", 0) or 0


def _camera_control(probe: _Probe, camera_width: int) -> CameraControl:
    """The control whose number of features the camera embedder takes."""
    features = probe.optional("camera.proj", 1)
    if features is None:
        return "spherical" if camera_width else "none"  # of a camera with half its weights, the check names the rest
    for control, count in CAMERA_FEATURES.items():
        if features == count:
            return control
    raise CheckpointError(
        f"the camera embedder takes {features} numbers; known are 13 (angles and radius) and 12 (relative pose)"
    )


def _vae(probe: _Probe, hints: Hints) -> VAEConfig:
    width = probe.size("target_encoder.stem", 0)
    levels = range(probe.levels.vae_levels)
    widths = tuple(probe.size(f"target_encoder.levels.{level}.blocks.0.conv2", 0) for level in levels)
    return VAEConfig(
        latent_channels=probe.size("target_encoder.conv_out", 0) // 2,
        width=width,
        multipliers=_multipliers("the VAE", width, widths),
        blocks_per_level=probe.levels.vae_blocks,
        norm_groups=PUBLISHED_GROUPS,
        scale=VAEConfig().scale if hints.latent_scale is None else hints.latent_scale,
        shared=probe.naming("target_encoder.quant.weight", probe.levels) is not None,
    )


def _image_encoder(probe: _Probe, context_width: int | None, hints: Hints) -> ImageEncoderConfig | None:
    """None only for a U-Net without cross-attention: a tower that is wanted and absent is found missing later."""
    tokens = probe.optional("image_encoder.positions", 0, leaf="")
    if tokens is None:
        return None if context_width is None else ImageEncoderConfig(output_width=context_width)
    patch, width = probe.size("image_encoder.patches", 2), probe.size("image_encoder.patches", 0)
    return ImageEncoderConfig(
        image_size=round((tokens - 1) ** 0.5) * patch,
        patch=patch,
        width=width,
        layers=probe.levels.image_layers,
        heads=_image_heads(width, hints),
        hidden_width=probe.size("image_encoder.layers.0.expand", 0),
        output_width=probe.size("image_encoder.projection", 1, leaf=""),
    )


def _image_heads(width: int, hints: Hints) -> int:
    heads = hints.image_heads or PUBLISHED_IMAGE_HEADS
    if width % heads:
        raise CheckpointError(
            f"the image tower is {width} wide, no multiple of its {heads} heads, which the weights do not tell; "
            "give --image-heads"
        )
    return heads


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
    sources = {name: naming(name, levels) for name in expected}
    missing = [
        published
        for name, source in sources.items()
        for published in ([name] if source is None else [n for n in source.names if n not in shapes])
    ]
    found = {name: source for name, source in sources.items() if source is not None}
    used = {name for source in found.values() for name in source.names}
    leftovers, unknown = _sorted_out(name for name in shapes if name not in used)
    misshapen = [line for name, source in found.items() for line in _misfit(expected[name], source, shapes)]
    _require_fit(len(expected), missing, unknown, misshapen)
    return Match(found, leftovers)


def _sorted_out(names: Iterable[str]) -> tuple[dict[str, list[str]], list[str]]:
    """Recognised leftovers by kind, and the rest."""
    patterns = {kind: re.compile(pattern) for kind, pattern in LEFTOVERS.items()}
    leftovers: dict[str, list[str]] = {}
    unknown: list[str] = []
    for name in names:
        kind = next((kind for kind, pattern in patterns.items() if pattern.fullmatch(name)), None)
        (unknown if kind is None else leftovers.setdefault(kind, [])).append(name)
    return leftovers, unknown


def _misfit(wanted: tuple[int, ...], source: Source, shapes: Shapes) -> list[str]:
    """One line if the published tensors do not make ours; none if they do or are missing anyway."""
    given = [shapes[name] for name in source.names if name in shapes]
    if len(given) < len(source.names) or published_fit(wanted, given, source.form):
        return []
    return [f"{source.names[0]} wants {list(published_shape(wanted, source))}, got {list(given[0])}"]


def published_shape(wanted: tuple[int, ...], source: Source) -> tuple[int, ...]:
    """Shape of each published tensor that makes one of ours."""
    if source.form == "stacked":
        return (wanted[0] // len(source.names), *wanted[1:])
    if source.form == "transposed":
        return wanted[::-1]
    return wanted[:2] if source.form == "pixelwise" else wanted


def published_fit(wanted: tuple[int, ...], given: Sequence[tuple[int, ...]], form: Form) -> bool:
    """Whether published tensors of these shapes make one of ours."""
    if form == "pixelwise" and given[0] == wanted:
        return True  # some converters keep the 1x1 convolution
    names = tuple("" for _ in given)
    return all(shape == published_shape(wanted, Source(names, form)) for shape in given)


def _require_fit(expected: int, missing: list[str], unknown: list[str], misshapen: list[str]) -> None:
    faults = [
        f"{len(names)} of {expected} weights are {what}, first: {', '.join(names[:_FIRST])}"
        for what, names in (("missing", missing), ("misshapen", misshapen))
        if names
    ]
    if unknown:
        faults.append(f"{len(unknown)} unexpected names, first: {', '.join(unknown[:_FIRST])}")
    if faults:
        raise CheckpointError(
            f"{'; '.join(faults)}. Nothing was loaded: the file is damaged, or of another architecture than GCD's"
        )
