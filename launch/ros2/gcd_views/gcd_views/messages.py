"""ROS 2 messages of what a gcd node sends: pure functions that need the message packages of ROS, but no rclpy.

Arrays are of type `array`, which rclpy takes as a whole; lists it would check number by number.
"""

import json
import math
from array import array
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, Pose, Quaternion, Transform, TransformStamped, Vector3
from grid_map_msgs.msg import GridMap, GridMapInfo
from lifecycle_msgs.msg import State, Transition, TransitionDescription
from nav_msgs.msg import MapMetaData, OccupancyGrid
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Float32MultiArray, Header, MultiArrayDimension, MultiArrayLayout, String

from gcd_client import GridHeader, GridMessage, StatusMessage, ViewHeader, ViewMessage
from gcd_client.images import UNKNOWN, decode_jpegs, depth_m, images, layers

OK, WARN, ERROR, STALE = (bytes([level]) for level in range(4))  # levels of a DiagnosticStatus: one byte each


# --- views -------------------------------------------------------------------------------------------------------


def newest_at_goal(header: ViewHeader) -> int | None:
    """Number of the newest frame whose camera has arrived at its goal; None: all are on their way."""
    return max((i for i, role in enumerate(header.frame_role) if role == "at_goal"), default=None)


def to_time(stamp_ns: int) -> Time:
    """Nanoseconds since the epoch."""
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return Time(sec=seconds, nanosec=nanoseconds)


def to_header(header: ViewHeader | GridHeader, index: int, frame_id: str) -> Header:
    """The stamp of a frame: when its input was captured, not when it was published."""
    stamps_ns = header.t_capture_ns
    return Header(stamp=to_time(stamps_ns[min(index, len(stamps_ns) - 1)]), frame_id=frame_id)


def to_compressed_image(message: ViewMessage, index: int, frame_id: str) -> CompressedImage:
    """One frame of a JPEG view, as the node encoded it."""
    offsets = message.header.offsets
    if offsets is None:
        raise ValueError(f"{message.topic} is {message.header.encoding}, not jpeg")
    coded = bytes(message.payload[offsets[index] : offsets[index + 1]])
    return CompressedImage(header=to_header(message.header, index, frame_id), format="jpeg", data=array("B", coded))


def to_image(message: ViewMessage, index: int, frame_id: str) -> Image:
    """One frame: a picture as rgb8; classes and visibility as mono8; depth as 32FC1, metres, NaN where unknown
    (REP 118). Raises MessageError: damaged; SetupError: a JPEG needs cv2, which is not installed."""
    header = message.header
    height, width = header.shape[1:3]
    if header.encoding == "invdepth16":
        encoding, pixels = "32FC1", depth_m(message)[index]
    elif header.offsets is not None:  # this frame alone
        encoding, pixels = (
            "rgb8",
            decode_jpegs(message.payload, header.offsets[index : index + 2], (1, *header.shape[1:])),
        )
    else:
        encoding, pixels = "rgb8" if header.shape[3] == 3 else "mono8", images(message)[index]
    return Image(
        header=to_header(header, index, frame_id),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=pixels.nbytes // height,
        data=array("B", pixels.tobytes()),
    )


def to_camera_info(header: ViewHeader, index: int, frame_id: str) -> CameraInfo:
    """The pinhole camera of a view; every matrix is zero if its field of view is unknown."""
    k = header.intrinsics or (0.0,) * 9
    rotation = np.eye(3) if header.intrinsics is not None else np.zeros((3, 3))
    return CameraInfo(
        header=to_header(header, index, frame_id),
        height=header.shape[1],
        width=header.shape[2],
        distortion_model="plumb_bob",
        d=array("d", [0.0] * 5),
        k=np.array(k, np.float64),
        r=rotation.reshape(-1),
        p=np.array([*k[0:3], 0.0, *k[3:6], 0.0, *k[6:9], 0.0], np.float64),
    )


def to_class_names(header: ViewHeader | GridHeader) -> String:
    """What the numbers of a class map mean: a JSON list of objects with id, name and colour (red, green, blue)."""
    classes = header.classes or ()
    return String(data=json.dumps([{"id": each.id, "name": each.name, "colour": each.colour} for each in classes]))


def to_transform(
    header: ViewHeader, index: int, source_frame: str, frame_id: str, metres_per_unit: float
) -> TransformStamped | None:
    """Where the virtual camera stands in the frame of the source camera; None: unknown in metres.

    metres_per_unit: length of a scene unit, for models that know no metres; 0: unknown.
    """
    metres = 1.0 if header.pose_units == "m" else metres_per_unit
    if header.source_from_view is None or metres <= 0:
        return None
    source_from_view = np.array(header.source_from_view[index], np.float64).reshape(4, 4)
    x, y, z = (metres * source_from_view[:3, 3]).tolist()
    return TransformStamped(
        header=to_header(header, index, source_frame),
        child_frame_id=frame_id,
        transform=Transform(translation=Vector3(x=x, y=y, z=z), rotation=to_quaternion(source_from_view[:3, :3])),
    )


