"""Cameras: hardware-triggered OAK cameras by depthai, folders and videos for the bench, frames in shared memory."""
