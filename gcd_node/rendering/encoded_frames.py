"""Frames as the network takes them, encoded one by one: while the window fills, and once for all windows that overlap.

What is encoded of a frame follows from its pixels, its number and what is in EncodeTerms alone. One frame is encoded at
a time, always, because the last bits of a convolution may depend on how many there are. So a window is the same to the
last bit whether its frames were encoded when they arrived, for the window before, or all at its end.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model import Augmentation, CameraMount, Clip, SourceFeatures, ViewSynthesizer
from gcd_node.rendering.seeds import frame_seed

_Key: TypeAlias = tuple[int, int]  # epoch and stamp: a builder never gives the same twice


@dataclass(frozen=True, kw_only=True, slots=True)
class EncodeTerms:
    """What decides, beside the frames, how they are encoded. digest: see config_digest(). strength: of the noise, None
    for the checkpoint's own. mount: of the source camera."""

    digest: str
    strength: float | None
    mount: CameraMount | None


class PlacedFrames(Protocol):
    """Frames in their places: a FrameWindow, or as much as there is of the next one (Filling)."""

    @property
    def clip(self) -> NDArray[np.float32]:
        """float32 [n, 3, H, W] in [-1, 1]."""
        ...

    @property
    def stamps_ns(self) -> tuple[int, ...]:
        """Of each frame."""
        ...

    @property
    def seqs(self) -> tuple[int, ...]:
        """Of each frame."""
        ...

    @property
    def fps(self) -> float:
        """What the network is told."""
        ...

    @property
    def epoch(self) -> int:
        """Of all of them."""
        ...


class EncodedFrames:
    """Keeps what was encoded of the frames it was last asked for: never of more than a window. For one thread, and one
    model: `forget` where that is exchanged."""

    def __init__(self, beat: Callable[[], None]) -> None:
        """beat: called before every frame that is encoded."""
        self._beat = beat
        self._rows: dict[_Key, SourceFeatures] = {}
        self._alike: tuple[EncodeTerms, float] | None = None

    def __len__(self) -> int:
        """How many frames are kept."""
        return len(self._rows)

    def forget(self) -> None:
        """Keep nothing."""
        self._rows.clear()

    def ahead(self, synthesizer: ViewSynthesizer, frames: PlacedFrames, terms: EncodeTerms) -> bool:
        """Encode one more of these frames, the oldest that is not yet. False, and nothing was done, if all are.

        Raises: as ViewSynthesizer.encode.
        """
        missing = self._missing(frames, terms)
        if missing:
            self._encode(synthesizer, frames, missing[0], terms)
        return bool(missing)

    def features(self, synthesizer: ViewSynthesizer, frames: PlacedFrames, terms: EncodeTerms) -> SourceFeatures:
        """All of these frames, at least one; what is not yet encoded is now.

        Raises: as ViewSynthesizer.encode.
        """
        for index in self._missing(frames, terms):
            self._encode(synthesizer, frames, index, terms)
        keys = _keys(frames)
        first, *others = (self._rows[key] for key in keys)
        joined = first.followed_by(*others)
        self._rows = {key: joined.rows(i, i + 1) for i, key in enumerate(keys)}  # the windows before may go
        return joined

    def _missing(self, frames: PlacedFrames, terms: EncodeTerms) -> list[int]:
        """Places of the frames that are not encoded; all other frames are forgotten."""
        if self._alike != (terms, frames.fps):
            self.forget()
            self._alike = (terms, frames.fps)
        keys = _keys(frames)
        self._rows = {key: self._rows[key] for key in keys if key in self._rows}
        return [place for place, key in enumerate(keys) if key not in self._rows]

    def _encode(self, synthesizer: ViewSynthesizer, frames: PlacedFrames, place: int, terms: EncodeTerms) -> None:
        self._beat()
        clip = Clip(video=torch.from_numpy(frames.clip[place : place + 1]), fps=frames.fps, mount=terms.mount)
        noise = Augmentation(strength=terms.strength, seed=frame_seed(terms.digest, frames.seqs[place]))
        self._rows[_keys(frames)[place]] = synthesizer.encode(clip, noise)


def _keys(frames: PlacedFrames) -> list[_Key]:
    return [(frames.epoch, stamp_ns) for stamp_ns in frames.stamps_ns]
