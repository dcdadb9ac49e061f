"""Training pairs drawn by number: what a source camera saw of a scene, and what one on another path would have."""

from abc import ABC, abstractmethod
from dataclasses import replace
from pathlib import Path

import numpy as np

from gcd_model.errors import ModelError
from gcd_train.data.dataset4d import Dataset4D
from gcd_train.data.files import FileFault, Skipped, Skips
from gcd_train.data.paths import Draw, Sampling, generator
from gcd_train.data.pictures import PictureOptions, pictures_of
from gcd_train.data.sample import Sample
from gcd_train.data.splits import Control
from gcd_train.errors import DataError, RecipeError, RenderError, TrainError

_TRIES, _NAMED = 100, 5


class DrawnSamples(ABC):
    """Samples by number. The same (seed, index) gives the same sample, in any order, in any process.

    A sample that cannot be read is counted in `skips` and replaced by another, at most 100 times.
    """

    def __init__(self, seed: int, count: int) -> None:
        self.seed, self._count, self.skips = seed, count, Skips()

    @abstractmethod
    def _made(self, number: int, random: np.random.Generator) -> Sample:
        """The sample of a number."""

    @abstractmethod
    def _place(self, number: int) -> tuple[str, Path]:
        """Its scene, and the folder or file that is named for a fault that names none."""

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Sample:
        """As `sample`, for a loader. Raises IndexError beyond the end."""
        if not 0 <= index < len(self):
            raise IndexError(f"{index} is beyond the {len(self)} samples")
        return self.sample(index)

    def sample(self, index: int, /) -> Sample:
        """The sample of a number or, where it cannot be read, of the first of a hundred stand-ins that can.

        Raises:
            DataError: a hundred in a row cannot be read; it names the last faults.
            RenderError, RecipeError: no other would do better.
        """
        skipped: list[Skipped] = []
        for attempt in range(_TRIES + 1):
            number = index if attempt == 0 else int(generator(self.seed, index, attempt).integers(len(self)))
            try:
                return replace(self._made(number, generator(self.seed, number)), skipped=tuple(skipped))
            except (RenderError, RecipeError):
                raise
            except (TrainError, ModelError, OSError) as error:
                scene, file = self._place(number)
                reason = str(error)
                if isinstance(error, FileFault):
                    file, reason = error.path, error.reason
                elif isinstance(error, OSError) and error.filename:
                    file = Path(str(error.filename))
                skipped.append(self.skips.add(scene, file, reason))
        last = "; ".join(map(str, skipped[-_NAMED:]))
        raise DataError(f"{len(skipped)} samples in a row cannot be read, the last: {last}")


class ViewPairs(DrawnSamples):
    """Samples of a data set in a published layout.

    dataset: where pictures come from. sampling: frames and paths, for one `paths.MAX90` or `DRIVING`. options: what is
    made of them. repeats: the set counts as so many times its scenes; scene of index i is i mod the number of scenes.

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
        repeats: int = 400,
    ) -> None:
        if not dataset.scenes:
            raise DataError("a data set without scenes has no pairs; look at its folder, split and list")
        super().__init__(seed, repeats * len(dataset.scenes))
        self.dataset, self.sampling = dataset, sampling
        self._pictures = pictures_of(dataset, options or PictureOptions())

    def controlled(self, scene: str, control: Control) -> Sample:
        """The sample of a scene that a control list asks for.

        Raises: DataError, FileFault: it cannot be read; nothing stands in for it.
        """
        return self.pair(scene, self.sampling.controlled(control, self.dataset.frames(scene), self.dataset.fps))

    def pair(self, scene: str, draw: Draw) -> Sample:
        """A sample drawn elsewhere. Raises DataError, FileFault: it cannot be read."""
        return self._pictures.make(scene, draw)

    def _made(self, number: int, random: np.random.Generator) -> Sample:
        scene, _ = self._place(number)
        return self.pair(scene, self.sampling.draw(random, self.dataset.frames(scene), self.dataset.fps))

    def _place(self, number: int) -> tuple[str, Path]:
        scene = self.dataset.scenes[number % len(self.dataset.scenes)]
        return scene, self.dataset.folder(scene)
