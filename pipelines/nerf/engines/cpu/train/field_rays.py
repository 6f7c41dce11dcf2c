"""The way back from what the field sees of a ray to its origin and direction, one at a time.

Symbols: x = o + t d in scene space, u in the unit cube, Y the 16 spherical harmonics of d. The
gradients of the definitions in `contraction` and `harmonics.spherical_harmonics`, worked out.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from pipelines.nerf.engines.cpu.parts.intervals import (
    HALF,
    LINF,
    NONE,
    ONE,
    TWO,
    ZERO,
    contracted_size,
    contracting_factor,
)
from pipelines.nerf.engines.cpu.parts.runtime import merged


@merged
def harmonics_backward(direction, g, out):
    """out += gradient through `field.direction_harmonics`; g: [16], of the harmonics."""
    x, y, z = direction[0], direction[1], direction[2]
    one, two = np.float32(0.4886025119029199), np.float32(1.0925484305920792)
    three, four = np.float32(0.5900435899266435), np.float32(2.890611442640554)
    five, six = np.float32(0.4570457994644658), np.float32(1.445305721320277)
    zonal_2, zonal_3 = np.float32(6.0 * 0.31539156525252005), np.float32(0.3731763325901154)
    cross = np.float32(6.0) * x * y
    difference = np.float32(3.0) * (x * x - y * y)
    ring = np.float32(5.0) * z * z - ONE
    slope = np.float32(10.0) * z
    out[0] += two * (y * g[4] - z * g[7] + x * g[8]) - one * g[3] + four * y * z * g[10]
    out[0] += TWO * six * x * z * g[14] - three * (cross * g[9] + difference * g[15])
    out[0] -= five * ring * g[13]
    out[1] += two * (x * g[4] - z * g[5] - y * g[8]) - one * g[1] + four * x * z * g[10]
    out[1] += three * (cross * g[15] - difference * g[9]) - TWO * six * y * z * g[14]
    out[1] -= five * ring * g[11]
    out[2] += one * g[2] - two * (y * g[5] + x * g[7]) + zonal_2 * z * g[6] + four * x * y * g[10]
    out[2] += zonal_3 * (np.float32(15.0) * z * z - np.float32(3.0)) * g[12]
    out[2] += six * (x * x - y * y) * g[14] - five * slope * (y * g[11] + x * g[13])


@merged
def place_backward(origin, direction, t, contraction, g, grad_origin, grad_direction):
    """Add what flows back through `intervals.place_ray`; g: [3], gradient of the unit point.

    u = f x + 1/2 with f = (2 - 1/s) / (4 s) for a size s > 1 of the scene point x.
    """
    x = origin[0] + direction[0] * t
    y = origin[1] + direction[1] * t
    z = origin[2] + direction[2] * t
    factor, along_x, along_y, along_z = HALF, ZERO, ZERO, ZERO
    if contraction != NONE:
        size = contracted_size(x, y, z, contraction)
        factor, inverse = contracting_factor(size)
        if size > ONE:
            slope = -HALF * (ONE - inverse) * inverse * inverse
            slope *= g[0] * x + g[1] * y + g[2] * z
            if contraction == LINF:
                # The gradient of a maximum is dealt out evenly among all that reach it.
                at_x, at_y, at_z = abs(x) == size, abs(y) == size, abs(z) == size
                slope /= np.float32(int(at_x) + int(at_y) + int(at_z))
                along_x = (slope if x > ZERO else -slope) if at_x else ZERO
                along_y = (slope if y > ZERO else -slope) if at_y else ZERO
                along_z = (slope if z > ZERO else -slope) if at_z else ZERO
            else:
                along_x, along_y, along_z = slope * x / size, slope * y / size, slope * z / size
    along_x += factor * g[0]
    along_y += factor * g[1]
    along_z += factor * g[2]
    grad_origin[0] += along_x
    grad_origin[1] += along_y
    grad_origin[2] += along_z
    grad_direction[0] += t * along_x
    grad_direction[1] += t * along_y
    grad_direction[2] += t * along_z
