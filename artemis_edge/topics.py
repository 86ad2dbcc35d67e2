"""The topics of a session: one table, from which the recorder, the virtual rig and the readers take names."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Topic:
    """``rate_hz`` is the usual rate, 0 for what is written once; ``recorded`` whether sessions hold it."""

    name: str
    ros_type: str
    rate_hz: float
    recorded: bool = True


LIDAR_POINTS = Topic("/lidar/points", "sensor_msgs/msg/PointCloud2", 10.0)
IMU = Topic("/imu", "sensor_msgs/msg/Imu", 200.0)
LIDAR_IMU = Topic("/lidar/imu", "sensor_msgs/msg/Imu", 200.0)
CAMERA_IMAGE = Topic("/camera/image/compressed", "sensor_msgs/msg/CompressedImage", 10.0)
CAMERA_RAW = Topic("/camera/image", "sensor_msgs/msg/Image", 10.0)
CAMERA_EXPOSURE = Topic("/camera/exposure", "artemis_msgs/msg/CameraExposure", 10.0)
CAMERA_INFO = Topic("/camera/camera_info", "sensor_msgs/msg/CameraInfo", 0.0)
TF = Topic("/tf", "tf2_msgs/msg/TFMessage", 10.0)
TF_STATIC = Topic("/tf_static", "tf2_msgs/msg/TFMessage", 0.0)
ODOMETRY = Topic("/odom", "nav_msgs/msg/Odometry", 10.0)
RIG = Topic("/artemis/rig", "std_msgs/msg/String", 0.0)
EVENTS = Topic("/artemis/events", "std_msgs/msg/String", 0.0)
CLOCKS = Topic("/artemis/clocks", "std_msgs/msg/String", 1.0)
HEALTH = Topic("/artemis/health", "std_msgs/msg/String", 1.0)
LOST = Topic("/artemis/lost", "std_msgs/msg/String", 0.0)
QUESTIONS = Topic("/artemis/questions", "std_msgs/msg/String", 0.0)
MASKS = Topic("/artemis/masks", "artemis_msgs/msg/Mask", 5.0)
OVERLOAD = Topic("/artemis/overload", "std_msgs/msg/String", 0.0)
CAMERA_STAMP = Topic("/camera/frame_stamp", "std_msgs/msg/String", 10.0)
LIDAR_PACKETS = Topic("/lidar/packets", "artemis_msgs/msg/RawPackets", 10.0)
IMU_BYTES = Topic("/imu/bytes", "artemis_msgs/msg/RawPackets", 10.0)
CAN_FRAMES = Topic("/can/frames", "artemis_msgs/msg/RawPackets", 10.0)

RAW = LIDAR_PACKETS.ros_type

#: What readers need before anything else: written again at the start of every further file of a session.
LATCHED = frozenset({RIG.name, TF_STATIC.name})

TOPICS = (
    LIDAR_POINTS,
    IMU,
    LIDAR_IMU,
    CAMERA_IMAGE,
    CAMERA_RAW,
    CAMERA_EXPOSURE,
    CAMERA_INFO,
    TF,
    TF_STATIC,
    ODOMETRY,
    RIG,
    EVENTS,
    CLOCKS,
    HEALTH,
    LOST,
    QUESTIONS,
    MASKS,
    OVERLOAD,
    CAMERA_STAMP,
    LIDAR_PACKETS,
    IMU_BYTES,
    CAN_FRAMES,
)
