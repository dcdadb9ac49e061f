"""The live node: a camera in, virtual camera views out over ZeroMQ. `gcd_node.subscriber` is for planners."""
