"""Push a ROS 2 image topic, and if there is one its aligned depth, into a node that runs launch/push.toml.

    python push_ros2.py /camera/color/image_raw --depth /camera/aligned_depth_to_color/image_raw

A topic that ends in /compressed is passed on as JPEG. Stamps are the headers': a driver on another clock than UTC, such
as a simulator's, is refused by the node. Needs a sourced ROS 2, numpy and gcd-client; not yet tried on a robot.
"""

import argparse
from typing import Any

import numpy as np

from gcd_client import FramePusher

CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1}


def stamp_ns(message: Any) -> int:
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


def picture(message: Any) -> np.ndarray:
    """A sensor_msgs/Image as u8 [H, W, 3], RGB."""
    channels = CHANNELS[message.encoding]
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
    pixels = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    if channels == 1:
        return np.repeat(pixels, 3, axis=2)
    return pixels[..., 2::-1] if message.encoding.startswith("bgr") else pixels[..., :3]


def metres(message: Any) -> np.ndarray:
    """A depth image, 16UC1 in millimetres or 32FC1 in metres, as float32 [H, W]."""
    kind, unit = {"16UC1": ("<u2", 1e-3), "32FC1": ("<f4", 1.0)}[message.encoding]
    rows = np.frombuffer(message.data, kind).reshape(message.height, -1)
    return (rows[:, : message.width] * np.float32(unit)).astype(np.float32)


def main() -> None:
    import message_filters
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CompressedImage, Image

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("topic", help="of sensor_msgs/Image, or of CompressedImage if it ends in /compressed")
    parser.add_argument("--depth", help="topic of depth that is aligned with the pictures")
    parser.add_argument("--endpoint", default="ipc", help="of the node: ipc, ipc:///some/path or tcp://HOST:PORT")
    arguments, ros_arguments = parser.parse_known_args()
    rclpy.init(args=ros_arguments)
    node = rclpy.create_node("gcd_pusher")
    compressed = arguments.topic.endswith("/compressed")
    topics = [(CompressedImage if compressed else Image, arguments.topic)]
    topics += [(Image, arguments.depth)] if arguments.depth else []
    with FramePusher(arguments.endpoint) as pusher:

        def push(color: Any, depth: Any = None) -> None:
            image = bytes(color.data) if compressed else picture(color)
            pusher.push(image, stamp_ns(color), None if depth is None else metres(depth))

        filters = [
            message_filters.Subscriber(node, kind, topic, qos_profile=qos_profile_sensor_data) for kind, topic in topics
        ]
        message_filters.ApproximateTimeSynchronizer(filters, queue_size=5, slop=0.02).registerCallback(push)
        rclpy.spin(node)


if __name__ == "__main__":
    main()
