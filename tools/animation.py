"""A video as a moving picture that plays for ever on a page, such as the README's.

python tools/animation.py gcd-demo/side_by_side.mp4 docs/demo.webp
"""

import argparse
from pathlib import Path

import cv2
from replay_sheet import video_frames


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description="A video as a .webp that plays for ever.")
    parser.add_argument("video", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--width", type=int, default=1000, help="pixels")
    parser.add_argument("--quality", type=int, default=60)
    options = parser.parse_args()
    frames, fps = video_frames(options.video), cv2.VideoCapture(str(options.video)).get(cv2.CAP_PROP_FPS)
    size = (options.width, round(frames[0].shape[0] * options.width / frames[0].shape[1]))
    animation = cv2.Animation()
    animation.frames = [cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in frames]
    animation.durations = [round(1000 / fps)] * len(frames)
    if not cv2.imwriteanimation(str(options.picture), animation, [cv2.IMWRITE_WEBP_QUALITY, options.quality]):
        raise SystemExit(f"{options.picture} cannot be written")


if __name__ == "__main__":
    main()
