"""Keeps what a node saw, made, said and was told, in MCAP files that ROS 2 tools and Foxglove open.

    Recorder       what the node tells; begins and ends recordings
    Recording      one of them: its queue and its thread
    McapPart       one file of it

Only McapPart needs the package `mcap` (extra `record`), and imports it when a file is opened. Of it we use the writer.
ROS messages are laid out here (cdr.py): `mcap-ros2-support` has an encoder only inside a writer of its own, which can
neither close a chunk early nor hold anything but ROS messages. The tests read everything back with both libraries.
"""
