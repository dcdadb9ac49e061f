"""Client of a gcd node: receive its views and grids (subscriber), command it (control), push frames into it
(frames), read and write its messages (protocol).

gcd_client.images and .frames need numpy; `view.images`, FramePusher and their like import them when they are used.
gcd_client.lerobot, a camera for LeRobot's robots, needs lerobot.
"""

from typing import TYPE_CHECKING, Any

from gcd_client.control import ControlClient, ControlError, Reply
from gcd_client.endpoints import AuthError, ClientKeys, SetupError, read_key_pair, read_public_key
from gcd_client.protocol import (
    ClientError,
    GridHeader,
    GridMessage,
    MessageError,
    StatusMessage,
    ViewHeader,
    ViewMessage,
)
from gcd_client.subscriber import GridSubscriber, ReceivedGrid, ReceivedView, StatusSubscriber, ViewSubscriber

if TYPE_CHECKING:
    from gcd_client.frames import FramePusher
    from gcd_client.lerobot import GcdCamera

__all__ = [
    "AuthError", "ClientError", "ClientKeys", "ControlClient", "ControlError", "FramePusher", "GcdCamera", "GridHeader",
    "GridMessage", "GridSubscriber", "MessageError", "ReceivedGrid", "ReceivedView", "Reply",
    "SetupError", "StatusMessage", "StatusSubscriber", "ViewHeader", "ViewMessage", "ViewSubscriber",
    "read_key_pair", "read_public_key",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name == "FramePusher":
        from gcd_client.frames import FramePusher

        return FramePusher
    if name == "GcdCamera":  # LeRobot looks for it here, by the name of its config
        from gcd_client.lerobot import GcdCamera

        return GcdCamera
    raise AttributeError(f"gcd_client has no {name}")
