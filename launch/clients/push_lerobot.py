"""Push a LeRobot camera into a node that runs launch/push.toml: `python push_lerobot.py 0`.

In a loop of your own that already reads the cameras (teleoperation, a policy), one line does it:

    pusher.push(observation["front"], time.time_ns())

Needs lerobot and gcd-client; not yet tried on a robot.
"""

import argparse
import time

from gcd_client import FramePusher


def main() -> None:
    from lerobot.cameras.opencv.camera_opencv import OpenCVCamera
    from lerobot.cameras.opencv.configuration_opencv import OpenCVCameraConfig

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("camera", help="its number or path, as lerobot-find-cameras tells them")
    parser.add_argument("--endpoint", default="ipc", help="of the node: ipc, ipc:///some/path or tcp://HOST:PORT")
    arguments = parser.parse_args()
    place = int(arguments.camera) if arguments.camera.isdigit() else arguments.camera
    camera = OpenCVCamera(OpenCVCameraConfig(index_or_path=place, fps=30, width=640, height=480))
    camera.connect()
    try:
        with FramePusher(arguments.endpoint) as pusher:
            while True:
                image = camera.async_read()  # u8 [H, W, 3], RGB unless its config says otherwise
                pusher.push(image, time.time_ns())
    finally:
        camera.disconnect()


if __name__ == "__main__":
    main()
