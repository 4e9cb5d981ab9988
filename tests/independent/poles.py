"""Solid rotation over the poles, integrated without the program: how much of its error is the rounding of node velocities to f32.

    python tests/independent/poles.py

The same interpolant (Catmull-Rom in longitude and latitude of Cartesian vectors, projected onto the sphere) and the same Runge-Kutta steps, in
NumPy and in f64 throughout, on the seeds of tests/sphere_levels.rs. Nodes are kept in f64, or rounded to f32 as speeds of several sizes, which
rounds them in as many ways. Prints the largest |log-stretch|, which should be 0.
"""

import numpy as np

RATE = np.pi / 2  # radians in all, about the axis through 0 and 180 degrees east
STEPS = 100


def weights(f, before, after):
    """Weights of four nodes for the value and for its derivative; one-sided slopes where there is no node before or after."""
    g = 1 - f
    value = [(1 + 2 * f) * g * g, f * f * (3 - 2 * f), f * g * g, f * f * (f - 1)]
    slope = [6 * f * (f - 1), 6 * f * g, g * (1 - 3 * f), f * (3 * f - 2)]
    out = []
    for h in (value, slope):
        first = np.where(before, h[2] / 2, h[2])
        last = np.where(after, h[3] / 2, h[3])
        out.append(np.array([np.where(before, -first, 0), h[0] - np.where(before, 0, first) - last,
                             h[1] + first + np.where(after, 0, last), np.where(after, last, 0)]))
    return out


def nodes_of(cell, speed):
    """Cartesian velocities on cells of so many degrees; rounded to f32 in units of 1 / speed, or not at all."""
    latitude, longitude = np.meshgrid(np.radians(np.arange(-90, 90 + cell / 2, cell)), np.radians(np.arange(0, 360, cell)), indexing="ij")
    rounded = (lambda a: a) if speed is None else (lambda a: (a * speed).astype("f4").astype("f8") / speed)
    u, v = rounded(-RATE * np.cos(longitude) * np.sin(latitude)), rounded(RATE * np.sin(longitude))
    nodes = np.stack([-u * np.sin(longitude) - v * np.sin(latitude) * np.cos(longitude),
                      u * np.cos(longitude) - v * np.sin(latitude) * np.sin(longitude), v * np.cos(latitude)], -1)
    nodes[[0, -1]] = nodes[[0, -1]].mean(1, keepdims=True)
    return rounded(nodes)


def tangent(nodes, cell, x, m):
    """Velocity at x, and its derivative along the columns of m."""
    rows, columns = nodes.shape[:2]
    h = np.radians(cell)
    length = np.linalg.norm(x, axis=0)
    p = x / length
    longitude, latitude = np.arctan2(p[1], p[0]) % (2 * np.pi), np.arctan2(p[2], np.hypot(p[0], p[1]))
    place_x, place_y = longitude / h, np.clip((latitude + np.pi / 2) / h, 1e-7, rows - 1 - 1e-7)
    beside = np.minimum(place_y, rows - 1 - place_y)
    circle = np.where(beside < 0.125, np.sin(beside * h), np.hypot(p[0], p[1]))
    ix, iy = np.floor(place_x).astype(int) % columns, np.minimum(place_y.astype(int), rows - 2)
    wx, dx = weights(place_x % 1, True, True)
    wy, dy = weights(place_y - iy, iy > 0, iy < rows - 2)
    v, along_x, along_y = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
    for j in range(4):
        row = np.clip(iy - 1 + j, 0, rows - 1)
        four = [nodes[row, (ix - 1 + i) % columns].T for i in range(4)]
        value = sum(wx[i] * four[i] for i in range(4))
        v += wy[j] * value
        along_x += wy[j] * sum(dx[i] * (four[i] - four[1]) for i in range(4))
        along_y += dy[j] * value
    radial = (p * v).sum(0)
    c, s = np.cos(longitude), np.sin(longitude)
    east, north = np.array([-s, c, 0 * s]), np.array([-p[2] * c, -p[2] * s, np.hypot(p[0], p[1])])
    product = np.zeros_like(m)
    for k in range(2):
        change = (m[:, k] - (p * m[:, k]).sum(0) * p) / length
        between = (east * change).sum(0) / circle / h * along_x + (north * change).sum(0) / h * along_y
        product[:, k] = between - radial * change - ((change * v).sum(0) + (p * between).sum(0)) * p
    return v - radial * p, product


def seeds():
    points = [((i * 137.50776) % 360, np.degrees(np.arcsin(2 * (i + 0.5) / 400 - 1))) for i in range(400)]
    for latitude in [90, 89.99999, 89.999, 89.99, 89.9, 89.7, 89.1, 89.55, 72]:
        for aside in [0, 1e-5, 1e-3, 0.01, 0.1, 3, 80]:
            points += [(90 + aside, latitude), (270 - aside, -latitude)]
    return np.radians(np.array(points).astype("f4").astype("f8")).T


def largest(cell, speed):
    nodes = nodes_of(cell, speed)
    longitude, latitude = seeds()
    (sl, cl), (sp, cp) = (np.sin(longitude), np.cos(longitude)), (np.sin(latitude), np.cos(latitude))
    x = np.array([cp * cl, cp * sl, sp])
    m = np.stack([np.array([-sl, cl, 0 * sl]), np.array([-sp * cl, -sp * sl, cp])], 1)
    h = 1 / STEPS
    for _ in range(STEPS):
        k1, m1 = tangent(nodes, cell, x, m)
        k2, m2 = tangent(nodes, cell, x + h / 2 * k1, m + h / 2 * m1)
        k3, m3 = tangent(nodes, cell, x + h / 2 * k2, m + h / 2 * m2)
        k4, m4 = tangent(nodes, cell, x + h * k3, m + h * m3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        m = m + h / 6 * (m1 + 2 * m2 + 2 * m3 + m4)
        length = np.linalg.norm(x, axis=0)
        x = x / length
        m = (m - (x[:, None] * m).sum(0) * x[:, None]) / length
    return max(abs(np.log(np.linalg.svd(m[:, :, i], compute_uv=False)[0])) for i in range(m.shape[2]))


for cell in [1.0, 0.5, 0.25]:
    rounded = [largest(cell, speed) for speed in [1, 7.37, 1.1, 1.2345, 3.3, 0.77, 1.7, 2.9]]
    print(f"{cell} degrees: nodes in f64 {largest(cell, None):.1e}, rounded to f32 {min(rounded):.1e} to {max(rounded):.1e}")
