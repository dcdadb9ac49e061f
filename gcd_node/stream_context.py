"""What is known of a stream before its first frame: frame rate, cameras, what lies outside the trained domain, how
views are drawn."""

import hashlib
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import msgspec
from msgspec import structs

from gcd_client.protocol import SourcePoseRecord, ViewKind
from gcd_model import (
    CameraMount,
    Intrinsics,
    OptionError,
    RenderOptions,
    Sampler,
    Traits,
)
from gcd_node.canonical import Reference, load_references
from gcd_node.config import ModelSection, NodeConfig
from gcd_node.errors import ConfigError
from gcd_node.frame import LensModel, SourceInfo, load_lens
from gcd_node.preprocess import (
    Fit,
    Rectifier,
    assumed_hfov_deg,
    require_usable,
    stated_mount,
    stated_sphere,
    widest_camera,
)
from gcd_node.sources import SourcePose
from gcd_node.sources.depth import DepthSource, OnnxDepth
from gcd_node.window import RATE_TOLERANCE

_LOG = logging.getLogger(__name__)
_HFOV_TOLERANCE_DEG = 2.0
_FLAG_NAMES = {"fps": "frame rate", "hfov": "field of view"}


@dataclass(frozen=True, kw_only=True)
class StreamContext:
    """What stays the same in every message of a stream, until its source or the configuration changes.

    fps: of a window. intrinsics: of the generated picture, None if the field of view is unknown.
    mount: of the source camera, for a model that uses it; None if nothing was stated.
    ood: what lies outside the trained domain from the start: "fps", "hfov".
    fit: how source pictures become the model's. lens: the calibration in use, maybe for pictures of another size.
    depth: what takes the place of the live model's own depth; None for that. references: of canonical views, by name.
    """

    config: NodeConfig
    traits: Traits
    source: SourceInfo
    boot_id: str
    fps: float
    intrinsics: Intrinsics | None
    mount: CameraMount | None
    ood: tuple[str, ...]
    fit: Fit | Rectifier
    lens: LensModel | None
    depth: DepthSource | None = None
    references: Mapping[str, Reference] = field(default_factory=dict[str, Reference])

    @cached_property
    def digest(self) -> str:
        """Of the configuration; see config_digest()."""
        return config_digest(self.config, self.traits)


def prepare_stream(
    config: NodeConfig, traits: Traits, source: SourceInfo, *, boot_id: str = "", before: StreamContext | None = None
) -> StreamContext:
    """Everything that can be said before the first frame.

    Args:
        boot_id: of this life of the node.
        before: of the same activation, if the source has changed in mid-stream. Its calibration file is not read again;
            one for another shape, which cannot tell what the camera keeps of it now, is left out instead of refused.
    Raises:
        ConfigError: weights that want depth; a frame rate the source cannot give; a source pose in words the model does
            not know; pictures that are too small; a calibration that is unusable, for other pictures, or stated beside
            hfov_deg; a depth network, or the reference of a canonical view, that cannot be used; in strict mode, a rate
            or field of view the model was not trained for.
    """
    if traits.splat == "given":
        raise ConfigError(
            f"[model] weights: {traits.name} wants the depth of every frame, which only the live model is given here; "
            'take weights that were trained with model.splat = "estimated"'
        )
    fps, is_foreign_rate = _window_fps(config, traits, source)
    lens = _lens_in_use(config, source, before)
    fit = _fit(config, traits, source, None if before and lens and not lens.fits(source.width, source.height) else lens)
    camera = _source_camera(config, source, fit)
    try:
        require_usable(config.source.pose, traits)
        mount = stated_mount(config.source.pose, None if camera is None else camera.hfov_deg, traits)
    except OptionError as error:
        raise ConfigError(f"[source.pose]: {error}") from error
    if config.grid and mount is None:  # which other models than the live one have no use for
        raise ConfigError("[grid]: needs the live model and the ground: state height_m and tilt_deg in [source.pose]")
    is_foreign_field = _is_foreign_field(camera, traits) or (isinstance(fit, Fit) and lens is not None)
    flags = {"fps": is_foreign_rate, "hfov": is_foreign_field}
    ood = tuple(name for name, is_raised in flags.items() if is_raised)
    _refuse_or_warn(ood, strict=config.strict, fps=fps, model=traits.name)
    return StreamContext(
        config=config,
        traits=traits,
        source=source,
        boot_id=boot_id,
        fps=fps,
        intrinsics=_view_camera(config, camera, traits),
        mount=mount,
        ood=ood,
        fit=fit,
        lens=lens,
        depth=before.depth if before is not None and before.mount == mount else _depth_network(config, traits, mount),
        references=load_references(config) if before is None else before.references,
    )


def choose_fps(source_fps: float, trained: Sequence[float]) -> tuple[float, bool]:
    """The highest trained rate the source can give, False; without one, the source's own rate, True: it lies outside
    what the network was trained with. trained: empty if any will do. Source: docs/node.md, F8."""
    if not trained:
        return source_fps, False
    reachable = [fps for fps in trained if fps <= source_fps * (1 + RATE_TOLERANCE)]
    return (float(max(reachable)), False) if reachable else (source_fps, True)


