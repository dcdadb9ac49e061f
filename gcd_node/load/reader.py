"""A planner in a process of its own that says what arrives: one JSON object a line. Ends when its stdin does.

python -m gcd_node.load.reader ENDPOINT VIEW [--newest] [--pause SECONDS] [--stall SECONDS]
"""

import argparse
import json
import sys
import time

from gcd_node.load.parent import end_with_parent
from gcd_node.subscriber import ReceivedView, ViewSubscriber

_AWAKE_S = 1.0


def main() -> None:
    """Read until the parent ends this process.

    newest: keep only the newest view. pause: after each view. stall: read for a second, then nothing for so long.
    """
    parser = argparse.ArgumentParser()
    parser.add_argument("endpoint")
    parser.add_argument("view")
    parser.add_argument("--newest", action="store_true")
    parser.add_argument("--pause", type=float, default=0.0)
    parser.add_argument("--stall", type=float, default=0.0)
    options = parser.parse_args()
    end_with_parent()
    with ViewSubscriber(options.endpoint, options.view, conflate=options.newest) as views:
        asleep_s = time.monotonic() + _AWAKE_S
        while True:
            view = views.receive(1000.0)
            if view is not None:
                _tell(view, time.monotonic_ns())
                time.sleep(options.pause)
            if options.stall and time.monotonic() > asleep_s:
                time.sleep(options.stall)
                asleep_s = time.monotonic() + _AWAKE_S


def _tell(view: ReceivedView, arrived_ns: int) -> None:
    header = view.header
    told = {
        "arrived_ns": arrived_ns,
        "first_seq": header.src.seq[0],
        "last_seq": header.src.seq[-1],
        "window_id": header.window_id,
        "skipped": view.skipped,
    }
    sys.stdout.write(json.dumps(told) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
