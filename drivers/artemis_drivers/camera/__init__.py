"""Cameras of the rig."""
