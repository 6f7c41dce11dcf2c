"""Compiled ray casting of the analytic scene: one file, so that numba's cache notices every change.

A scene is a float64 table, one primitive a row, columns named by the `COL_*` constants; row 0 is
the room that encloses everything. Lengths are metres, the frame is the world of the scene (+Z up),
colours are sRGB in [0, 1], above 1 for what glows, and depend on the view on glossy things only.
Kernels release the GIL, so callers spread work over Python threads and need no threading layer of
numba's.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

ROOM, SPHERE, BOX, CYLINDER, BOWL, TORUS = 0, 1, 2, 3, 4, 5

COL_KIND = 0
COL_CENTER = 1  # three columns
COL_SIZE = 4  # three columns; their meaning depends on the kind, see pipelines.sample.scene
COL_COS_YAW = 7
COL_SIN_YAW = 8
COL_BOUND = 9  # radius of a sphere around the centre that holds the primitive
COL_PATCH = 10  # size of the largest colour patches, metres
COL_SEED = 11
COL_PALETTE = 12  # a bowl paints its inside with the next palette
COL_DETAIL = 13  # strength of the fine paint, 1 as a rule
COL_GLOSS = 14  # share of light that is mirrored when looked at squarely; 0 is matt
COL_GLOW = 15  # brightness of what glows by itself; 0 for what the lamp lights
NUM_COLUMNS = 16

_EPS = 1e-6  # metres: a ray never hits the surface that it starts on
_FAR = 1e30

_Four = tuple[float, float, float, float]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _mix(h: int) -> float:
    """A number in [0, 1] from 32 bits. The factor is below 2^31: products stay inside int64."""
    h = (h ^ (h >> 15)) * 0x2C1B3C6D & 0xFFFFFFFF
    return ((h ^ (h >> 12)) & 0xFFFFFF) * (1.0 / 16777215.0)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _noise(x: float, y: float, z: float, seed: int) -> float:
    """Value noise in [0, 1] with features about one unit wide."""
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    x, y, z = x - fx, y - fy, z - fz
    u, v, w = x * x * (3.0 - 2.0 * x), y * y * (3.0 - 2.0 * y), z * z * (3.0 - 2.0 * z)
    seeded = (seed & 0xFFFF) * 0x1E3779B9
    x0 = (int(fx) & 0xFFFF) * 0x2DA6B343 ^ seeded
    x1 = (int(fx) + 1 & 0xFFFF) * 0x2DA6B343 ^ seeded
    y0 = (int(fy) & 0xFFFF) * 0x58163841
    y1 = (int(fy) + 1 & 0xFFFF) * 0x58163841
    z0 = (int(fz) & 0xFFFF) * 0x4B1AB31F
    z1 = (int(fz) + 1 & 0xFFFF) * 0x4B1AB31F
    mask = 0xFFFFFFFF
    a = _mix((x0 ^ y0 ^ z0) & mask) * (1.0 - u) + _mix((x1 ^ y0 ^ z0) & mask) * u
    b = _mix((x0 ^ y1 ^ z0) & mask) * (1.0 - u) + _mix((x1 ^ y1 ^ z0) & mask) * u
    c = _mix((x0 ^ y0 ^ z1) & mask) * (1.0 - u) + _mix((x1 ^ y0 ^ z1) & mask) * u
    d = _mix((x0 ^ y1 ^ z1) & mask) * (1.0 - u) + _mix((x1 ^ y1 ^ z1) & mask) * u
    return (a * (1.0 - v) + b * v) * (1.0 - w) + (c * (1.0 - v) + d * v) * w


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _smooth_step(low: float, high: float, value: float) -> float:
    t = min(max((value - low) / (high - low), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _albedo(
    x: float, y: float, z: float, patch: float, detail: float, seed: int, palette: Any
) -> tuple[float, float, float]:
    """Colour patches of four paints, then two finer octaves of brightness, times `detail`.

    Each octave's axes are turned, so that no lattice shows on flat walls.
    """
    x, y, z = x / patch, y / patch, z / patch
    a = 0.80 * x + 0.36 * y - 0.48 * z
    b = -0.60 * x + 0.48 * y - 0.64 * z
    c = 0.80 * y + 0.60 * z
    v = _noise(a, b, c, seed) * 0.62 + _noise(2.1 * b, 2.1 * c, 2.1 * a, seed + 11) * 0.38
    t = min(max((v - 0.5) * 2.1 + 0.5, 0.0), 0.9999) * 3.0
    i = int(t)
    f = _smooth_step(0.3, 0.7, t - i)
    fine = _noise(4.3 * (a + b) * 0.7, 4.3 * (a - b) * 0.7, 4.3 * c, seed + 23)
    finest = _noise(9.1 * (b + c) * 0.7, 9.1 * (c - b) * 0.7, 9.1 * a, seed + 37)
    gain = 1.0 + detail * (0.75 * (fine - 0.5) + 0.55 * (finest - 0.5))
    red = (palette[i, 0] * (1.0 - f) + palette[i + 1, 0] * f) * gain
    green = (palette[i, 1] * (1.0 - f) + palette[i + 1, 1] * f) * gain
    blue = (palette[i, 2] * (1.0 - f) + palette[i + 1, 2] * f) * gain
    return red, green, blue


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _hit_room(o: Any, d: Any, row: Any) -> _Four:
    """The inner side of an axis-aligned box, from inside."""
    best, axis = _FAR, 0
    for k in range(3):
        if d[k] != 0.0:
            side = row[COL_SIZE + k] if d[k] > 0.0 else -row[COL_SIZE + k]
            t = (side - o[k]) / d[k]
            if t < best:
                best, axis = t, k
    sign = -1.0 if d[axis] > 0.0 else 1.0
    nx = sign if axis == 0 else 0.0
    ny = sign if axis == 1 else 0.0
    nz = sign if axis == 2 else 0.0
    return best, nx, ny, nz


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _hit_sphere(o: Any, d: Any, row: Any) -> _Four:
    r = row[COL_SIZE]
    b = o[0] * d[0] + o[1] * d[1] + o[2] * d[2]
    disc = b * b - (o[0] * o[0] + o[1] * o[1] + o[2] * o[2] - r * r)
    if disc <= 0.0:
        return _FAR, 0.0, 0.0, 0.0
    t = -b - math.sqrt(disc)
    if t < _EPS:
        return _FAR, 0.0, 0.0, 0.0
    return t, (o[0] + t * d[0]) / r, (o[1] + t * d[1]) / r, (o[2] + t * d[2]) / r


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _hit_box(o: Any, d: Any, row: Any) -> _Four:
    """A solid box from outside, by slabs."""
    near, far, axis = -_FAR, _FAR, 0
    for k in range(3):
        half = row[COL_SIZE + k]
        if d[k] == 0.0:
            if abs(o[k]) > half:
                return _FAR, 0.0, 0.0, 0.0
            continue
        t0, t1 = (-half - o[k]) / d[k], (half - o[k]) / d[k]
        if t0 > t1:
            t0, t1 = t1, t0
        if t0 > near:
            near, axis = t0, k
        far = min(far, t1)
    if near > far or near < _EPS:
        return _FAR, 0.0, 0.0, 0.0
    sign = -1.0 if d[axis] > 0.0 else 1.0
    nx = sign if axis == 0 else 0.0
    ny = sign if axis == 1 else 0.0
    nz = sign if axis == 2 else 0.0
    return near, nx, ny, nz


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _hit_cylinder(o: Any, d: Any, row: Any) -> _Four:
    """A solid upright cylinder from outside: radius, half height."""
    r, half = row[COL_SIZE], row[COL_SIZE + 1]
    best, nx, ny, nz = _FAR, 0.0, 0.0, 0.0
    a = d[0] * d[0] + d[1] * d[1]
    if a > 1e-12:
        b = o[0] * d[0] + o[1] * d[1]
        disc = b * b - a * (o[0] * o[0] + o[1] * o[1] - r * r)
        if disc > 0.0:
            t = (-b - math.sqrt(disc)) / a
            if t > _EPS and abs(o[2] + t * d[2]) <= half:
                best, nx, ny = t, (o[0] + t * d[0]) / r, (o[1] + t * d[1]) / r
    if d[2] != 0.0:
        sign = -1.0 if d[2] > 0.0 else 1.0
        t = (sign * half - o[2]) / d[2]
        x, y = o[0] + t * d[0], o[1] + t * d[1]
        if _EPS < t < best and x * x + y * y <= r * r:
            best, nx, ny, nz = t, 0.0, 0.0, sign
    return best, nx, ny, nz


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _hit_bowl(o: Any, d: Any, row: Any) -> _Four:
    """The lower half of a thick spherical shell, open upwards: outer and inner radius."""
    best, nx, ny, nz = _FAR, 0.0, 0.0, 0.0
    b = o[0] * d[0] + o[1] * d[1] + o[2] * d[2]
    oo = o[0] * o[0] + o[1] * o[1] + o[2] * o[2]
    for side in range(2):
        r = row[COL_SIZE + side]
        disc = b * b - (oo - r * r)
        if disc <= 0.0:
            continue
        # A ray outside the solid enters through the outer sphere's near root or the inner's far.
        t = -b - math.sqrt(disc) if side == 0 else -b + math.sqrt(disc)
        if _EPS < t < best and o[2] + t * d[2] <= 0.0:
            scale = (1.0 if side == 0 else -1.0) / r
            best = t
            nx, ny = (o[0] + t * d[0]) * scale, (o[1] + t * d[1]) * scale
            nz = (o[2] + t * d[2]) * scale
    if d[2] < 0.0:
        t = -o[2] / d[2]
        x, y = o[0] + t * d[0], o[1] + t * d[1]
        rr = x * x + y * y
        if _EPS < t < best and row[COL_SIZE + 1] ** 2 <= rr <= row[COL_SIZE] ** 2:
            best, nx, ny, nz = t, 0.0, 0.0, 1.0
    return best, nx, ny, nz


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _hit_torus(o: Any, d: Any, row: Any) -> _Four:
    """An upright ring around the y axis: radius of the ring and of its tube.

    Marches by the exact distance, then closes in by Newton's steps, which need the slope.
    """
    ring, tube = row[COL_SIZE], row[COL_SIZE + 1]
    b = o[0] * d[0] + o[1] * d[1] + o[2] * d[2]
    disc = b * b - (o[0] * o[0] + o[1] * o[1] + o[2] * o[2] - (ring + tube) ** 2)
    if disc <= 0.0:
        return _FAR, 0.0, 0.0, 0.0
    t, last = max(-b - math.sqrt(disc), _EPS), -b + math.sqrt(disc)
    for _ in range(200):
        x, y, z = o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2]
        rho = math.hypot(x, z)
        across = math.hypot(rho - ring, y)
        gap = across - tube
        out = (rho - ring) / (across * rho)
        nx, ny, nz = x * out, y / across, z * out
        if gap < 1e-11:
            break
        slope = -(nx * d[0] + ny * d[1] + nz * d[2])
        t += gap / slope if gap < 0.02 * tube and slope > 0.05 else gap
        if t > last:
            return _FAR, 0.0, 0.0, 0.0
    if gap > 1e-7 or t <= _EPS:
        return _FAR, 0.0, 0.0, 0.0
    return t, nx, ny, nz


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _hit(o: Any, d: Any, row: Any) -> _Four:
    """First hit of one primitive, normal in its own axes. o, d: in its own axes."""
    kind = int(row[COL_KIND])
    if kind == ROOM:
        return _hit_room(o, d, row)
    if kind == SPHERE:
        return _hit_sphere(o, d, row)
    if kind == BOX:
        return _hit_box(o, d, row)
    if kind == CYLINDER:
        return _hit_cylinder(o, d, row)
    if kind == TORUS:
        return _hit_torus(o, d, row)
    return _hit_bowl(o, d, row)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _to_local(p: Any, d: Any, row: Any, o_out: Any, d_out: Any) -> None:
    x, y = p[0] - row[COL_CENTER], p[1] - row[COL_CENTER + 1]
    c, s = row[COL_COS_YAW], row[COL_SIN_YAW]
    o_out[0], o_out[1], o_out[2] = c * x + s * y, c * y - s * x, p[2] - row[COL_CENTER + 2]
    d_out[0], d_out[1], d_out[2] = c * d[0] + s * d[1], c * d[1] - s * d[0], d[2]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _misses_bound(p: Any, d: Any, row: Any) -> bool:
    x, y, z = row[COL_CENTER] - p[0], row[COL_CENTER + 1] - p[1], row[COL_CENTER + 2] - p[2]
    along = x * d[0] + y * d[1] + z * d[2]
    r2 = row[COL_BOUND] * row[COL_BOUND]
    distance2 = x * x + y * y + z * z
    return bool(distance2 > r2 and (along < 0.0 or distance2 - along * along > r2))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _is_lit(p: Any, light: Any, table: Any, scratch: Any) -> bool:
    o, d, to_light = scratch[0], scratch[1], scratch[2]
    for k in range(3):
        to_light[k] = light[k] - p[k]
    distance = math.sqrt(to_light[0] ** 2 + to_light[1] ** 2 + to_light[2] ** 2)
    for k in range(3):
        to_light[k] /= distance
    for i in range(1, table.shape[0]):
        row = table[i]
        if _misses_bound(p, to_light, row):
            continue
        _to_local(p, to_light, row, o, d)
        if _hit(o, d, row)[0] < distance:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _trace(p: Any, d: Any, table: Any, out: Any, scratch: Any) -> int:
    """Nearest hit: out[0] = t, out[1:4] = normal in the world. Returns the primitive's row."""
    o_local, d_local = scratch[0], scratch[1]
    best = 0
    out[0] = _FAR
    for i in range(table.shape[0]):
        row = table[i]
        if i > 0 and _misses_bound(p, d, row):
            continue
        _to_local(p, d, row, o_local, d_local)
        t, nx, ny, nz = _hit(o_local, d_local, row)
        if t < out[0]:
            c, s = row[COL_COS_YAW], row[COL_SIN_YAW]
            best = i
            out[0], out[1], out[2], out[3] = t, c * nx - s * ny, s * nx + c * ny, nz
    return best


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _paint(p: Any, d: Any, table: Any, palettes: Any, light: Any, out: Any, scratch: Any) -> int:
    """Trace and paint: out[0:4] as `_trace`, out[4:7] = colour without gloss."""
    index = _trace(p, d, table, out, scratch)
    row = table[index]
    at, local, unused = scratch[3], scratch[4], scratch[5]
    for k in range(3):
        # A little off the surface, so that it does not shade itself.
        at[k] = p[k] + out[0] * d[k] + 1e-5 * out[1 + k]
    _to_local(at, d, row, local, unused)
    palette, patch, detail = int(row[COL_PALETTE]), row[COL_PATCH], row[COL_DETAIL]
    if int(row[COL_KIND]) == BOWL:
        r2 = local[0] ** 2 + local[1] ** 2 + local[2] ** 2
        palette += int(r2 < (0.5 * (row[COL_SIZE] + row[COL_SIZE + 1])) ** 2)
    elif int(row[COL_KIND]) == ROOM:
        if out[3] > 0.5:
            # The floor begins nearer than the walls do; far off, it is seen at a grazing angle,
            # where fine paint would only alias.
            patch *= 0.45
            detail = 1.0 - 0.75 * _smooth_step(1.2, 4.0, math.hypot(local[0], local[1]))
        else:
            palette += 1
    red, green, blue = _albedo(
        local[0], local[1], local[2], patch, detail, int(row[COL_SEED]), palettes[palette]
    )
    if row[COL_GLOW] > 0.0:
        out[4], out[5], out[6] = red * row[COL_GLOW], green * row[COL_GLOW], blue * row[COL_GLOW]
        return index
    lx, ly, lz = light[0] - at[0], light[1] - at[1], light[2] - at[2]
    facing = (out[1] * lx + out[2] * ly + out[3] * lz) / math.sqrt(lx * lx + ly * ly + lz * lz)
    brightness = 0.62 + 0.06 * out[3]
    if facing > 0.0 and _is_lit(at, light, table, scratch):
        brightness += 0.38 * facing
    out[4] = min(max(red * brightness, 0.0), 1.0)
    out[5] = min(max(green * brightness, 0.0), 1.0)
    out[6] = min(max(blue * brightness, 0.0), 1.0)
    return index


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _shade(p: Any, d: Any, table: Any, palettes: Any, light: Any, out: Any, scratch: Any) -> int:
    """Trace and paint: out[0:4] as `_trace`, out[4:7] = colour.

    A glossy thing mirrors the scene once, as a matt one would see it, more at grazing angles
    (Schlick, "An inexpensive BRDF model", Computer Graphics Forum 13(3), 1994, eq. 15), and shows
    the lamp as a sharp highlight.
    """
    index = _paint(p, d, table, palettes, light, out, scratch)
    gloss = table[index, COL_GLOSS]
    if gloss <= 0.0:
        return index
    start, way, mirrored = scratch[6, :3], scratch[7, :3], scratch[8]
    facing = -(out[1] * d[0] + out[2] * d[1] + out[3] * d[2])
    distance2 = 0.0
    for k in range(3):
        start[k] = p[k] + out[0] * d[k] + 1e-5 * out[1 + k]
        way[k] = d[k] + 2.0 * facing * out[1 + k]
        distance2 += (light[k] - start[k]) ** 2
    _paint(start, way, table, palettes, light, mirrored, scratch)
    share = gloss + (1.0 - gloss) * (1.0 - facing) ** 5
    toward = 0.0
    for k in range(3):
        toward += way[k] * (light[k] - start[k]) / math.sqrt(distance2)
    highlight = 0.9 * max(toward, 0.0) ** 300 if _is_lit(start, light, table, scratch) else 0.0
    for k in range(3):
        out[4 + k] = (1.0 - share) * out[4 + k] + share * mirrored[4 + k] + highlight
    return index


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def trace_rays(
    origins: Any, directions: Any, table: Any, palettes: Any, light: Any, out: Any, rows: Any
) -> None:
    """Cast rays. origins, directions: [N, 3], unit directions, inside the room.

    Fills out [N, 7] with distance, normal, colour, and rows [N] with the primitive that was hit.
    """
    scratch = np.empty((9, 7))
    for i in range(origins.shape[0]):
        rows[i] = _shade(origins[i], directions[i], table, palettes, light, out[i], scratch)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def render_pinhole(
    pose: Any, lens: Any, table: Any, palettes: Any, light: Any, gain: float, picture: Any
) -> None:
    """Render a picture, uint8 [H, W, 3]. pose: world_from_camera [3, 4]; lens: fl_x, fl_y, cx, cy.

    gain: factor on sRGB values; what comes out above 1 is clipped, as on a sensor.
    Two samples on a pixel's diagonal; where they differ, the two of the other diagonal as well.
    """
    scratch = np.empty((9, 7))
    out = np.empty(7)
    direction = np.empty(3)
    origin = pose[:, 3].copy()
    total = np.empty(3)
    first = np.empty(3)
    for y in range(picture.shape[0]):
        for x in range(picture.shape[1]):
            num_samples, difference = 0, 0.0
            total[:] = 0.0
            for s in range(4):
                if s == 2 and difference < 0.04:
                    break
                dx = 0.25 if s % 2 == 0 else 0.75
                dy = dx if s < 2 else 1.0 - dx
                cx = (x + dx - lens[2]) / lens[0]
                cy = -(y + dy - lens[3]) / lens[1]
                norm = math.sqrt(cx * cx + cy * cy + 1.0)
                for k in range(3):
                    direction[k] = (pose[k, 0] * cx + pose[k, 1] * cy - pose[k, 2]) / norm
                _shade(origin, direction, table, palettes, light, out, scratch)
                for k in range(3):
                    if s == 0:
                        first[k] = out[4 + k]
                    elif s == 1:
                        difference = max(difference, abs(out[4 + k] - first[k]))
                    total[k] += out[4 + k]
                num_samples += 1
            for k in range(3):
                value = min(gain * total[k] / num_samples, 1.0)
                picture[y, x, k] = np.uint8(value * 255.0 + 0.5)
