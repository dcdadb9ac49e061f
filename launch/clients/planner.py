"""A planner's side, complete: holds the newest class map that may still be used, and turns it into caution.

Needs gcd-client alone. `python planner.py [ENDPOINT]`, beside `gcd-node run launch/demo.toml --set source.loop=true`.
"""

import sys
import time

import numpy as np

from gcd_client import ReceivedView, ViewSubscriber

LOOK_TWICE_FOR = {"car", "truck", "person", "cyclist"}


class Awareness:
    """The newest class map that may still be used, and why there is none if there is none."""

    def __init__(self, endpoint: str = "ipc", view: str = "topdown", max_age_ms: float = 10_000.0) -> None:
        self._views = ViewSubscriber(endpoint, view, "cls", max_age_ms=max_age_ms)
        self._held: ReceivedView | None = None
        self._until_s = 0.0
        self.why_not = "nothing has come yet"
        self.ended = False

    def poll(self, wait_ms: float = 0.0) -> ReceivedView | None:
        """What to use in this cycle. Call it in every one: what is held runs out by itself."""
        stale = self._views.stale
        received = self._views.receive(wait_ms)  # damaged and stale ones are left out and counted
        self.ended = self._views.ended
        if received is not None:
            self._take(received)
        elif self.ended:
            self._forget("the stream has ended")
        elif self._views.stale > stale:  # and what we hold is older still
            self._forget("what comes is older than max_age_ms")
        if self._held is not None and time.monotonic() > self._until_s:
            self._forget("the last one has expired")
        return self._held

    def close(self) -> None:
        self._views.close()

    def _take(self, received: ReceivedView) -> None:
        header = received.header
        if received.restarted:
            self._forget("the node was started anew")  # revisions, epochs and tracks of the old one mean nothing now
        elif self._held is not None and header.src.epoch != self._held.header.src.epoch:
            self._forget("the camera's clock or format jumped")  # here a tracker would begin anew
        if received.expired:
            self._forget("it came too late")
            return
        since_publish_ms = received.age_ms - header.age_ms
        self._held = received
        self._until_s = time.monotonic() + (header.valid_for_ms - since_publish_ms) / 1000

    def _forget(self, why: str) -> None:
        self._held, self.why_not = None, why


def caution(view: ReceivedView | None) -> float:
    """0 to 1, to be added to what other sensors ask for. 0 means: the view adds nothing. It never means: go."""
    if view is None or view.header.quality.ood:
        return 0.0
    wanted = [each.id for each in view.header.classes or () if each.name in LOOK_TWICE_FOR]
    at_goal = [role == "at_goal" for role in view.header.frame_role]
    drawn = np.isin(view.images[at_goal], wanted)  # bool [N, H, W, 1]; generated, never evidence of free space
    return min(1.0, 10.0 * float(drawn.mean())) if drawn.size else 0.0


def main(endpoint: str = "ipc") -> None:
    awareness = Awareness(endpoint)
    while not awareness.ended:
        view = awareness.poll(wait_ms=100.0)
        print(awareness.why_not if view is None else f"window {view.header.window_id}: caution {caution(view):.2f}")
    awareness.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
