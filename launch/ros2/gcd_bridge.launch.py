"""Starts the bridge beside a running node: ros2 launch launch/ros2/gcd_bridge.launch.py name:=topdown

Unproven on a ROS machine, like the bridge. Needs gcd-client.
"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument  # noqa: TID251
from launch.substitutions import LaunchConfiguration  # noqa: TID251
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription  # noqa: TID251  ROS's package, not our folder

ARGUMENTS = {
    "name": ("topdown", "Instance of gcd-node@.service: its sockets are in /run/gcd/<name>."),
    "views": ("topdown", "Ids of the views, separated by commas."),
    "maps": ("", "Kinds to publish beside the pictures, of vis and depth, separated by commas."),
    "source_frame": ("", "TF frame of the source camera on this robot; left out, as the node names it."),
}


def generate_launch_description() -> LaunchDescription:
    """One bridge; pictures of a source camera that TF knows find their place by `source_frame`."""
    name = LaunchConfiguration("name")
    values = {
        "data": ["ipc:///run/gcd/", name, "/data"],
        "status": ["ipc:///run/gcd/", name, "/status"],
        "views": LaunchConfiguration("views"),
        "maps": LaunchConfiguration("maps"),
        "source_frame": LaunchConfiguration("source_frame"),
    }
    bridge = Node(
        executable=str(Path(__file__).with_name("gcd_bridge.py")),
        name="gcd_bridge",
        output="screen",
        # As text, whatever it looks like: else an empty one would become no value, and `1` a number.
        parameters=[{key: ParameterValue(value, value_type=str) for key, value in values.items()}],
    )
    declared = [
        DeclareLaunchArgument(each, default_value=default, description=text)
        for each, (default, text) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, bridge])