def _window_fps(config: NodeConfig, traits: Traits, source: SourceInfo) -> tuple[float, bool]:
    """Frame rate of windows, and whether the model was not trained for it. Raises ConfigError."""
    fps = config.window.fps
    if fps is None:
        return choose_fps(source.fps_nominal, traits.rates)
    if fps > source.fps_nominal * (1 + RATE_TOLERANCE):
        raise ConfigError(f"[window] fps {fps:g} is more than the {source.fps_nominal:g} the source gives; lower it")
    return fps, bool(traits.rates) and not any(abs(fps / rate - 1) <= RATE_TOLERANCE for rate in traits.rates)


def _lens_in_use(config: NodeConfig, source: SourceInfo, before: StreamContext | None) -> LensModel | None:
    """The stated calibration, else what the source itself knows, unless a stated hfov_deg overrides that."""
    section = config.source
    if section.calibration is None:
        return source.lens if section.hfov_deg is None else None
    if section.hfov_deg is not None:
        raise ConfigError("[source] calibration and hfov_deg say the same thing twice; leave one of them out")
    return load_lens(Path(section.calibration).expanduser()) if before is None else before.lens


def _fit(config: NodeConfig, traits: Traits, source: SourceInfo, lens: LensModel | None) -> Fit | Rectifier:
    """Undistorted and cut to the trained field of view if there is a calibration, else cropped to the model's shape,
    and to its field of view if the source's is known and wider. Raises ConfigError."""
    if lens is None:
        return _crop(config, traits, source)
    lens, model = lens.resized(source.width, source.height), traits.config
    camera = widest_camera(lens, model.width, model.height, _trained_hfov_deg(traits))
    return Rectifier(lens, camera, allow_upscale=config.source.allow_upscale)


def _crop(config: NodeConfig, traits: Traits, source: SourceInfo) -> Fit:
    """Cut to the trained field of view, unless too few pixels would be left of it. Raises ConfigError."""
    whole = Fit(
        width=traits.config.width,
        height=traits.config.height,
        resize=config.source.resize,
        allow_upscale=config.source.allow_upscale,
    )
    whole.crop_box(source.width, source.height)
    hfov_deg, trained = source.hfov_in_use(config.source.hfov_deg), _trained_hfov_deg(traits)
    if hfov_deg is None or trained is None or hfov_deg <= trained:
        return whole
    narrowed = replace(whole, share=math.tan(math.radians(trained / 2)) / math.tan(math.radians(hfov_deg / 2)))
    try:
        narrowed.crop_box(source.width, source.height)
    except ConfigError as error:
        _LOG.info("the source sees %g degrees, the model %g, and is not cut to that: %s", hfov_deg, trained, error)
        return whole
    return narrowed


def _refuse_or_warn(ood: tuple[str, ...], *, strict: bool, fps: float, model: str) -> None:
    names = [_FLAG_NAMES[name] for name in ood]
    if names and strict:
        raise ConfigError(
            f"strict: {' and '.join(names)} of the source ({fps:g} FPS) lie outside what {model} was trained "
            "with; use another source or [window] fps, or leave strict out to have views flagged"
        )
    for name in names:
        _LOG.warning("the %s of the source lies outside what %s was trained with: views are flagged", name, model)


def _depth_network(config: NodeConfig, traits: Traits, mount: CameraMount | None) -> OnnxDepth | None:
    path, kind = config.model.depth_model, config.model.depth_kind
    if path is None:
        return None
    if not traits.live:
        raise ConfigError(f"[model] depth_model: {traits.name} takes no depth; leave it out, or use the live model")
    try:
        return OnnxDepth(Path(path).expanduser(), kind=kind, scale=mount if kind == "inverse" else None)
    except ConfigError as error:
        raise ConfigError(f"[model] depth_model: {error}") from error


def _source_camera(config: NodeConfig, source: SourceInfo, fit: Fit | Rectifier) -> Intrinsics | None:
    """The camera of the picture the model is given; None if no field of view is stated."""
    if isinstance(fit, Rectifier):
        return fit.camera
    hfov_deg = source.hfov_in_use(config.source.hfov_deg)
    if hfov_deg is None:
        return None
    return fit.intrinsics(Intrinsics.from_hfov(hfov_deg, source.width, source.height))


def _view_camera(config: NodeConfig, camera: Intrinsics | None, traits: Traits) -> Intrinsics | None:
    """The generated picture's camera: the source's again, or if that is unknown the trained one, or for the live model
    the one that `assumed_hfov_deg` says."""
    if camera is not None:
        return camera
    hfov_deg = assumed_hfov_deg(config.source.pose) if traits.live else _trained_hfov_deg(traits)
    return None if hfov_deg is None else Intrinsics.from_hfov(hfov_deg, traits.config.width, traits.config.height)


def _is_foreign_field(camera: Intrinsics | None, traits: Traits) -> bool:
    if camera is None or traits.lens_deg is None:
        return False
    narrowest, widest = traits.lens_deg
    return not narrowest - _HFOV_TOLERANCE_DEG <= camera.hfov_deg <= widest + _HFOV_TOLERANCE_DEG


