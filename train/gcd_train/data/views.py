"""Training pairs of a 4D data set: what a source camera saw, and what a camera on another path would have seen."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from gcd_model.errors import ModelError
from gcd_model.geometry import relative_pose
from gcd_train.data.dataset4d import Dataset4D
from gcd_train.data.files import FileFault, Skipped, Skips, bytes_read
from gcd_train.data.paths import Draw, Sampling, generator
from gcd_train.data.pictures import PictureOptions, pictures_of
from gcd_train.data.sample import Sample
from gcd_train.data.splits import Control
from gcd_train.errors import DataError, RecipeError, RenderError, TrainError

_TRIES, _NAMED = 100, 5
_REPEATS = 400


class ViewPairs:
    """Samples of a data set by number. The same (seed, index) gives the same sample, in any order, in any process.

    dataset: where pictures come from. sampling: frames and paths, for one `paths.MAX90` or `DRIVING`. options: what is
    made of them. repeats: the set counts as so many times its scenes; scene of index i is i mod the number of scenes.
    A sample that cannot be read is counted in `skips` and replaced by another, at most 100 times.

    Safe in the workers of a loader: give it to `torch.utils.data.DataLoader(pairs, collate_fn=collate)`; where this
    process has drawn with OpenGL before, with `multiprocessing_context="spawn"`.
    """

    def __init__(
        self,
        dataset: Dataset4D,
        sampling: Sampling,
        seed: int = 0,
        options: PictureOptions | None = None,
        *,
        repeats: int = _REPEATS,
    ) -> None:
        if not dataset.scenes:
            raise DataError("a data set without scenes has no pairs; look at its folder, split and list")
        self.dataset, self.sampling, self.seed, self._repeats = dataset, sampling, seed, repeats
        self.skips = Skips()
        self._pictures = pictures_of(dataset, options or PictureOptions())

    def __len__(self) -> int:
        return self._repeats * len(self.dataset.scenes)

    def __getitem__(self, index: int) -> Sample:
        """As `sample`, for a loader. Raises IndexError beyond the end."""
        if not 0 <= index < len(self):
            raise IndexError(f"{index} is beyond the {len(self)} samples")
        return self.sample(index)

    def sample(self, index: int, /) -> Sample:
        """The sample of a number, or of the one that replaces it.

        Raises:
            DataError: a hundred in a row cannot be read; it names the last faults.
            RenderError, RecipeError: exact pictures cannot be drawn on this machine, or an option is wrong.
        """
        before = bytes_read()

        def made(number: int) -> Sample:
            scene = self.dataset.scenes[number % len(self.dataset.scenes)]
            frames, random = self.dataset.frames(scene), generator(self.seed, number)
            return self._pair(scene, self.sampling.draw(random, frames, self.dataset.fps))

        def place(number: int) -> tuple[str, Path]:
            scene = self.dataset.scenes[number % len(self.dataset.scenes)]
            return scene, self.dataset.folder(scene)

        sample = readable(self.seed, index, len(self), self.skips, made, place)
        return replace(sample, bytes_read=bytes_read() - before)

    def controlled(self, scene: str, control: Control) -> Sample:
        """The sample of a scene that a control list asks for.

        Raises: DataError, FileFault: it cannot be read; nothing stands in for it.
        """
        draw = self.sampling.controlled(control, self.dataset.frames(scene), self.dataset.fps)
        return self.pair(scene, draw)

    def pair(self, scene: str, draw: Draw) -> Sample:
        """A sample drawn elsewhere. Raises DataError, FileFault: it cannot be read."""
        before = bytes_read()
        return replace(self._pair(scene, draw), bytes_read=bytes_read() - before)

    def _pair(self, scene: str, draw: Draw) -> Sample:
        made = self._pictures.make(scene, draw)
        world_from_source, world_from_target = map(torch.from_numpy, (made.world_from_source, draw.world_from_target))
        return Sample(
            source=made.source,
            target=made.target,
            target_classes=made.target_classes,
            source_from_target=relative_pose(world_from_source, world_from_target).numpy(),
            start=draw.start,
            deltas=draw.deltas,
            fps=draw.fps,
            scene=scene,
            frame_numbers=draw.frame_numbers,
            visible=made.visible,
        )


def readable(
    seed: int,
    index: int,
    length: int,
    skips: Skips,
    made: Callable[[int], Sample],
    place: Callable[[int], tuple[str, Path]],
) -> Sample:
    """The sample of a number or, where it cannot be read, of the first of a hundred stand-ins that can.

    made: the sample of a number. place: its scene, and the folder or file that is named for a fault that names none.
    Raises: DataError if none can be read; it names the last faults. RenderError, RecipeError: no other would do better.
    """
    skipped: list[Skipped] = []
    for attempt in range(_TRIES + 1):
        number = index if attempt == 0 else int(generator(seed, index, attempt).integers(length))
        try:
            return replace(made(number), skipped=tuple(skipped))
        except (RenderError, RecipeError):
            raise
        except (TrainError, ModelError, OSError) as error:
            scene, file = place(number)
            reason = str(error)
            if isinstance(error, FileFault):
                file, reason = error.path, error.reason
            elif isinstance(error, OSError) and error.filename:
                file = Path(str(error.filename))
            skipped.append(skips.add(scene, file, reason))
    last = "; ".join(map(str, skipped[-_NAMED:]))
    raise DataError(f"{len(skipped)} samples in a row cannot be read, the last: {last}")
