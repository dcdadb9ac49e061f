"""A robot arm at a table: reach, grasp, lift, carry, place and push, with real contact physics."""