def _trained_hfov_deg(traits: Traits) -> float | None:
    return None if traits.family is None else traits.family.hfov_deg


# What messages say of it.


def published_kinds(context: StreamContext) -> Iterator[ViewKind]:
    """What is published of each view, as far as it is known before there is one."""
    yield from ("win", "frm")
    if context.traits.classes:
        yield "cls"
    if context.traits.live:
        yield from ("vis", "depth")
    if context.traits.live or context.config.model.samples > 1:
        yield "std"


def family_name(traits: Traits) -> str:
    """ "unknown" for a model of none."""
    return "unknown" if traits.family is None else traits.family.name


def source_pose(context: StreamContext) -> SourcePoseRecord | None:
    """Where the source camera of a steered model stands; None for a model with a fixed view, and on a vehicle."""
    if context.traits.config.camera == "none" or context.mount is not None:
        return None  # a fixed path states its rigid transforms itself
    stated = stated_sphere(context.config.source.pose)
    source = stated or Traits.ASSUMED_SOURCE
    return SourcePoseRecord(el_deg=source.elevation_deg, r=source.radius_m, assumed=stated is None)


# How views are drawn, and a short name for that.


def drawing_options(section: ModelSection) -> RenderOptions:
    """What [model] says of drawing; without a seed, which is the window's."""
    return RenderOptions(
        quality=section.quality,
        steps=section.steps,
        solver=section.solver,
        guidance=section.guidance,
        guidance_interval=section.guidance_interval,
        samples=section.samples,
        motion_bucket=section.motion_bucket,
    )


def sampler_in_use(section: ModelSection, traits: Traits) -> Sampler:
    """The same in full: what [model] leaves out as quality and checkpoint have it."""
    return Sampler.of(traits.config.sampling, drawing_options(section))


def config_digest(config: NodeConfig, traits: Traits) -> str:
    """12 hex digits that name how views are rendered from given pictures: not from which camera or recording they
    come, on which device, in which precision or at what pace, nor where they are sent. Seeds follow from it, so that a
    recording of a camera is rendered as the camera was.

    What was left out counts as the value it stands for, wherever the model or its checkpoint decides that; so a default
    changes nothing when it is written out. Two are for the source to decide and count as they are written: `fps` of
    [window], and `hfov_deg` of [source]. `motion_bucket`, where it follows from each path, is the third.

    Args:
        traits: of the model in use.
    """
    source = config.source
    taken = source.resize, source.allow_upscale, source.hfov_deg, _pose_in_use(source.pose, traits)
    views = {view_id: view.plain for view_id, view in config.view.items()}
    window = structs.replace(config.window, stride=config.window.stride or traits.config.frames)
    filled = taken, _model_in_use(config.model, traits), views, window
    plain = _without_negative_zero(msgspec.to_builtins(filled))
    return hashlib.sha256(msgspec.json.encode(plain, order="deterministic")).hexdigest()[:12]


def _model_in_use(section: ModelSection, traits: Traits) -> ModelSection:
    sampling, family = traits.config.sampling, traits.family
    networks = None if traits.live else traits.diffusion
    tower = None if networks is None else networks.image_encoder
    used = sampler_in_use(section, traits)
    return structs.replace(
        section,
        weights=traits.sha256_12 if section.engine == "remote" else section.weights,
        device="auto",
        threads=None,
        engine=None,
        deadline_s=2.0,
        fallback="drop",
        token=None,
        providers=(),
        dtype=None,
        family=section.family if family is None else family.name,
        quality="exact",
        steps=used.steps,
        solver=used.solver,
        guidance=used.guidance,
        guidance_interval=used.guidance_interval,
        cond_aug=sampling.augmentation if section.cond_aug is None else section.cond_aug,
        move_time=traits.move_time if section.move_time is None else section.move_time,
        motion_bucket=family.motion_bucket if section.motion_bucket is None and family else section.motion_bucket,
        head_width=None if networks is None else networks.unet.head_width,
        image_heads=None if tower is None else tower.heads,
    )


def _pose_in_use(pose: SourcePose | None, traits: Traits) -> SourcePose | None:
    """Where the camera stands in the words the model knows; None for a model that has no use for them."""
    mount = stated_mount(pose, None, traits)
    if mount is not None:
        return SourcePose(
            height_m=mount.height_m, forward_m=mount.forward_m, left_m=mount.left_m, tilt_deg=mount.tilt_deg
        )
    if traits.config.camera == "none":
        return None
    sphere = stated_sphere(pose) or Traits.ASSUMED_SOURCE
    return SourcePose(elevation_deg=sphere.elevation_deg, radius=sphere.radius_m)


def _without_negative_zero(value: object) -> object:
    """-0.0 is written otherwise than 0.0 and means the same."""
    if isinstance(value, dict):
        return {key: _without_negative_zero(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_without_negative_zero(each) for each in value]
    return value + 0.0 if isinstance(value, float) else value
