"""Nodes of a process of their own, with fakes inside; each prints a line once it is there.

node_process.py FOLDER steer       steered by angles, until it is killed: prints `there`
node_process.py FOLDER load|render hangs and hears no cancel while its model loads or renders: prints `hangs`
"""

import sys
import time
from pathlib import Path

from fakes import LOCKSTEP, FakeSource, FakeSynthesizer, traits
from rig import rig_config

from gcd_model import ViewSynthesizer
from gcd_node.config import ModelSection
from gcd_node.lifecycle import Parts
from gcd_node.session import open_session, run_until_signal
from gcd_node.sources import open_source

SWING = "[view.swing]\nkind = 'orbit'\nrate_deg_s = 10.0\namplitude_deg = 20.0"
STEERED = f"[view.left]\nazimuth_deg = -30.0\n{SWING}"
REALTIME = 'kind = "synthetic"\npace = "realtime"\nfps = 24.0\nhfov_deg = 53.1'


def steer(folder: Path) -> None:
    model = FakeSynthesizer(traits())
    parts = Parts(open_source=open_source, load_model=lambda _: model)
    with open_session(rig_config(folder, REALTIME, STEERED, ""), parts=parts, once=False) as (node, *_):
        print("there", flush=True)
        node.run()


def hang(_: object = None) -> None:
    print("hangs", flush=True)
    time.sleep(3600)


def load(_: ModelSection) -> ViewSynthesizer:
    if sys.argv[2] == "load":
        hang()
    return FakeSynthesizer(traits(), hang)


def end() -> None:
    parts = Parts(open_source=lambda _: FakeSource(100_000), load_model=load)
    config = rig_config(Path(sys.argv[1]), LOCKSTEP, "[view.main]", "")
    with open_session(config, parts=parts, once=False) as (node, publisher, _):
        run_until_signal(node, publisher)
    print("left behind" if node.left_behind else "all ended", flush=True)


if sys.argv[2] == "steer":
    steer(Path(sys.argv[1]))
else:
    end()