def to_quaternion(rotation: NDArray[np.float64]) -> Quaternion:
    """A rotation matrix [3, 3] as a quaternion with w >= 0: the eigenvector of Bar-Itzhack 2000, for any angle."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    symmetric = np.array(
        [
            [a - e - i, d + b, g + c, h - f],
            [d + b, e - a - i, h + f, c - g],
            [g + c, h + f, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    q = np.linalg.eigh(symmetric)[1][:, -1]
    x, y, z, w = (math.copysign(1.0, q[3]) * q).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


# --- grids -------------------------------------------------------------------------------------------------------


def to_occupancy_grid(message: GridMessage, frame_id: str) -> OccupancyGrid:
    """0 free, 100 occupied, -1 unknown. Raises MessageError: its cells contradict themselves."""
    header = to_header(message.header, 0, frame_id)
    (height, width), (x, y) = message.header.shape, message.header.origin_m
    info = MapMetaData(
        map_load_time=header.stamp,
        resolution=message.header.cell_m,
        width=width,
        height=height,
        origin=Pose(position=Point(x=x, y=y), orientation=Quaternion(w=1.0)),
    )
    return OccupancyGrid(header=header, info=info, data=array("b", layers(message).occupancy.tobytes()))


def to_grid_map(message: GridMessage, frame_id: str) -> GridMap:
    """All layers, NaN where nothing was seen; `age` in seconds. Raises as to_occupancy_grid().

    A grid map begins with the largest x and y, and counts columns, which go right, slower than rows.
    """
    header, cells = message.header, layers(message)
    (height, width), (x, y) = header.shape, header.origin_m
    length_x, length_y = width * header.cell_m, height * header.cell_m
    seen, known = cells.visibility > 0, cells.occupancy != UNKNOWN
    planes = {
        "occupancy": np.where(known, cells.occupancy / 100, np.nan),
        "elevation": np.where(seen, cells.height_m, np.nan),
        "class": np.where(seen, cells.classes, np.nan),
        "visibility": cells.visibility,
        "age": np.where(seen, cells.age_ms / 1000, np.nan),
    }
    sides = (("column_index", height, height * width), ("row_index", width, width))
    layout = MultiArrayLayout(
        dim=[MultiArrayDimension(label=label, size=size, stride=stride) for label, size, stride in sides]
    )
    centre = Point(x=x + length_x / 2, y=y + length_y / 2)
    return GridMap(
        header=to_header(header, 0, frame_id),
        info=GridMapInfo(
            resolution=header.cell_m,
            length_x=length_x,
            length_y=length_y,
            pose=Pose(position=centre, orientation=Quaternion(w=1.0)),
        ),
        layers=list(planes),
        basic_layers=["elevation"],
        data=[
            Float32MultiArray(layout=layout, data=array("f", plane[::-1, ::-1].astype(np.float32).tobytes()))
            for plane in planes.values()
        ],
    )


# --- diagnostics -------------------------------------------------------------------------------------------------


def to_diagnostic(
    name: str, level: bytes, text: str, values: Mapping[str, Any], hardware_id: str = ""
) -> DiagnosticStatus:
    """values: may nest, `source.fps` is then the key of what lies within `source`."""
    pairs = [KeyValue(key=key, value=value) for key, value in _flat(values, "")]
    return DiagnosticStatus(level=level, name=name, message=text, hardware_id=hardware_id, values=pairs)


def to_node_diagnostic(name: str, status: StatusMessage | None, *, silent: bool) -> DiagnosticStatus:
    """The node's own words; STALE if it is silent. status: the last one; None: there was none yet."""
    if status is None:
        return to_diagnostic(name, STALE, "no node", {})
    fields = status.fields
    level, reasons = fields.get("level"), fields.get("reasons")
    said = ", ".join(map(str, reasons)) if isinstance(reasons, list) and reasons else str(fields.get("state", ""))
    known = bytes([level]) if type(level) is int and 0 <= level <= 3 else WARN
    hardware_id = status.header.node_id
    return to_diagnostic(name, STALE if silent else known, "silent" if silent else said, fields, hardware_id)


def _flat(fields: Mapping[str, Any], place: str) -> Iterator[tuple[str, str]]:
    for key, value in fields.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{place}{key}.")
        else:
            yield f"{place}{key}", ", ".join(map(str, value)) if isinstance(value, list) else str(value)


# --- lifecycle ---------------------------------------------------------------------------------------------------

STATES = {
    "unknown": 0, "unconfigured": 1, "inactive": 2, "active": 3, "finalized": 4, "configuring": 10, "cleaningup": 11,
    "shuttingdown": 12, "activating": 13, "deactivating": 14, "errorprocessing": 15,
}  # fmt: skip
"""Of lifecycle_msgs/State; the node has the same labels."""
SETTLED = ("unconfigured", "inactive", "active", "finalized")
TRANSITIONS = {
    1: ("configure", "unconfigured", "inactive"),
    2: ("cleanup", "inactive", "unconfigured"),
    3: ("activate", "inactive", "active"),
    4: ("deactivate", "active", "inactive"),
    5: ("shutdown", "unconfigured", "finalized"),
    6: ("shutdown", "inactive", "finalized"),
    7: ("shutdown", "active", "finalized"),
}
"""Of lifecycle_msgs/Transition, by id: the node's verb, where it begins and where it leads."""


def to_state(label: str) -> State:
    """A state by the label the node gives it."""
    return State(id=STATES.get(label, 0), label=label if label in STATES else "unknown")


def available_transitions(state: str) -> list[TransitionDescription]:
    """Those that may begin in a state."""
    return [
        TransitionDescription(
            transition=Transition(id=number, label=verb), start_state=to_state(start), goal_state=to_state(goal)
        )
        for number, (verb, start, goal) in TRANSITIONS.items()
        if start == state
    ]


def to_verb(transition: Transition) -> tuple[str, str] | None:
    """The node's verb of a transition, named by its label or else its id, and the state it leads to; None: no such."""
    for number, (verb, _, goal) in TRANSITIONS.items():
        if transition.label == verb or (not transition.label and transition.id == number):
            return verb, goal
    return None
