"""Starts the bridge beside a running gcd node:

ros2 launch gcd_views gcd_views.launch.py folder:=/run/gcd/topdown source_frame:=oak_rgb_camera_optical_frame
"""

from launch.actions import DeclareLaunchArgument  # noqa: TID251
from launch.substitutions import LaunchConfiguration, PythonExpression  # noqa: TID251
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription  # noqa: TID251  ROS's package, not our folder

ARGUMENTS = {
    "name": ("gcd", "Name of this ROS node: its topics, services and TF frames begin with it."),
    "folder": (
        "",
        "Folder of the gcd node's sockets, /run/gcd/NAME of a systemd unit; empty: a node of the same user.",
    ),
    "host": ("", "Host of a gcd node with the customary TCP ports 5580 to 5582; empty: sockets of this machine."),
    "keys": ("", "Folder of this client's key pair, for a node with keys."),
    "node_key": ("", "File of the node's public key."),
    "source_frame": ("", "TF frame of the source camera on this robot; empty: <name>/<kind of source>_optical."),
    "base_frame": ("base_link", "TF frame of the vehicle, in which grids lie."),
    "max_age_ms": ("0", "Views older than this are not published; 0: as long as the node says they are valid."),
    "metres_per_unit": ("0", "Length of a scene unit, for models that know no metres; 0: no TF for their views."),
}


def generate_launch_description() -> LaunchDescription:
    """One bridge; start several with different names for several gcd nodes."""
    given = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    values = {name: given[name] for name in ("max_age_ms", "metres_per_unit")}
    texts = {name: given[name] for name in ("source_frame", "base_frame", "keys", "node_key")}
    folder, host = given["folder"], given["host"]
    for port, channel in enumerate(("data", "status", "control"), 5580):
        here = ["'ipc://", folder, f"/{channel}' if '", folder, "' else 'ipc'"]
        texts[channel] = PythonExpression(["'tcp://", host, f":{port}' if '", host, "' else ", *here])
    values |= {
        name: ParameterValue(text, value_type=str) for name, text in texts.items()
    }  # text, even if it is a number
    bridge = Node(package="gcd_views", executable="gcd_views", name=given["name"], output="screen", parameters=[values])
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, bridge])
