"""Measures of a map: its geometry, its trajectory."""
