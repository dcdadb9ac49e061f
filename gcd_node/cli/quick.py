"""The commands that talk to a running node. Nothing here brings torch along: they are there at once."""

from gcd_node.cli.control import ctl, keys
from gcd_node.cli.root import new_app
from gcd_node.cli.status import status

QUICK = ("ctl", "keys", "status")
"""Their names."""

app = new_app()
app.command()(ctl)
app.command()(status)
app.add_typer(keys, name="keys")
