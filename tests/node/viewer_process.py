"""A node in a process of its own, steered by angles; says when it is there and runs until it is killed. Not a test:
started by test_viewer_browser.py."""

import sys
from pathlib import Path

from fakes import FakeSynthesizer, traits
from rig import rig_config

from gcd_node.lifecycle import Parts
from gcd_node.session import open_session
from gcd_node.sources import open_source

VIEWS = "[view.left]\nazimuth_deg = -30.0\n[view.swing]\nkind = 'orbit'\nrate_deg_s = 10.0\namplitude_deg = 20.0"
SOURCE = 'kind = "synthetic"\npace = "realtime"\nfps = 24.0\nhfov_deg = 53.1'


def main(folder: Path) -> None:
    """Run the node on sockets in `folder`."""
    model = FakeSynthesizer(traits())
    parts = Parts(open_source=open_source, load_model=lambda _: model)
    with open_session(rig_config(folder, SOURCE, VIEWS, ""), parts=parts, once=False) as (node, *_):
        print("there", flush=True)
        node.run()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
