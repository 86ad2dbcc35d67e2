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
)
