"""What can be said of a run before its first frame: frame rate, cameras, and what lies outside the trained domain."""

import logging
import math
import uuid
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gcd_model import LIVE_LENS_DEG, CameraMount, Intrinsics, OptionError, Traits
from gcd_node.calibration import LensModel, load_lens
from gcd_node.config import NodeConfig
from gcd_node.errors import ConfigError
from gcd_node.frame import Image, SourceInfo
from gcd_node.messages import Run
from gcd_node.preprocess import Fit, Rectifier, assumed_hfov_deg, require_usable, stated_mount
from gcd_node.sources.depth import OnnxDepth
from gcd_node.views import LiveConfig
from gcd_node.window import RATE_TOLERANCE, choose_fps

_LOG = logging.getLogger(__name__)
_HFOV_TOLERANCE_DEG = 2.0
_WORDS = {"fps": "frame rate", "hfov": "field of view"}


def prepare_run(config: NodeConfig, traits: Traits, source: SourceInfo, *, changed: bool = False) -> tuple[Run, float]:
    """Everything that can be said before the first frame, and the frame rate windows will have.

    Args:
        changed: see fit_of(); a calibration that is left out flags the field of view, which nobody knows then.
    Raises:
        ConfigError: a frame rate the source cannot give; a source pose in words the model does not know; pictures the
            model cannot be given, see fit_of(); a depth network that cannot be used; in strict mode, a rate or field of
            view the model was not trained for.
    """
    fps, foreign_rate = config.window.fps, False
    if fps is None:
        fps, foreign_rate = choose_fps(source.fps_nominal, traits.rates)
    elif fps > source.fps_nominal * (1 + RATE_TOLERANCE):
        raise ConfigError(f"[window] fps {fps:g} is more than the {source.fps_nominal:g} the source gives; lower it")
    elif traits.rates:
        foreign_rate = not any(abs(fps / rate - 1) <= RATE_TOLERANCE for rate in traits.rates)
    fit = fit_of(config, traits, source, changed=changed)
    camera = _source_camera(config, source, fit)
    mount = _mount(config, traits, camera)
    foreign_field = _is_foreign_field(camera, traits) or (isinstance(fit, Fit) and _is_calibrated(config, source))
    foreign = {"fps": foreign_rate, "hfov": foreign_field}
    ood = tuple(name for name, is_so in foreign.items() if is_so)
    _refuse_or_warn(ood, strict=config.strict, fps=fps, model=traits.name)
    run = Run(
        config=config,
        traits=traits,
        source=source,
        boot_id=uuid.uuid4().hex,
        intrinsics=_view_camera(config, camera, traits),
        mount=mount,
        ood=ood,
        resize=fit.resize,
        depth=_depth_network(config, traits, mount),
    )
    return run, fps


def _refuse_or_warn(ood: tuple[str, ...], *, strict: bool, fps: float, model: str) -> None:
    found = [_WORDS[name] for name in ood]
    if found and strict:
        raise ConfigError(
            f"strict: {' and '.join(found)} of the source ({fps:g} FPS) lie outside what {model} was trained "
            "with; use another source or [window] fps, or leave strict out to have views flagged"
        )
    for words in found:
        _LOG.warning("the %s of the source lies outside what %s was trained with: views are flagged", words, model)


def _mount(config: NodeConfig, traits: Traits, camera: Intrinsics | None) -> CameraMount | None:
    try:
        require_usable(config.source.pose, traits)
        return stated_mount(config.source.pose, None if camera is None else camera.hfov_deg, traits)
    except OptionError as error:
        raise ConfigError(f"[source.pose]: {error}") from error


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
    """The camera of the picture the model is given; None if nobody states a field of view."""
    if isinstance(fit, Rectifier):
        return fit.camera
    stated = source.hfov_in_use(config.source.hfov_deg)
    if stated is None:
        return None
    return fit.intrinsics(Intrinsics.from_hfov(stated, source.width, source.height))


def _view_camera(config: NodeConfig, camera: Intrinsics | None, traits: Traits) -> Intrinsics | None:
    """The generated picture's camera: the source's again, or the trained one if that is unknown; for the live model the
    one that `assumed_hfov_deg` says."""
    trained = assumed_hfov_deg(config.source.pose) if traits.live else _trained_hfov_deg(traits)
    if camera is not None:
        return camera
    return None if trained is None else Intrinsics.from_hfov(trained, traits.config.width, traits.config.height)


def _is_foreign_field(camera: Intrinsics | None, traits: Traits) -> bool:
    trained = _trained_hfov_deg(traits)
    if camera is None:
        return False
    if traits.live:
        return not LIVE_LENS_DEG[0] - _HFOV_TOLERANCE_DEG <= camera.hfov_deg <= LIVE_LENS_DEG[1] + _HFOV_TOLERANCE_DEG
    return trained is not None and abs(camera.hfov_deg - trained) > _HFOV_TOLERANCE_DEG


def _trained_hfov_deg(traits: Traits) -> float | None:
    return None if traits.family is None else traits.family.hfov_deg


