"""The ROS 2 messages that are read and written here, as `.msg` texts: bags of before ROS 2 Iron hold none."""

from __future__ import annotations

import re

_STAMPED = "std_msgs/Header header\n"
_XYZ = "float64 x\nfloat64 y\nfloat64 z\n"
TYPES = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "sensor_msgs/Image": f"{_STAMPED}uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n"
    "uint8[] data\n",
    "sensor_msgs/CompressedImage": f"{_STAMPED}string format\nuint8[] data\n",
    "sensor_msgs/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count\n",
    "sensor_msgs/PointCloud2": f"{_STAMPED}uint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n"
    "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n",
    "sensor_msgs/RegionOfInterest": "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n",
    "sensor_msgs/CameraInfo": f"{_STAMPED}uint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\n"
    "float64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n",
    "sensor_msgs/NavSatStatus": "int8 status\nuint16 service\n",
    "sensor_msgs/NavSatFix": f"{_STAMPED}sensor_msgs/NavSatStatus status\nfloat64 latitude\nfloat64 longitude\n"
    "float64 altitude\nfloat64[9] position_covariance\nuint8 position_covariance_type\n",
    "geometry_msgs/Point": _XYZ,
    "geometry_msgs/Vector3": _XYZ,
    "geometry_msgs/Quaternion": f"{_XYZ}float64 w\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/PoseStamped": f"{_STAMPED}geometry_msgs/Pose pose\n",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/PoseWithCovarianceStamped": f"{_STAMPED}geometry_msgs/PoseWithCovariance pose\n",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    "geometry_msgs/TransformStamped": f"{_STAMPED}string child_frame_id\ngeometry_msgs/Transform transform\n",
    "nav_msgs/Odometry": f"{_STAMPED}string child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
    "geometry_msgs/TwistWithCovariance twist\n",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
}
"""Bodies by full name; every type that one uses stands before it or here by its full name."""
LIVOX = {
    f"{package}/{name}": text.format(package)
    for package in ("livox_ros_driver2", "livox_interfaces")
    for name, text in (
        (
            "CustomMsg",
            _STAMPED + "uint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n{}/CustomPoint[] points\n",
        ),
        (
            "CustomPoint",
            "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n",
        ),
    )
}
"""Of Livox's drivers, likewise."""
_SEPARATOR = "=" * 80 + "\nMSG: "


def definition(name: str) -> str:
    """The text of a message type and of all that it uses, as `ros2msg` schemas have it; empty where it is not known."""
    first, types = name.replace("/msg/", "/"), TYPES | LIVOX
    if first not in types:
        return ""
    used = [first]
    for one in used:
        used += [other for other in re.findall(r"^(\w+/\w+)", types[one], re.MULTILINE) if other not in used]
    return types[first] + "".join(f"{_SEPARATOR}{other}\n{types[other]}" for other in used[1:])
