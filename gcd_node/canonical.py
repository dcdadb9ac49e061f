"""The camera that a canonical view stands in for: what its pictures show and its lens, as a launch file names them."""

from dataclasses import dataclass
from pathlib import Path

from gcd_model import AlignmentError, Features, Intrinsics, features
from gcd_node.config import NodeConfig
from gcd_node.errors import ConfigError, SourceError
from gcd_node.frame import HALF_PIXEL, load_lens
from gcd_node.image_io import spread
from gcd_node.preprocess import Rectifier
from gcd_node.sources.files import list_pictures, read_picture
from gcd_node.view_config import ViewConfig

_MOST_PICTURES = 8  # of a folder, spread over it
_MOST_PIXELS = 640 * 480  # of a view


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Reference:
    """features: of pictures without distortion, of one camera that stood still. view: the lens of the view, another
    size of theirs."""

    features: tuple[Features, ...]
    view: Intrinsics

    @property
    def lens(self) -> Intrinsics:
        """Of the pictures."""
        return self.features[0].lens


def load_references(config: NodeConfig) -> dict[str, Reference]:
    """Of all canonical views, by their names. Raises ConfigError as load_reference()."""
    found: dict[str, Reference] = {}
    for view_id, view in config.view.items():
        if view.kind == "canonical":
            if view.pose is None and config.source.pace == "lockstep":
                raise ConfigError(
                    f"[view.{view_id}] state pose, which is looked for in realtime alone; make it with calibrate-view"
                )
            try:
                found[view_id] = load_reference(view)
            except (AlignmentError, ConfigError, SourceError) as error:
                raise ConfigError(f"[view.{view_id}] {error}") from error
    return found


def load_reference(view: ViewConfig) -> Reference:
    """Of one such view.

    Raises:
        SourceError: a picture is missing or damaged. AlignmentError: one shows next to nothing. ConfigError: pictures
            of several sizes; a calibration of another shape than theirs; too large a view.
    """
    path = Path(view.reference or "").expanduser()
    paths = list_pictures(path) if path.is_dir() else [path]
    pictures = [read_picture(paths[i]) for i in spread(len(paths), _MOST_PICTURES)]
    sizes = {(picture.shape[1], picture.shape[0]) for picture in pictures}
    if len(sizes) > 1:
        raise ConfigError(f"reference: pictures of one camera have one size, {path} has {sorted(sizes)}")
    width, height = sizes.pop()
    if view.calibration is None:
        lens = Intrinsics.from_hfov(view.hfov_deg or 0.0, width, height)
    else:
        model = load_lens(Path(view.calibration).expanduser()).resized(width, height)
        cx, cy = model.cx + HALF_PIXEL, model.cy + HALF_PIXEL
        lens = Intrinsics(fx=model.fx, fy=model.fy, cx=cx, cy=cy, width=width, height=height)
        if model.distortion != "none":
            pictures = [Rectifier(model, lens).image(picture) for picture in pictures]
    across, along = view.size or (width, height)
    if across * along > _MOST_PIXELS:
        raise ConfigError(
            f"size: a view has at most {_MOST_PIXELS} pixels, got {across} x {along}; state a smaller one"
        )
    return Reference(features=tuple(features(each, lens) for each in pictures), view=lens.resized(across, along))
