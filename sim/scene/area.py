"""Compiled loops that draw by area: means of cells and convex polygons over the squares of a grid.

Import it where it is used, not at the top of a module: the compiler's library takes a while to load.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sim.spectrum import FloatArray


@njit(cache=True)
def _share(distance, slope_x, slope_y):  # type: ignore[no-untyped-def]
    """`sim.scene.render.half_plane` of one square."""
    a, b = abs(slope_x), abs(slope_y)
    far = 0.5 * (a + b)
    if distance >= far:
        return 1.0
    if distance <= -far:
        return 0.0
    wide = max(a, b)
    narrow = max(min(a, b), 1e-9 * wide)
    d = abs(distance)
    ramp = min(far - d, narrow)
    beyond = (0.5 * ramp * ramp / narrow if ramp < narrow else 0.5 * wide - d) / wide
    return 1.0 - beyond if distance > 0 else beyond


@njit(cache=True)
def _value(pattern, row, col, surround):  # type: ignore[no-untyped-def]
    if row < 0 or col < 0 or row >= pattern.shape[0] or col >= pattern.shape[1]:
        return surround
    return pattern[row, col]


@njit(cache=True, inline="always")
def _mean_whole(pattern, u, v, u_across, u_down, v_across, v_down, surround):  # type: ignore[no-untyped-def]
    """Mean over a square at (u, v) no larger than a cell, whose sides run along (u_across, v_across),
    (u_down, v_down).
    """
    u_border, v_border = np.rint(u), np.rint(v)
    col, row = int(u_border), int(v_border)
    right = _share(u - u_border, u_across, u_down)
    below = _share(v - v_border, v_across, v_down)
    if abs(right - 0.5) == 0.5:
        col += int(right) - 1
        if abs(below - 0.5) == 0.5:
            return _value(pattern, row + int(below) - 1, col, surround)
        above = _value(pattern, row - 1, col, surround)
        return above + (_value(pattern, row, col, surround) - above) * below
    above = _value(pattern, row - 1, col - 1, surround)
    above += (_value(pattern, row - 1, col, surround) - above) * right
    under = _value(pattern, row, col - 1, surround)
    under += (_value(pattern, row, col, surround) - under) * right
    return above + (under - above) * below


@njit(cache=True)
def _mean_parts(pattern, u, v, u_across, u_down, v_across, v_down, lit, surround):  # type: ignore[no-untyped-def]
    """The same for cells that have their value from u0 to u1, v0 to v1 only (`lit`), and `surround` elsewhere."""
    wide, high = 0.5 * (abs(u_across) + abs(u_down)), 0.5 * (abs(v_across) + abs(v_down))
    total = surround
    first, last = int(np.floor(u - wide)), int(np.floor(u + wide))
    for row in range(max(0, int(np.floor(v - high))), min(pattern.shape[0] - 1, int(np.floor(v + high))) + 1):
        down = _share(v - row - lit[2], v_across, v_down) - _share(v - row - lit[3], v_across, v_down)
        if down <= 0.0:
            continue
        for col in range(max(0, first), min(pattern.shape[1] - 1, last) + 1):
            across = _share(u - col - lit[0], u_across, u_down) - _share(u - col - lit[1], u_across, u_down)
            total += (pattern[row, col] - surround) * down * across
    return total


@njit(cache=True, inline="always")
def _mean(pattern, u, v, u_across, u_down, v_across, v_down, lit, surround):  # type: ignore[no-untyped-def]
    if lit is None:
        return _mean_whole(pattern, u, v, u_across, u_down, v_across, v_down, surround)
    return _mean_parts(pattern, u, v, u_across, u_down, v_across, v_down, lit, surround)


@njit(cache=True, nogil=True)
def project_means(pattern, back, row, col, step, divide, lit, surround, out):  # type: ignore[no-untyped-def]
    """Means of a pattern's cells over the squares at `row` x `col` (px, `step` wide), into `out`.

    `back` (3, 3) takes (x = col, y = row, 1) to the pattern's (u, v, w). Every square is divided `divide` times each
    way. `lit` (u0, u1, v0, v1) is the part of every cell that holds its value, None for all of it.
    """
    fine = step / divide
    count = divide * divide
    for i in range(row.size):
        for j in range(col.size):
            total = 0.0
            for m in range(divide):
                y = row[i] + (m + 0.5) * fine - 0.5 * step
                for n in range(divide):
                    x = col[j] + (n + 0.5) * fine - 0.5 * step
                    w = 1.0 / (back[2, 0] * x + back[2, 1] * y + back[2, 2])
                    u = (back[0, 0] * x + back[0, 1] * y + back[0, 2]) * w
                    v = (back[1, 0] * x + back[1, 1] * y + back[1, 2]) * w
                    scale = fine * w
                    total += _mean(
                        pattern,
                        u,
                        v,
                        (back[0, 0] - u * back[2, 0]) * scale,
                        (back[0, 1] - u * back[2, 1]) * scale,
                        (back[1, 0] - v * back[2, 0]) * scale,
                        (back[1, 1] - v * back[2, 1]) * scale,
                        lit,
                        surround,
                    )
            out[i, j] = total / count


@njit(cache=True, nogil=True)
def average_mapped(pattern, u, v, divide, lit, surround, out):  # type: ignore[no-untyped-def]
    """As `project_means`, for squares at given pattern points `u`, `v`, a frame of one square wider than needed all
    round; (rows x divide + 2, cols x divide + 2) for `out` of (rows, cols).
    """
    count = divide * divide
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            total = 0.0
            for m in range(i * divide + 1, (i + 1) * divide + 1):
                for n in range(j * divide + 1, (j + 1) * divide + 1):
                    total += _mean(
                        pattern,
                        u[m, n],
                        v[m, n],
                        0.5 * (u[m, n + 1] - u[m, n - 1]),
                        0.5 * (u[m + 1, n] - u[m - 1, n]),
                        0.5 * (v[m, n + 1] - v[m, n - 1]),
                        0.5 * (v[m + 1, n] - v[m - 1, n]),
                        lit,
                        surround,
                    )
            out[i, j] = total / count


@njit(cache=True, inline="always")
def _limit_index(place, limit):  # type: ignore[no-untyped-def]
    """Clip to 0..limit; NaN becomes 0, as it must not be used as an index."""
    return min(place, limit) if place > 0.0 else 0.0


@njit(cache=True, inline="always")
def _integral(table, v, u):  # type: ignore[no-untyped-def]
    """Integral of the pattern from its corner to (u, v) within it, from its summed-area table."""
    i, j = min(int(v), table.shape[0] - 2), min(int(u), table.shape[1] - 2)
    down, across = v - i, u - j
    upper = table[i, j] * (1.0 - across) + table[i, j + 1] * across
    lower = table[i + 1, j] * (1.0 - across) + table[i + 1, j + 1] * across
    return upper * (1.0 - down) + lower * down


@njit(cache=True, nogil=True)
def aligned_means(table, u, v, wide, high):  # type: ignore[no-untyped-def]
    """Means over rectangles of `wide` x `high` cells about pattern points `u`, `v`; 0 outside the pattern.

    `table` (rows + 1, cols + 1) is the pattern's summed-area table. A rectangle may hold any number of cells.
    """
    rows, cols = table.shape[0] - 1.0, table.shape[1] - 1.0
    out = np.empty(u.shape)
    for i in range(u.shape[0]):
        for j in range(u.shape[1]):
            left, right = _limit_index(u[i, j] - 0.5 * wide, cols), _limit_index(u[i, j] + 0.5 * wide, cols)
            top, bottom = _limit_index(v[i, j] - 0.5 * high, rows), _limit_index(v[i, j] + 0.5 * high, rows)
            total = _integral(table, bottom, right) - _integral(table, bottom, left)
            out[i, j] = (total - _integral(table, top, right) + _integral(table, top, left)) / (wide * high)
    return out


@njit(cache=True, nogil=True)
def means_down(values, edges, begin, end, surround):  # type: ignore[no-untyped-def]
    """Means down the rows between neighbouring `edges` (ascending) of what is values[j] from j + begin to j + end and
    `surround` elsewhere, column by column: (edges - 1, columns).
    """
    count, width = values.shape
    out = np.empty((edges.size - 1, width))
    for i in range(edges.size - 1):
        low, high = edges[i], edges[i + 1]
        share = 1.0 / (high - low)
        first, last = max(0, int(np.floor(low))), min(count - 1, int(np.floor(high)))
        left = 1.0
        for j in range(first, last + 1):
            left -= max(0.0, min(high, j + end) - max(low, j + begin)) * share
        out[i, :] = max(0.0, left) * surround
        for j in range(first, last + 1):
            weight = max(0.0, min(high, j + end) - max(low, j + begin)) * share
            if weight > 0.0:
                for k in range(width):
                    out[i, k] += weight * values[j, k]
    return out


@njit(cache=True)
def draw_tapered_rings(down, across, down2, across2, start, end, out):  # type: ignore[no-untyped-def]
    """1/2 + 1/2 Re(down across) from complex factors by row and column, tapering to 1/2 between the distances `start`
    and `end`; `down2`, `across2` are squared distances of rows and columns from the centre."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            distance2 = down2[i] + across2[j]
            if distance2 >= end * end:
                out[i, j] = 0.5
                continue
            level = down[i].real * across[j].real - down[i].imag * across[j].imag
            if distance2 > start * start:
                level *= 0.5 + 0.5 * np.cos(np.pi * (np.sqrt(distance2) - start) / (end - start))
            out[i, j] = 0.5 + 0.5 * level


