"""A planner in its own process: only what a planner may need can be imported here.

reader_process.py ENDPOINT VIEW [--all] [--slow SECONDS]
Prints `window sequence skipped restarted checksum` for each view, then `end`.
"""

import sys
import time
import zlib

BLOCKED = {"torch", "cv2", "kornia", "rich", "typer", "gcd_model", "gcd_node"}


class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in BLOCKED:
            raise ImportError(f"a planner has no {name}")


def main() -> None:
    from gcd_client.subscriber import ViewSubscriber

    endpoint, view, *options = sys.argv[1:]
    pause_s = float(options[options.index("--slow") + 1]) if "--slow" in options else 0.0
    with ViewSubscriber(endpoint, view, conflate="--all" not in options) as views:
        for received in views:
            assert not received.images.flags.writeable
            crc = zlib.crc32(received.images)
            print(received.header.window_id, received.message.sequence, received.skipped, received.restarted, crc)
            sys.stdout.flush()
            time.sleep(pause_s)
        print("end", flush=True)


sys.meta_path.insert(0, Blocker())
main()
