"""Frames as the network takes them, encoded one by one: while the window fills, and once for all windows that overlap.

What is encoded of a frame follows from its pixels, its number and what is in EncodeTerms alone. One frame is encoded at
a time, always, because the last bits of a convolution may depend on how many there are. So a window is the same to the
last bit whether its frames were encoded when they arrived, for the window before, or all at its end.
"""

import hashlib
from collections.abc import Callable, Set
from dataclasses import dataclass
from typing import TypeAlias

import torch

from gcd_model import (
    Augmentation,
    CameraMount,
    Clip,
    Intrinsics,
    PoseError,
    SourceFeatures,
    ViewSynthesizer,
    require_motion,
)
from gcd_node.errors import DepthError
from gcd_node.preprocess import to_image
from gcd_node.sources.depth import DepthSource
from gcd_node.window import PartialWindow

_Key: TypeAlias = tuple[int, int]  # epoch and stamp: a builder never gives the same twice


@dataclass(frozen=True, kw_only=True, slots=True)
class EncodeTerms:
    """What decides, beside the frames, how they are encoded. digest: see config_digest(). strength: of the noise, None
    for the checkpoint's own. mount, lens: of the source camera. depth: instead of the model's own."""

    digest: str
    strength: float | None
    mount: CameraMount | None
    lens: Intrinsics | None = None
    depth: DepthSource | None = None


class EncodedFrames:
    """Keeps what was encoded of the frames it was last asked for: never of more than a window. For one thread, and one
    model: `forget` where that is exchanged."""

    def __init__(
        self,
        beat: Callable[[], None],
        on_bad_depth: Callable[[DepthError], None] = lambda _: None,
        on_odometry: Callable[[PoseError | None], None] = lambda _: None,
    ) -> None:
        """beat: called before every frame that is encoded. on_bad_depth: called where the depth of one cannot be used;
        the model's own takes its place. on_odometry: called for every frame that has one; with an error, it is left
        out."""
        self._beat, self._on_bad_depth, self._on_odometry = beat, on_bad_depth, on_odometry
        self._last_pose: tuple[int, torch.Tensor] | None = None
        self._rows: dict[_Key, SourceFeatures] = {}
        self._guessed: Set[_Key] = set()
        self._alike: tuple[EncodeTerms, float] | None = None

    def __len__(self) -> int:
        """How many frames are kept."""
        return len(self._rows)

    @property
    def guessed(self) -> int:
        """Of how many of them the depth is the model's own, because the other could not be used."""
        return len(self._guessed & self._rows.keys())

    def forget(self) -> None:
        """Keep nothing."""
        self._rows.clear()
        self._guessed = set()

    def ahead(self, synthesizer: ViewSynthesizer, frames: PartialWindow, terms: EncodeTerms) -> bool:
        """Encode one more of these frames, the oldest that is not yet. False, and nothing was done, if all are.

        Raises: as ViewSynthesizer.encode.
        """
        missing = self._missing(frames, terms)
        if missing:
            self._encode(synthesizer, frames, missing[0], terms)
        return bool(missing)

    def features(self, synthesizer: ViewSynthesizer, frames: PartialWindow, terms: EncodeTerms) -> SourceFeatures:
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

    def _missing(self, frames: PartialWindow, terms: EncodeTerms) -> list[int]:
        """Places of the frames that are not encoded; all other frames are forgotten."""
        if self._alike != (terms, frames.fps):
            self.forget()
            self._alike = (terms, frames.fps)
        keys = _keys(frames)
        self._rows = {key: self._rows[key] for key in keys if key in self._rows}
        return [place for place, key in enumerate(keys) if key not in self._rows]

    def _encode(self, synthesizer: ViewSynthesizer, frames: PartialWindow, place: int, terms: EncodeTerms) -> None:
        self._beat()
        video = torch.from_numpy(frames.clip[place : place + 1])
        clip = Clip(
            video=video,
            fps=frames.fps,
            mount=terms.mount,
            lens=terms.lens,
            depth=self._depth(frames, place, terms.depth),
            odometry=self._odometry(frames, place),
        )
        noise = Augmentation(strength=terms.strength, seed=frame_seed(terms.digest, frames.seqs[place]))
        self._rows[_keys(frames)[place]] = synthesizer.encode(clip, noise)

    def _depth(self, frames: PartialWindow, place: int, network: DepthSource | None) -> torch.Tensor | None:
        """Of one frame, [1, H, W], as it was measured, else as a network has it; None where neither can be used."""
        measured, depth = frames.depths[place], None
        if measured is None and network is None:
            return None
        try:
            if measured is None and network is not None:
                measured = network(to_image(frames.clip[place]))
            if measured is not None and not measured.any():
                raise DepthError(f"a depth of {measured.shape[::-1]} is all holes: look at what measures it")
            depth = measured
        except DepthError as error:
            self._on_bad_depth(error)
        guessed = {_keys(frames)[place]} if depth is None else set[_Key]()
        self._guessed = self._guessed & self._rows.keys() | guessed
        return None if depth is None else torch.from_numpy(depth)[None]

    def _odometry(self, frames: PartialWindow, place: int) -> torch.Tensor | None:
        """Of one frame, [1, 4, 4]; None without one, or if no camera moves so. A jump costs the frame it ends at."""
        stated, before = frames.odometry[place], self._last_pose
        if stated is None:
            return None
        try:
            pose = require_motion(None, torch.tensor(stated))
            self._last_pose = frames.epoch, pose
            require_motion(before[1] if before is not None and before[0] == frames.epoch else None, pose)
        except PoseError as error:
            self._on_odometry(error)
            return None
        self._on_odometry(None)
        return pose[None]


def _keys(frames: PartialWindow) -> list[_Key]:
    return [(frames.epoch, stamp_ns) for stamp_ns in frames.stamps_ns]


def window_seed(config_digest: str, window_id: int, attempt: int) -> int:
    """Of the noise that sampling starts from, below 2^48 so that JSON holds it.

    attempt: 0, or 1 for a window that is rendered once more.
    """
    return _seed(f"{config_digest}/{window_id}/{attempt}")


def frame_seed(config_digest: str, seq: int) -> int:
    """Of the noise that is added to one frame before it is encoded, below 2^48: not of the window, as windows share
    frames, nor of the stamp, as a recording of a camera has others, and the same sequence numbers."""
    return _seed(f"{config_digest}/frame/{seq}")


def _seed(text: str) -> int:
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:6], "big")