@njit(cache=True)
def _clip(points, count, axis, limit, sign, kept):  # type: ignore[no-untyped-def]
    """The part of a convex polygon (its first `count` points) where sign x (coordinate - limit) > 0, written to
    `kept`; returns its number of points (Sutherland and Hodgman 1974)."""
    n = 0
    for k in range(count):
        p, q = k - 1 if k else count - 1, k
        gp, gq = sign * (points[p, axis] - limit), sign * (points[q, axis] - limit)
        if (gp > 0.0) != (gq > 0.0):
            t = gp / (gp - gq)
            kept[n, 1 - axis] = points[p, 1 - axis] + (points[q, 1 - axis] - points[p, 1 - axis]) * t
            kept[n, axis] = limit
            n += 1
        if gq > 0.0:
            kept[n] = points[q]
            n += 1
    return n


@njit(cache=True)
def _area(points, count):  # type: ignore[no-untyped-def]
    total = 0.0
    for k in range(1, count - 1):
        total += (points[k, 0] - points[0, 0]) * (points[k + 1, 1] - points[0, 1])
        total -= (points[k + 1, 0] - points[0, 0]) * (points[k, 1] - points[0, 1])
    return 0.5 * abs(total)


@njit(cache=True)
def add_polygon(corners, row0, col0, step, factor, out):  # type: ignore[no-untyped-def]
    """Add factor x (share of every square inside a convex polygon of `corners` [row, col]), exactly, to `out`.

    Square [i, j] is `step` wide with its centre at (row0 + i step, col0 + j step). A row of squares cuts a strip out
    of the polygon. The left border is a convex function of the row and the right one a concave one, so that squares
    between both borders' positions at the strip's two ends lie completely inside; only the few others are clipped one
    by one.
    """
    most = corners.shape[0] + 8
    strip, other, cut = np.empty((most, 2)), np.empty((most, 2)), np.empty((most, 2))
    points = np.empty((most, 2))
    # In units of squares, square [i, j] from i to i + 1 and j to j + 1.
    for k in range(corners.shape[0]):
        points[k, 0] = (corners[k, 0] - row0) / step + 0.5
        points[k, 1] = (corners[k, 1] - col0) / step + 0.5
    top, bottom = points[: corners.shape[0], 0].min(), points[: corners.shape[0], 0].max()
    for i in range(max(0, int(np.floor(top))), min(out.shape[0], int(np.ceil(bottom)))):
        n = _clip(points, corners.shape[0], 0, float(i), 1.0, other)
        n = _clip(other, n, 0, float(i + 1), -1.0, strip)
        if n < 3:
            continue
        left, right = strip[:n, 1].min(), strip[:n, 1].max()
        inner_left, inner_right = np.inf, -np.inf
        if top <= i and bottom >= i + 1:
            ends = np.array([[np.inf, -np.inf], [np.inf, -np.inf]])
            for k in range(n):
                for e in range(2):
                    if strip[k, 0] == i + e:
                        ends[e, 0] = min(ends[e, 0], strip[k, 1])
                        ends[e, 1] = max(ends[e, 1], strip[k, 1])
            if ends.max() < np.inf and ends.min() > -np.inf:
                inner_left, inner_right = max(ends[0, 0], ends[1, 0]), min(ends[0, 1], ends[1, 1])
        for j in range(max(0, int(np.floor(left))), min(out.shape[1], int(np.ceil(right)))):
            if j >= inner_left and j + 1 <= inner_right:
                out[i, j] += factor
            else:
                m = _clip(strip, n, 1, float(j), 1.0, other)
                m = _clip(other, m, 1, float(j + 1), -1.0, cut)
                if m >= 3:
                    out[i, j] += factor * _area(cut, m)


def polygon_share(corners: FloatArray, row0: float, col0: float, step: float, shape: tuple[int, int]) -> FloatArray:
    """Share of every square inside one convex polygon; see `add_polygon`."""
    out = np.zeros(shape)
    add_polygon(np.ascontiguousarray(corners, float), row0, col0, step, 1.0, out)
    return out
