"""Every command of `gcd-node`. Importing this takes seconds, as torch comes with it."""

from gcd_node.cli.bench import bench
from gcd_node.cli.check import check_launch
from gcd_node.cli.control import ctl, keys
from gcd_node.cli.export import export
from gcd_node.cli.node import demo, run, view
from gcd_node.cli.replay import diff, replay_launch
from gcd_node.cli.root import new_app
from gcd_node.cli.soak import soak
from gcd_node.cli.status import status
from gcd_node.cli.synthesize import synthesize
from gcd_node.cli.viewer import viewer
from gcd_node.cli.weights import weights

app = new_app()
app.command()(demo)
app.command()(run)
app.command("check")(check_launch)
app.command()(view)
app.command()(viewer)
app.command("replay")(replay_launch)
app.command()(diff)
app.command()(status)
app.command()(synthesize)
app.command()(export)
app.command()(ctl)
app.command()(soak)
app.add_typer(keys, name="keys")
app.add_typer(weights, name="weights")
app.add_typer(bench, name="bench")
