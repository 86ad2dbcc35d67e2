"""Artemis Edge: a textured, semantic triangle mesh from a handheld scanner, at 10 Hz.

The map is built by the method of the paper "ARTEMIS: Active Real-time Textured Environment Meshing
with Interactive Semantics"; ``pipeline.py`` tells it in order, each stage has the file of its name.
"""

__version__ = "0.1.0"
