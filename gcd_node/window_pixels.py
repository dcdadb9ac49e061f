"""The pixels of a window, filled in as its frames arrive, so that little is left to do once the last one is there."""

import numpy as np
from numpy.typing import NDArray

from gcd_node.frame import Image
from gcd_node.optics.preprocess import write_planes


class WindowPixels:
    """The next window's pixels: as pictures, and as the network takes them. Belongs to one thread."""

    def __init__(self, frames: int) -> None:
        """frames: T."""
        self._frames = frames
        self._images: NDArray[np.uint8] = np.empty((frames, 0, 0, 3), np.uint8)
        self._clip: NDArray[np.float32] = np.empty((frames, 3, 0, 0), np.float32)

    def put(self, place: int, image: Image) -> None:
        """Take the picture of one place: u8 [H, W, 3].

        Places are filled one after another, from 0, or after `hand_over` from any other: then what comes before it is
        how the last window ended. Pictures of one window have one size. What was ever given away stays as it was.
        """
        if place == 0 or not self._images.flags.writeable or self._images.shape[1:] != image.shape:
            self._begin(image, place)
        self._images[place] = image
        write_planes(image, self._clip[place])

    def hand_over(self) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """The whole window, u8 [T, H, W, 3] RGB and float32 [T, 3, H, W] in [-1, 1]; nothing of it changes any more."""
        self._images.setflags(write=False)
        return self._images, self._clip

    def filled(self, count: int) -> NDArray[np.float32]:
        """The first `count` places of the next window, float32 [count, 3, H, W] in [-1, 1]; nothing of them changes any
        more. After `hand_over` these are how the last window ended."""
        begin = 0 if self._images.flags.writeable else self._frames - count
        return self._clip[begin : begin + count]

    def _begin(self, image: Image, shared: int) -> None:
        """Other arrays, which begin with the last `shared` places of these."""
        height, width, _ = image.shape
        images = np.empty((self._frames, height, width, 3), np.uint8)
        clip = np.empty((self._frames, 3, height, width), np.float32)
        if shared > 0:
            images[:shared], clip[:shared] = self._images[-shared:], self._clip[-shared:]
        self._images, self._clip = images, clip
