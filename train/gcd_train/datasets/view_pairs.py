"""Training pairs of a 4D data set: what a source camera saw, and what a camera on another path would have seen."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gcd_model.errors import ModelError
from gcd_model.geometry import relative_pose
from gcd_train.datasets.controls import Control
from gcd_train.datasets.dataset4d import Dataset4D, PairSample
from gcd_train.datasets.exact_pictures import ExactPictures
from gcd_train.datasets.picture_files import bytes_read
from gcd_train.datasets.pictures_of_draws import Modality, Pictures
from gcd_train.datasets.skips import FileFault, Skipped, Skips
from gcd_train.datasets.splat_pictures import SplatPictures
from gcd_train.datasets.trajectories import Draw, Sampling, generator
from gcd_train.errors import DataError, RecipeError, RenderError, TrainError

__all__ = ["Dataset4D", "PairBatch", "PairSample", "ViewPairs", "collate"]

_TRIES = 100
_REPEATS = 400
_TOLD = 5


class ViewPairs:
    """Samples of a data set by number. The same (seed, index) gives the same sample, in any order, in any process.

    dataset: where pictures come from. sampling: frames and paths, for one `trajectories.MAX90` or `DRIVING`.
    size: width and height of the samples, pixels. repeats: the set counts as so many times its scenes; scene of index i
    is i mod the number of scenes. modality: the target in colour, or painted by class. class_ids: also the
    target's classes. visible: also say what of the target the source camera saw. exact: draw the target from the
    geometry our own scenes keep, instead of from points. published: points as released, with its approximations; open
    Kubric-4D with `published` too then.
    A sample that cannot be read is counted in `skips` and replaced by another, at most 100 times.

    Safe in the workers of a loader: give it to `torch.utils.data.DataLoader(pairs, collate_fn=collate)`; where this
    process has drawn with OpenGL before, with `multiprocessing_context="spawn"`.
    """

    def __init__(
        self,
        dataset: Dataset4D,
        sampling: Sampling,
        seed: int = 0,
        size: tuple[int, int] = (384, 256),
        *,
        repeats: int = _REPEATS,
        modality: Modality = "rgb",
        class_ids: bool = False,
        visible: bool = False,
        exact: bool = False,
        published: bool = False,
        device: str | None = None,
    ) -> None:
        if not dataset.scenes:
            raise DataError("a data set without scenes has no pairs; look at its folder, split and list")
        self.dataset, self.sampling, self.seed, self._repeats = dataset, sampling, seed, repeats
        self.skips = Skips()
        kind = ExactPictures if exact else SplatPictures
        self._pictures: Pictures = kind(
            dataset,
            size,
            modality=modality,
            class_ids=class_ids,
            visible=visible,
            published=published,
            device=device,
        )

    def __len__(self) -> int:
        return self._repeats * len(self.dataset.scenes)

    def __getitem__(self, index: int) -> PairSample:
        """As `sample`, for a loader. Raises IndexError beyond the end."""
        if not 0 <= index < len(self):
            raise IndexError(f"{index} is beyond the {len(self)} samples")
        return self.sample(index)

    def sample(self, index: int) -> PairSample:
        """The sample of a number, or of the one that replaces it.

        Raises:
            DataError: a hundred in a row cannot be read; it names the last faults.
            RenderError, RecipeError: exact pictures cannot be drawn on this machine, or an option is wrong.
        """
        skipped: list[Skipped] = []
        read_before = bytes_read()
        for number in self._numbers(index):
            scene = self.dataset.scenes[number % len(self.dataset.scenes)]
            try:
                frames, rng = self.dataset.frames(scene), generator(self.seed, number)
                draw = self.sampling.draw(rng, frames, self.dataset.fps)
                return self._pair(scene, draw, tuple(skipped), read_before)
            except (RenderError, RecipeError):
                raise  # no other sample would do better
            except (TrainError, ModelError, OSError) as error:
                skipped.append(self._left_out(scene, error))
        last = "; ".join(map(str, skipped[-_TOLD:]))
        raise DataError(f"{len(skipped)} samples in a row cannot be read, the last: {last}")

    def controlled(self, scene: str, control: Control) -> PairSample:
        """The sample of a scene that a control list asks for.

        Raises: DataError, FileFault: it cannot be read; nothing stands in for it.
        """
        draw = self.sampling.controlled(control, self.dataset.frames(scene), self.dataset.fps)
        return self.pair(scene, draw)

    def pair(self, scene: str, draw: Draw) -> PairSample:
        """A sample drawn elsewhere. Raises DataError, FileFault: it cannot be read."""
        return self._pair(scene, draw, (), bytes_read())

    def _pair(self, scene: str, draw: Draw, skipped: tuple[Skipped, ...], read_before: int) -> PairSample:
        made = self._pictures.make(scene, draw)
        world_from_source, world_from_target = map(torch.from_numpy, (made.world_from_source, draw.world_from_target))
        return PairSample(
            source=made.source,
            target=made.target,
            target_classes=made.target_classes,
            source_from_target=relative_pose(world_from_source, world_from_target).numpy(),
            start=draw.start,
            deltas=draw.deltas,
            motion=draw.motion,
            fps=draw.fps,
            scene=scene,
            frame_numbers=draw.frame_numbers,
            reversed=draw.reversed,
            visible=made.visible,
            skipped=skipped,
            bytes_read=bytes_read() - read_before,
        )

    def _numbers(self, index: int) -> Iterator[int]:
        """The sample's own number, then others in its stead."""
        yield index
        for attempt in range(1, _TRIES + 1):
            yield int(generator(self.seed, index, attempt).integers(len(self)))

    def _left_out(self, scene: str, error: Exception) -> Skipped:
        if isinstance(error, FileFault):
            return self.skips.add(scene, error.path, error.reason)
        file = error.filename if isinstance(error, OSError) and error.filename else self.dataset.folder(scene)
        return self.skips.add(scene, str(file), str(error))


