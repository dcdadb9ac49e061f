"""A node in its own process whose model hangs in its first window and hears no cancel.

hung_process.py FOLDER
Prints `hangs` once it does.
"""

import sys
import time
from pathlib import Path

from fakes import FakeSource, FakeSynthesizer, traits
from rig import rig_config

from gcd_model import RenderOptions
from gcd_node.life.machinery import Parts
from gcd_node.node import Node, NodeOptions
from gcd_node.publisher import Publisher
from gcd_node.session import publisher_options, run_until_signal


def hang(_: RenderOptions) -> None:
    print("hangs", flush=True)
    time.sleep(3600)


def main() -> None:
    config = rig_config(Path(sys.argv[1]), 'kind = "synthetic"\npace = "lockstep"', "[view.main]", "")
    parts = Parts(open_source=lambda _: FakeSource(100_000), load_model=lambda _: FakeSynthesizer(traits(), hang))
    with Publisher(publisher_options(config)) as publisher:
        node = Node(config, parts, publisher, NodeOptions(once=False))
        run_until_signal(node, publisher)
    print("left behind" if node.left_behind else "all ended", flush=True)


main()
