"""Drivers of the scanner's devices, and the virtual rig that stands in for them.

Nothing here knows the mapping: this package imports nothing of ``artemis_edge``.
"""
