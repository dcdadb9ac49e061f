"""Frames as the network takes them, encoded one by one: while the window fills, and once for all windows that overlap.

What is encoded of a frame follows from its pixels, its number and the configuration alone. One frame is encoded at
a time, always, because the last bits of a convolution may depend on how many there are. So a window is the same to the
last bit whether its frames were encoded when they arrived, for the window before, or all at its end.
"""

import hashlib
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from gcd_model import Augmentation, Clip, PoseError, SourceFeatures, ViewSynthesizer, require_motion
from gcd_node.errors import DepthError
from gcd_node.preprocess import to_clip_tensor
from gcd_node.sources.depth import DepthSource
from gcd_node.stream_context import StreamContext
from gcd_node.window import PartialWindow, PlacedFrame

_Key: TypeAlias = tuple[int, int]  # epoch and stamp: a builder never gives the same twice


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
        self._rows: dict[_Key, tuple[SourceFeatures, bool]] = {}  # and whether its depth is guessed
        self._alike: tuple[object, ...] = ()  # of all frames that are kept: what decides, beside them, how

    def __len__(self) -> int:
        """How many frames are kept."""
        return len(self._rows)

    @property
    def guessed(self) -> int:
        """Of how many of them the depth is the model's own, because the other could not be used."""
        return sum(is_guessed for _, is_guessed in self._rows.values())

    def forget(self) -> None:
        """Keep nothing."""
        self._rows.clear()

    def ahead(self, synthesizer: ViewSynthesizer, frames: PartialWindow, context: StreamContext) -> bool:
        """Encode one more of these frames, the oldest that is not yet. False, and nothing was done, if all are.

        Raises: as ViewSynthesizer.encode.
        """
        missing = self._missing(frames, context)
        if missing:
            self._encode(synthesizer, frames, missing[0], context)
        return bool(missing)

    def features(self, synthesizer: ViewSynthesizer, frames: PartialWindow, context: StreamContext) -> SourceFeatures:
        """All of these frames, at least one; what is not yet encoded is now.

        Raises: as ViewSynthesizer.encode.
        """
        for frame in self._missing(frames, context):
            self._encode(synthesizer, frames, frame, context)
        keys = [(frames.epoch, stamp_ns) for stamp_ns in frames.stamps_ns]
        first, *others = (self._rows[key][0] for key in keys)
        joined = first.followed_by(*others)  # the windows before may go
        self._rows = {key: (joined.rows(i, i + 1), self._rows[key][1]) for i, key in enumerate(keys)}
        return joined

    def _missing(self, frames: PartialWindow, context: StreamContext) -> list[PlacedFrame]:
        """The frames that are not encoded; all others but these are forgotten."""
        alike = context.digest, context.mount, context.intrinsics, context.depth, frames.fps
        if self._alike != alike:
            self.forget()
            self._alike = alike
        by_key = {(frames.epoch, frame.stamp_ns): frame for frame in frames.frames}
        self._rows = {key: row for key, row in self._rows.items() if key in by_key}
        return [frame for key, frame in by_key.items() if key not in self._rows]

    def _encode(
        self, synthesizer: ViewSynthesizer, window: PartialWindow, frame: PlacedFrame, context: StreamContext
    ) -> None:
        self._beat()
        depth = self._depth(frame, context.depth)
        clip = Clip(
            video=torch.from_numpy(to_clip_tensor(frame.image[None])),
            fps=window.fps,
            mount=context.mount,
            lens=context.intrinsics if context.traits.live or context.traits.splat != "none" else None,
            depth=None if depth is None else torch.from_numpy(depth)[None],
            odometry=self._odometry(frame, window.epoch),
        )
        noise = Augmentation(strength=context.config.model.cond_aug, seed=frame_seed(context.digest, frame.seq))
        is_guessed = depth is None and (frame.depth is not None or context.depth is not None)
        self._rows[window.epoch, frame.stamp_ns] = synthesizer.encode(clip, noise), is_guessed

    def _depth(self, frame: PlacedFrame, network: DepthSource | None) -> NDArray[np.float32] | None:
        """Of one frame, [H, W], as it was measured, else as a network has it; None where neither can be used."""
        depth = frame.depth
        try:
            if depth is None and network is not None:
                depth = network(frame.image)
            if depth is not None and not depth.any():
                raise DepthError(
                    f"a depth of {depth.shape[1]} x {depth.shape[0]} is all holes: look at what measures it"
                )
        except DepthError as error:
            self._on_bad_depth(error)
            return None
        return depth

    def _odometry(self, frame: PlacedFrame, epoch: int) -> torch.Tensor | None:
        """Of one frame, [1, 4, 4]; None without one, or if no camera moves so. A jump costs the frame it ends at."""
        if frame.odometry is None:
            return None
        before = self._last_pose
        try:
            pose = require_motion(None, torch.tensor(frame.odometry))
            self._last_pose = epoch, pose
            require_motion(before[1] if before is not None and before[0] == epoch else None, pose)
        except PoseError as error:
            self._on_odometry(error)
            return None
        self._on_odometry(None)
        return pose[None]


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
