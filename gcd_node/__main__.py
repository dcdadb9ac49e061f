"""`python -m gcd_node` is `gcd-node`."""

from gcd_node.cli.main import main

main()
