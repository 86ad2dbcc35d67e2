"""Refines where camera and IMU sit on the LiDAR and how late their clocks are, from a recording alone."""
