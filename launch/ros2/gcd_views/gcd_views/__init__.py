"""Views of a gcd node as ROS 2 topics."""
