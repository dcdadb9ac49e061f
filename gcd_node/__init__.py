"""The live node: a camera in, virtual camera views out over ZeroMQ. Planners import gcd_client instead."""
