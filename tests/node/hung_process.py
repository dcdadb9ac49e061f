"""A node in its own process that hangs and hears no cancel: while its model loads or renders.

hung_process.py FOLDER load|render
Prints `hangs` once it does.
"""

import sys
import time
from pathlib import Path

from fakes import FakeSource, FakeSynthesizer, traits
from rig import rig_config

from gcd_model import ViewSynthesizer
from gcd_node.config import ModelSection
from gcd_node.lifecycle import Parts
from gcd_node.session import open_session, run_until_signal


def hang(_: object = None) -> None:
    print("hangs", flush=True)
    time.sleep(3600)


def load(_: ModelSection) -> ViewSynthesizer:
    if sys.argv[2] == "load":
        hang()
    return FakeSynthesizer(traits(), hang)


def main() -> None:
    config = rig_config(Path(sys.argv[1]), 'kind = "synthetic"\npace = "lockstep"', "[view.main]", "")
    parts = Parts(open_source=lambda _: FakeSource(100_000), load_model=load)
    with open_session(config, parts=parts, once=False) as (node, publisher, _):
        run_until_signal(node, publisher)
    print("left behind" if node.left_behind else "all ended", flush=True)


main()
