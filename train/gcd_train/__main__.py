"""`python -m gcd_train`, for torchrun: the same as `gcd-train`."""

from gcd_train.cli.main import main

main()
