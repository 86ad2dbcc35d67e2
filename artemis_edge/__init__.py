"""Artemis Edge: a textured, semantic triangle mesh from a handheld scanner, at 10 Hz.

The map is built by the method of the paper "ARTEMIS: Active Real-time Textured Environment Meshing
with Interactive Semantics"; ``pipeline.py`` tells it in order, each stage has the file of its name.
"""

import os

# Our matrices are small or a few columns wide: a second thread of OpenBLAS only waits for work, at full load, for
# 20 ms after each product (measured: 52 instead of 27 ms CPU a frame of 120,000 points). Read when numpy is loaded
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# onnxruntime would keep events and an identifier of the machine in the home folder, to be sent to its maker.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

__version__ = "0.1.0"
