"""Replays of a made-up source through a made-up model: quick, and different exactly where a test wants it."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from fakes import FakeSource, FakeSynthesizer, fake_config, traits

from gcd_model import NonFiniteError, RenderOptions, SourceFeatures, Traits, Trajectory, View
from gcd_node.lifecycle import Parts
from gcd_node.replay.lockstep import replay
from gcd_node.replay.run import RunFolder

WINDOWS, FRAMES = 3, 14
SOURCE = 'kind = "synthetic"\nframes = 42'


class LevelModel(FakeSynthesizer):
    """Gives the source back, each level a whole number lower: by one for each step beyond the first, and by `lower`
    at (window, frame). `classes` moves the class numbers of a window's frame 0 in so many columns."""

    def __init__(
        self,
        made: Traits | None = None,
        lower: Mapping[tuple[int, int], int] | None = None,
        classes: Mapping[int, int] | None = None,
        **more: Any,
    ) -> None:
        super().__init__(made or traits(), **more)
        self._lower, self._classes = lower or {}, classes or {}

    def render(
        self, features: SourceFeatures, trajectories: Sequence[Trajectory], options: RenderOptions | None = None
    ) -> list[View]:
        window, steps = len(self.asked), 1 if options is None else options.steps or 1
        video = ((features.latents + 1) / 2 * 255).round() - (steps - 1)
        for (at, frame), levels in self._lower.items():
            video[frame] -= levels if at == window else 0
        views = super().render(features, trajectories, options)
        for view in views:
            if view.classes is not None:
                first = view.classes[:, 0, :, : self._classes.get(window, 0)]
                first.add_(1).remainder_(len(self.traits.classes))
        return [replace(view, samples=(video / 255)[None]) for view in views]


def nan_model(windows: set[int]) -> FakeSynthesizer:
    """NaN in these windows, in both attempts."""
    calls = iter(window for window in range(99) for _ in range(2 if window in windows else 1))

    def act(_: RenderOptions) -> None:
        if next(calls) in windows:
            raise NonFiniteError("NaN in the latents")

    return LevelModel(act=act)


def parts(model: FakeSynthesizer | None = None, source: FakeSource | None = None) -> Parts:
    chosen, played = model or LevelModel(), source or FakeSource(WINDOWS * FRAMES)
    return Parts(open_source=lambda _: played, load_model=lambda _: chosen)


def made_run(
    folder: Path, model: FakeSynthesizer | None = None, source: FakeSource | None = None, changes: Sequence[str] = ()
) -> RunFolder:
    return replay(fake_config("model.steps=1", *changes, source=SOURCE), folder, parts=parts(model, source))


def copied(run: RunFolder, folder: Path) -> Path:
    return Path(shutil.copytree(run.path, folder))
