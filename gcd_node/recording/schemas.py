"""What messages of each type hold: the definitions that go into a recording with them."""

from dataclasses import dataclass
from typing import Literal

_BAR = "=" * 80
_HEADER = f"""
{_BAR}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_BAR}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Schema:
    """A message type. encoding: of the definition, `text`; data: encoding of messages of this type."""

    name: str
    encoding: Literal["ros2msg", "jsonschema"]
    text: str

    @property
    def data(self) -> Literal["cdr", "json"]:
        """How messages of it are written."""
        return "cdr" if self.encoding == "ros2msg" else "json"


def _ros(name: str, text: str) -> Schema:
    return Schema(name=name, encoding="ros2msg", text=text)


STRING = _ros("std_msgs/msg/String", "string data\n")
FLOAT64 = _ros("std_msgs/msg/Float64", "float64 data\n")
COMPRESSED_IMAGE = _ros(
    "sensor_msgs/msg/CompressedImage", "std_msgs/Header header\nstring format\nuint8[] data\n" + _HEADER
)
IMAGE = _ros(
    "sensor_msgs/msg/Image",
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n"
    "uint8[] data\n" + _HEADER,
)
CAMERA_INFO = _ros(
    "sensor_msgs/msg/CameraInfo",
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
    "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n"
    + _HEADER
    + f"{_BAR}\nMSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\n"
    "bool do_rectify\n",
)
DIAGNOSTIC_ARRAY = _ros(
    "diagnostic_msgs/msg/DiagnosticArray",
    "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n"
    + _HEADER
    + f"{_BAR}\nMSG: diagnostic_msgs/DiagnosticStatus\nbyte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\nbyte level\n"
    f"string name\nstring message\nstring hardware_id\ndiagnostic_msgs/KeyValue[] values\n"
    f"{_BAR}\nMSG: diagnostic_msgs/KeyValue\nstring key\nstring value\n",
)
TF_MESSAGE = _ros(
    "tf2_msgs/msg/TFMessage",
    f"geometry_msgs/TransformStamped[] transforms\n{_BAR}\nMSG: geometry_msgs/TransformStamped\n"
    "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
    + _HEADER
    + f"{_BAR}\nMSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
    f"{_BAR}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
    f"{_BAR}\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
)