@dataclass(frozen=True, kw_only=True, slots=True)
class PairBatch:
    """Several samples of T frames.

    source, target: u8 [B, T, H, W, 3]. target_classes: u8 [B, T, H, W] and visible: bool [B, T, H, W], None where not
    asked for. source_from_target: f64 [B, T, 4, 4]. deltas: f64 [B, T, 3], None in driving. fps, motion: f32 [B].
    scenes: B names. skipped, bytes_read: of all of them.
    """

    source: Tensor
    target: Tensor
    target_classes: Tensor | None
    source_from_target: Tensor
    deltas: Tensor | None
    fps: Tensor
    motion: Tensor
    scenes: tuple[str, ...]
    visible: Tensor | None
    skipped: tuple[Skipped, ...]
    bytes_read: int

    def pin_memory(self) -> "PairBatch":
        """The pictures in page-locked memory, as a loader wants to hand them over to CUDA."""
        return replace(self, source=self.source.pin_memory(), target=self.target.pin_memory())


def collate(samples: Sequence[PairSample]) -> PairBatch:
    """Samples as one batch, for a DataLoader; the main process gives `skipped` to its own `Skips.extend`."""
    return PairBatch(
        source=_stacked([sample.source for sample in samples]),
        target=_stacked([sample.target for sample in samples]),
        target_classes=_stacked_if([sample.target_classes for sample in samples]),
        source_from_target=_stacked([sample.source_from_target for sample in samples]),
        deltas=_stacked_if([sample.deltas for sample in samples]),
        fps=torch.tensor([sample.fps for sample in samples]),
        motion=torch.tensor([float(sample.motion) for sample in samples]),
        scenes=tuple(sample.scene for sample in samples),
        visible=_stacked_if([sample.visible for sample in samples]),
        skipped=tuple(skipped for sample in samples for skipped in sample.skipped),
        bytes_read=sum(sample.bytes_read for sample in samples),
    )


def _stacked(rows: Sequence[NDArray[np.generic]]) -> Tensor:
    sizes = {row.shape for row in rows}
    if len(sizes) > 1:
        raise DataError(f"samples of one batch must have one size, got {sorted(sizes)}")
    return torch.from_numpy(np.stack(rows))


def _stacked_if(rows: Sequence[NDArray[np.generic] | None]) -> Tensor | None:
    there = [row for row in rows if row is not None]
    return _stacked(there) if len(there) == len(rows) else None
