"""ROS 2 message definitions (``ros2msg`` text) of every type that a session may hold.

The interfaces are those of the ROS 2 common_interfaces, geometry2 and livox_ros_driver2 packages, and our own
``artemis_msgs`` for what these have no place for; the texts carry the fields alone. A schema in a file is the
definition followed by those it depends on.
"""

from __future__ import annotations

_DEFINITIONS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
    ),
    "sensor_msgs/PointField": (
        "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\n"
        "uint8 FLOAT32=7\nuint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n"
    ),
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n"
    ),
    "sensor_msgs/PointCloud2": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n"
        "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
    ),
    "sensor_msgs/Imu": (
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\n"
        "float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n"
        "float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n"
        "float64[9] linear_acceleration_covariance\n"
    ),
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data\n",
    "sensor_msgs/Image": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
        "uint32 step\nuint8[] data\n"
    ),
    "sensor_msgs/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\n"
        "float64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\n"
        "sensor_msgs/RegionOfInterest roi\n"
    ),
    "std_msgs/String": "string data\n",
    "artemis_msgs/RawPackets": (
        "std_msgs/Header header\nint64[] receive_ns\nuint32[] id\nuint32[] size\nuint8[] data\n"
    ),
    "artemis_msgs/CameraExposure": "std_msgs/Header header\nfloat64 exposure_s\nfloat64 gain\n",
    "artemis_msgs/Mask": (
        "std_msgs/Header header\nuint8[] slot\nstring[] text\nuint32 height\nuint32 width\nfloat64[4] grid\n"
        "uint8[] score\n"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "nav_msgs/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
        "geometry_msgs/TwistWithCovariance twist\n"
    ),
    "livox_ros_driver2/CustomPoint": (
        "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
    ),
    "livox_ros_driver2/CustomMsg": (
        "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
        "livox_ros_driver2/CustomPoint[] points\n"
    ),
}
_RULE = "=" * 80


def schema_text(ros_type: str) -> str:
    """Full ``ros2msg`` text of a type such as ``sensor_msgs/msg/Imu``, with the types it is made of.

    Raises KeyError for a type that a session cannot hold.
    """
    name = ros_type.replace("/msg/", "/")
    parts = [_DEFINITIONS[name]]
    parts += [f"{_RULE}\nMSG: {other}\n{_DEFINITIONS[other]}" for other in _dependencies(name)]
    return "".join(parts)


def _dependencies(name: str) -> list[str]:
    """Types used by ``name``, directly or not, in the order they first appear."""
    found: list[str] = []
    queue = [name]
    while queue:
        for line in _DEFINITIONS[queue.pop(0)].splitlines():
            other = line.split()[0].partition("[")[0]
            if other in _DEFINITIONS and other not in found:
                found.append(other)
                queue.append(other)
    return found
