"""Smallest eigenvector of a symmetric 3 x 3 matrix in closed form."""

from __future__ import annotations

import math

from artemis_edge._jit import kernel
from artemis_edge.frames import F64


@kernel
def smallest_eigen3(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, out: F64) -> None:
    """``out[0:3]`` unit eigenvector of the smallest eigenvalue, ``out[3:6]`` eigenvalues ascending.

    Trigonometric solution of the characteristic cubic (O. K. Smith, 1961); the vector is the largest cross
    product of two rows of A - lambda I. A multiple of the identity has no preferred direction: (0, 0, 1).
    """
    q = (xx + yy + zz) / 3.0
    a, b, c = xx - q, yy - q, zz - q
    p = math.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    out[0], out[1], out[2] = 0.0, 0.0, 1.0
    out[3] = out[4] = out[5] = q
    if p < 1e-15:
        return
    half_det = 0.5 * (a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)) / (p * p * p)
    angle = math.acos(min(1.0, max(-1.0, half_det))) / 3.0
    out[5] = q + 2.0 * p * math.cos(angle)
    out[3] = q + 2.0 * p * math.cos(angle + 2.0943951023931953)  # + 120 degrees
    out[4] = 3.0 * q - out[3] - out[5]
    a, b, c = xx - out[3], yy - out[3], zz - out[3]
    x0, y0, z0 = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
    x1, y1, z1 = xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz
    x2, y2, z2 = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
    n0 = x0 * x0 + y0 * y0 + z0 * z0
    n1 = x1 * x1 + y1 * y1 + z1 * z1
    n2 = x2 * x2 + y2 * y2 + z2 * z2
    if n1 > n0:
        x0, y0, z0, n0 = x1, y1, z1, n1
    if n2 > n0:
        x0, y0, z0, n0 = x2, y2, z2, n2
    if n0 > 0.0:
        s = 1.0 / math.sqrt(n0)
        out[0], out[1], out[2] = x0 * s, y0 * s, z0 * s
