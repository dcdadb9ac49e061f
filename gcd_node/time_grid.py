"""Where in time the frames of windows belong."""


class TimeGrid:
    """Points in time, evenly spaced; with `follow` > 0 each is drawn that part of the way to the frame it took."""

    def __init__(self, *, fps: float, follow: float) -> None:
        self.period_ns = 1e9 / fps
        self.next_ns = 0
        self._follow = follow
        self._start_ns = 0
        self._index = 0

    def start(self, stamp_ns: int) -> None:
        """Put the first point here."""
        self._start_ns = self.next_ns = stamp_ns
        self._index = 0

    def advance(self, taken_ns: int | None) -> None:
        """Go to the next point; taken_ns is the stamp of the frame this one took, None for a hole."""
        if taken_ns is not None and self._follow > 0:
            self._start_ns += round(self._follow * (taken_ns - self.next_ns))
        self._index += 1
        self.next_ns = self._start_ns + round(self._index * self.period_ns)