def fit_of(config: NodeConfig, traits: Traits, source: SourceInfo, *, changed: bool = False) -> Fit | Rectifier:
    """How the source's pictures become the model's: undistorted and cut to its field of view if there is a
    calibration, else cropped to its shape, and to its field of view if the source's is known and wider.

    Args:
        changed: the pictures have changed their size in mid-stream: a calibration for another shape, which cannot tell
            what the camera keeps of it now, is left out instead of refused.
    Raises:
        ConfigError: they are too small, the calibration is unusable or for other pictures, or it contradicts hfov_deg.
    """
    lens = lens_in_use(config, source)
    if lens is None or (changed and not lens.fits(source.width, source.height)):
        return _crop(config, traits, source)
    return Rectifier(
        lens.resized(source.width, source.height),
        width=traits.config.width,
        height=traits.config.height,
        hfov_deg=_trained_hfov_deg(traits),
        allow_upscale=config.source.allow_upscale,
    )


def _crop(config: NodeConfig, traits: Traits, source: SourceInfo) -> Fit:
    """Cut to the trained field of view, unless too few pixels would be left of it. Raises ConfigError."""
    whole = Fit(
        width=traits.config.width,
        height=traits.config.height,
        resize=config.source.resize,
        allow_upscale=config.source.allow_upscale,
    )
    whole.crop_box(source.width, source.height)
    stated, trained = source.hfov_in_use(config.source.hfov_deg), _trained_hfov_deg(traits)
    if stated is None or trained is None or stated <= trained:
        return whole
    narrowed = replace(whole, share=math.tan(math.radians(trained / 2)) / math.tan(math.radians(stated / 2)))
    try:
        narrowed.crop_box(source.width, source.height)
    except ConfigError as error:
        _LOG.info("the source sees %g degrees, the model %g, and is not cut to that: %s", stated, trained, error)
        return whole
    return narrowed


def lens_in_use(config: NodeConfig, source: SourceInfo) -> LensModel | None:
    """The stated calibration, else what the source itself knows, unless a stated hfov_deg overrides that; None without
    one. It may be for pictures of another size.

    Raises:
        ConfigError: it is stated twice, or its file is missing or damaged.
    """
    stated = config.source
    if stated.calibration is None:
        return source.lens if stated.hfov_deg is None else None
    if stated.hfov_deg is not None:
        raise ConfigError("[source] calibration and hfov_deg say the same thing twice; leave one of them out")
    return load_lens(Path(stated.calibration).expanduser())


def _is_calibrated(config: NodeConfig, source: SourceInfo) -> bool:
    """Whether `lens_in_use` finds one."""
    return config.source.calibration is not None or (source.lens is not None and config.source.hfov_deg is None)


_KEPT = 8


class ActiveSource:
    """Of the source as it is now, and of former epochs, whose windows may still be in work. Changed in one thread."""

    def __init__(
        self, live: LiveConfig, traits: Traits, prepared: tuple[Run, float], *, boot_id: str, epoch: int
    ) -> None:
        """Of a source that was just opened.

        Args:
            prepared: what prepare_run() says of it. boot_id: of this life of the node. epoch: its first.
        Raises:
            ConfigError: see fit_of().
        """
        self._live, self._traits, self._boot_id = live, traits, boot_id
        run, self._fps = prepared
        self._fit = fit_of(live.config, traits, run.source)
        self._lens = lens_in_use(live.config, run.source)
        self._runs = [(epoch, replace(run, boot_id=boot_id))]

    @property
    def run(self) -> Run:
        """Everything that goes into messages, now."""
        return self._runs[-1][1]

    @property
    def fps(self) -> float:
        """Frame rate of windows."""
        return self._fps

    def of(self, epoch: int) -> Run:
        """As `run`, in an epoch; -1 for now."""
        runs = self._runs
        return next((run for since, run in reversed(runs) if since <= epoch), runs[-1][1])

    def lens(self, info: SourceInfo) -> LensModel | None:
        """The calibration in use, if it is for pictures such as these."""
        return self._lens if self._lens is not None and self._lens.fits(info.width, info.height) else None

    def image(self, image: Image) -> Image:
        """A picture of the source as the model takes it. Raises ConfigError: it is of another size than was said."""
        return self._fit.image(image)

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """The depth of such a picture, in the same size. Raises ConfigError as `image`."""
        return self._fit.depth(depth)

    def adapt(self, info: SourceInfo, epoch: int) -> None:
        """To another size, rate or camera, from an epoch on. Raises ConfigError, and changes nothing then."""
        config = self._live.config
        run, fps = prepare_run(config, self._traits, info, changed=True)
        self._fit, self._lens = fit_of(config, self._traits, info, changed=True), lens_in_use(config, info)
        self._fps = fps
        if run.mount == self.run.mount:
            run = replace(run, depth=self.run.depth)
        self._runs = [*self._runs[1 - _KEPT :], (epoch, replace(run, boot_id=self._boot_id))]
