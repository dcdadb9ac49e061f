"""What is known of a source while it is used: its rate, its camera, and how its pictures become the model's."""

from dataclasses import replace

from gcd_model import Traits
from gcd_node.frame import Image, SourceInfo
from gcd_node.life.live_config import LiveConfig
from gcd_node.optics.calibration import LensModel
from gcd_node.rendering.preparation import fit_of, lens_in_use, prepare_run
from gcd_node.wire.view_message import Run

_KEPT = 8


class KnownSource:
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

    def adapt(self, info: SourceInfo, epoch: int) -> None:
        """To another size, rate or camera, from an epoch on. Raises ConfigError, and changes nothing then."""
        config = self._live.config
        run, fps = prepare_run(config, self._traits, info, changed=True)
        self._fit, self._lens = fit_of(config, self._traits, info, changed=True), lens_in_use(config, info)
        self._fps = fps
        if run.mount == self.run.mount:
            run = replace(run, depth=self.run.depth)
        self._runs = [*self._runs[1 - _KEPT :], (epoch, replace(run, boot_id=self._boot_id))]
