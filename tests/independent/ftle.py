"""Log-stretch of the flow map by other tools than ridgewatch's: netCDF4 reads, SciPy integrates (DOP853), neighbours 2 gap apart are
differenced. The interpolation is written here, straight from what the files hold.

Standard input: {"kind": a key of KINDS, "files": [...], "points": [[x, y, z], ...], "count": how many are wanted, "from": seconds, "tau": seconds
(signed), "interpolation": "linear" | "cubic", "heights": those to which columns are interpolated}. Coordinates in metres, on the sphere longitude and
latitude in degrees; heights above the sea (of a pressure p: -7000 ln(p / 1000 hPa)). Standard output: log-stretches of the points, up to the one by
which as many as wanted are known; where one of a point's neighbours met missing values, "neighbour", and "seed" where the point itself did."""

import json
import sys

import netCDF4
import numpy as np
import pyproj
from scipy.integrate import solve_ivp

EPOCH = "seconds since 1970-01-01"
EARTH_RADIUS = 6_371_008.8


def seconds(variable, calendar="standard"):
    dates = netCDF4.num2date(variable[:], variable.units, getattr(variable, "calendar", calendar))
    return np.array([netCDF4.date2num(d, EPOCH, d.calendar) for d in dates], dtype=float)


def filled(array):
    return np.ma.filled(np.ma.asarray(array, dtype=float), np.nan)


def cell(axis, x):
    """Index and fraction along ascending nodes; None outside."""
    if not axis[0] <= x <= axis[-1]:
        return None
    i = min(int(np.searchsorted(axis, x, side="right")) - 1, len(axis) - 2)
    return i, (x - axis[i]) / (axis[i + 1] - axis[i])


def stencil(axis, x, is_cubic):
    """Nodes beside a place, as a slice, and their weights; None outside. Cubic: Hermite, with the slopes of central differences, one-sided at the ends."""
    found = cell(axis, x)
    if found is None:
        return None
    i, a = found
    if not is_cubic:
        return slice(i, i + 2), np.array([1 - a, a])
    first, last = max(i - 1, 0), min(i + 2, len(axis) - 1)
    weights = np.zeros(last + 1 - first)
    for node, value, slope in ((i, (1 + 2 * a) * (1 - a) ** 2, a * (1 - a) ** 2), (i + 1, a**2 * (3 - 2 * a), a**2 * (a - 1))):
        weights[node - first] += value
        low, high = max(node - 1, 0), min(node + 1, len(axis) - 1)
        slope *= (axis[i + 1] - axis[i]) / (axis[high] - axis[low])
        weights[high - first] += slope
        weights[low - first] -= slope
    return slice(first, last + 1), weights


def interpolate(values, axes, place, is_cubic):
    """Of (component, time, ..., y, x) values: (component, time) at a place (x, y, ...), of which axes has the nodes in the order of the values; None outside."""
    found = [stencil(axis, q, is_cubic) for axis, q in zip(axes, place[len(axes) - 1 :: -1])]
    if any(f is None for f in found):
        return None
    block = values[(slice(None), slice(None), *(nodes for nodes, _ in found))]
    for _, weights in reversed(found):
        block = block @ weights
    return block


class Plane:
    """Values of (component, time, z, y, x) on even or uneven rows, linear in time."""

    # Coarser steps err by more at the faces of cells: with 1e-8 m by 3e-5 of the FTLE, with 1e-6 m by 2e-4.
    gaps, tolerance = [1.0, 1.0, 0.05], 1e-9
    is_cubic = False

    def at(self, place, t):
        time = cell(self.time, t)
        if time is None:
            return np.full(len(place), np.nan)
        n, s = time
        # The next time is not read if it does not count: something may be missing there.
        times = slice(n, n + 1) if s == 0.0 else slice(n, n + 2)
        found = self.between(place, times)
        if found is None:
            return np.full(len(place), np.nan)
        return found[:, 0] if s == 0.0 else found[:, 0] * (1 - s) + found[:, 1] * s

    def between(self, place, times):
        return interpolate(self.v[:, times], self.axes, place, self.is_cubic)

    @staticmethod
    def metres(place):
        """Metres of a coordinate's unit, along each axis."""
        return np.ones(len(place))


class Sphere(Plane):
    """Values of (component, time, [z,] latitude, longitude): vectors in space are interpolated, and their part along the sphere carries. A particle is
    carried in degrees, and in metres of height."""

    # Degrees: a metre.
    gaps, tolerance = [1e-5, 1e-5], 1e-11

    def __init__(self, time, axes, v):
        """From the components to the east and to the north, and upwards."""
        self.time, self.axes = time, axes
        lon, lat = np.meshgrid(axes[-1], axes[-2])
        east, north = self.directions(lon, lat)
        level = (slice(None), *[None] * (v.ndim - 3))
        space = east[level] * v[0] + north[level] * v[1]
        self.v = np.concatenate([space, v[2:]])
        self.gaps = [1e-5, 1e-5, 0.05][: len(axes)]

    @staticmethod
    def directions(lon, lat):
        """Unit vectors to the east and to the north, component first."""
        lon, lat = np.radians(lon), np.radians(lat)
        zero = np.zeros_like(lon)
        east = np.array([-np.sin(lon), np.cos(lon), zero])
        return east, np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])

    def at(self, place, t):
        found = super().at(place, t)
        if np.isnan(found).all():
            return found
        along = [direction @ found[:3] for direction in self.directions(place[0], place[1])]
        return np.array([*along, *found[3:]]) / self.metres(place)

    @staticmethod
    def metres(place):
        degree = np.radians(EARTH_RADIUS)
        return np.array([degree * np.cos(np.radians(place[1])), degree, 1.0])[: len(place)]


class GlobCurrent(Sphere):
    def __init__(self, files, heights):
        sets = sorted((netCDF4.Dataset(f) for f in files), key=lambda d: d["time"][0])
        # Files have `Unit` instead of `units`: days since 1900.
        time = np.array([(float(d["time"][0]) - 25567.0) * 86400.0 for d in sets])
        read = lambda name: np.stack([filled(d[f"{name}ward_eulerian_current_velocity"][0]) for d in sets])
        super().__init__(time, [filled(sets[0][name][:]) for name in ("lat", "lon")], np.stack([read("east"), read("north")]))


class Era5(Plane):
    """Pressure levels on a projected grid."""

    def __init__(self, files, heights):
        sets = sorted((netCDF4.Dataset(f) for f in files), key=lambda d: seconds(d["time"])[0])
        self.time = np.concatenate([seconds(d["time"]) for d in sets])
        pressure = filled(sets[0]["plev"][:])
        x, y = filled(sets[0]["x"][:]), filled(sets[0]["y"][:])
        up = np.argsort(-pressure)
        self.axes = [(-7000.0 * np.log(pressure / 1e5))[up], y, x]
        factor = (-7000.0 / pressure[up])[:, None, None]
        read = lambda name: np.stack([filled(d[name][0])[up] for d in sets])
        # (component, time, z, y, x)
        east, north = read("u"), read("v")
        (xe, xn), (ye, yn) = self.plane(*np.meshgrid(x, y))
        self.v = np.stack([xe * east + xn * north, ye * east + yn * north, read("w") * factor[None]])

    @staticmethod
    def plane(x, y):
        """Metres along x and y of UTM zone 32 for a metre on the ground to the east and to the north, by geodesics of 10 m."""
        ellipsoid = pyproj.Geod(ellps="GRS80")
        utm = pyproj.Proj("+proj=utm +zone=32 +ellps=GRS80")
        lon, lat = utm(x, y, inverse=True)
        ends = lambda azimuth: np.array(utm(*ellipsoid.fwd(lon, lat, np.full_like(lon, azimuth), np.full_like(lon, 10.0))[:2]))
        along = [(ends(azimuth) - ends(azimuth + 180.0)) / 20.0 for azimuth in (90.0, 0.0)]
        return (along[0][0], along[1][0]), (along[0][1], along[1][1])


class Faces(Plane):
    """Components on (time, level, y, x), each with its own coordinates of one dimension, in metres; beyond its levels a component is that of the last one."""

    gaps, tolerance = [0.01, 0.01, 1e-3], 1e-11

    def between(self, place, times):
        # Together they cover the levels of all.
        lowest, highest = min(axes[0][0] for axes, _ in self.own), max(axes[0][-1] for axes, _ in self.own)
        if not lowest <= place[2] <= highest:
            return None
        inside = lambda axes: [place[0], place[1], np.clip(place[2], axes[0][0], axes[0][-1])]
        found = [interpolate(values[None, times], axes, inside(axes), False) for axes, values in self.own]
        return None if any(f is None for f in found) else np.concatenate(found)


class Rows(Faces):
    """`UVEL`, `VVEL` and `WVEL`."""

    def __init__(self, files, heights):
        d = netCDF4.Dataset(files[0])
        self.time = seconds(d["T"])
        self.own = []
        for name in ("UVEL", "VVEL", "WVEL"):
            t, *axes = d[name].dimensions
            values, axes = filled(d[name][:]), [filled(d[axis][:]) for axis in axes]
            for k, axis in enumerate(axes):
                if axis[0] > axis[-1]:
                    axes[k], values = axis[::-1], np.flip(values, k + 1)
            self.own.append((axes, values))


def at_heights(values, z, heights, ends):
    """(time, level, y, x) values of levels at z, ascending, at other heights. Beyond the highest and the lowest level, as far as `ends` (low, high) of
    (time, y, x), a value is that of the level; elsewhere it is missing."""
    out = np.full((values.shape[0], len(heights), *values.shape[2:]), np.nan)
    for n, j, i in np.ndindex(*(values.shape[k] for k in (0, 2, 3))):
        inside = (ends[0][n, j, i] <= heights) & (heights <= ends[1][n, j, i])
        out[n, inside, j, i] = np.interp(heights[inside], z[n, :, j, i], values[n, :, j, i])
    return out


class Roms(Faces):
    """Levels that follow the bottom of the sea, by `Vtransform` 2, on faces in a plane; columns at fixed heights."""

    def __init__(self, files, heights):
        d = netCDF4.Dataset(files[0])
        self.time = seconds(d["ocean_time"])
        s, c, hc = filled(d["s_rho"][:]), filled(d["Cs_r"][:]), float(d["hc"][...])
        h, zeta = filled(d["h"][:]), filled(d["zeta"][:])
        x, y = filled(d["x_rho"][:])[0], filled(d["y_rho"][:])[:, 0]
        middle = lambda q, axis: 0.5 * (np.take(q, range(1, q.shape[axis]), axis) + np.take(q, range(q.shape[axis] - 1), axis))
        self.heights, self.own = np.array(heights), []
        for name, axis in (("u", -1), ("v", -2), ("w", None)):
            bottom, eta = (h, zeta) if axis is None else (middle(h, axis), middle(zeta, zeta.ndim + axis))
            share = (hc * s[:, None, None] + bottom * c[:, None, None]) / (hc + bottom)
            z = eta[:, None] + (eta[:, None] + bottom) * share
            # The surface counts as being at 0 at least.
            ends = np.broadcast_to(-bottom, eta.shape), np.maximum(eta, 0.0)
            rows = {-1: [y, middle(x, 0)], -2: [middle(y, 0), x], None: [y, x]}[axis]
            self.add(rows, filled(d[name][:]), z, ends)

    def add(self, rows, values, z, ends):
        self.own.append(([self.heights, *rows], at_heights(values, z, self.heights, ends)))


class RomsColumns(Roms):
    """The same, but the column at a particle's place is interpolated, its heights and its values, and no heights are fixed: as the model itself would. The
    lowest and the highest of `heights` end the domain."""

    def add(self, rows, values, z, ends):
        self.own.append((rows, np.stack([values, z]), np.stack(ends)))

    def between(self, place, times):
        if not self.heights[0] <= place[2] <= self.heights[-1]:
            return None
        out = []
        for rows, columns, ends in self.own:
            # (values or heights, time, level)
            found = self.plane(columns[:, times], rows, place)
            if found is None:
                return None
            low, high = self.plane(ends[:, times], rows, place)
            if not ((low <= place[2]) & (place[2] <= high)).all():
                return None
            out.append([np.interp(place[2], z, values) for values, z in zip(*found)])
        return np.array(out)

    @staticmethod
    def plane(values, rows, place):
        found = [stencil(row, q, False) for row, q in zip(rows, (place[1], place[0]))]
        if any(f is None for f in found):
            return None
        (j, along_y), (i, along_x) = found
        return np.einsum("j,...ji,i->...", along_y, values[..., j, i], along_x)


class Layers(Sphere):
    """Longitudes, latitudes and levels whose heights a field `depth` of (time, level, lat, lon) tells, metres downwards; columns at fixed heights."""

    def __init__(self, files, heights):
        d = netCDF4.Dataset(files[0])
        # From the top downwards.
        z = -filled(d["depth"][:])[:, ::-1]
        # Above the highest level the water goes on to 0, if that is no further than the next level below.
        is_near = -z[:, -1] <= z[:, -1] - z[:, -2]
        ends = (z[:, 0], np.where(is_near, 0.0, z[:, -1]))
        heights = np.array(heights)
        read = lambda name: at_heights(filled(d[name][:])[:, ::-1], z, heights, ends)
        axes = [heights, filled(d["lat"][:]), filled(d["lon"][:])]
        super().__init__(seconds(d["time"]), axes, np.stack([read(name) for name in ("uo", "vo", "wo")]))


class Hybrid(Sphere):
    """Longitudes, latitudes and levels of the pressure a p0 + b ps, from the top downwards, and omega; columns at fixed heights."""

    def __init__(self, files, heights):
        d = netCDF4.Dataset(files[0])
        ps = filled(d["PS"][:])
        p0 = 100.0 * float(d["p0"][...])
        pressure = (filled(d["a"][:])[:, None, None] * p0 + filled(d["b"][:])[:, None, None] * ps[:, None])[:, ::-1]
        z = -7000.0 * np.log(pressure / 1e5)
        ends = (-7000.0 * np.log(ps / 1e5), np.full(ps.shape, np.inf))
        heights = np.array(heights)
        read = lambda name: filled(d[name][:])[:, ::-1]
        w = -7000.0 * read("OMEGA") / pressure
        north = filled(d["lat"][:])
        # Latitudes ascend.
        order = np.argsort(north)
        v = np.stack([at_heights(v, z, heights, ends)[:, :, order] for v in (read("U"), read("V"), w)])
        super().__init__(seconds(d["time"]), [heights, north[order], filled(d["lon"][:])], v)


class Wrf:
    """Arakawa C: each component from its own faces, each column between its own levels at the particle's place."""

    gaps, tolerance = [1.0, 1.0, 0.05], 1e-6
    is_cubic = False
    metres = staticmethod(Plane.metres)

    def __init__(self, files, heights):
        d = netCDF4.Dataset(files[0])
        rows = [b"".join(row).decode().replace("_", " ") for row in np.asarray(d["Times"][:])]
        # As numpy has dates, not netCDF4.
        self.time = np.array([(np.datetime64(r.replace(" ", "T")) - np.datetime64("1970-01-01T00:00:00")) / np.timedelta64(1, "s") for r in rows])
        self.dx, self.dy = float(d.DX), float(d.DY)
        self.u = filled(d["U"][:]) * filled(d["MAPFAC_U"][:])[:, None]
        self.v = filled(d["V"][:]) * filled(d["MAPFAC_V"][:])[:, None]
        self.w = filled(d["W"][:])
        self.height = (filled(d["PH"][:]) + filled(d["PHB"][:])) / 9.81
        # A nest that follows a storm: cells by which it lies elsewhere than at first.
        lon, lat = np.radians(filled(d["XLONG"][:])), np.radians(filled(d["XLAT"][:]))
        self.moved = [self.shift(lon[0], lat[0], lon[n], lat[n]) for n in range(len(self.time))]

    @staticmethod
    def shift(lon0, lat0, lon, lat):
        """From the pair of centres, one of each time, that are nearest to one another."""
        east = (lon0[:, :, None, None] - lon[None, None]) * np.cos(lat)[None, None]
        apart = np.hypot(east, lat0[:, :, None, None] - lat[None, None])
        j0, i0, j, i = np.unravel_index(np.argmin(apart), apart.shape)
        assert apart[j0, i0, j, i] < 1e-5
        return i0 - i, j0 - j

    @staticmethod
    def plane(values, i, j):
        """Columns of (z, y, x) values at a place counted in points."""
        ny, nx = values.shape[1:]
        if not (0 <= i <= nx - 1 and 0 <= j <= ny - 1):
            return None
        a, b = min(int(i), nx - 2), min(int(j), ny - 2)
        s, t = i - a, j - b
        block = values[:, b : b + 2, a : a + 2]
        return (1 - t) * ((1 - s) * block[:, 0, 0] + s * block[:, 0, 1]) + t * ((1 - s) * block[:, 1, 0] + s * block[:, 1, 1])

    def at_time(self, n, place):
        # Faces count from 0, centres from a half.
        i, j = place[0] / self.dx - self.moved[n][0], place[1] / self.dy - self.moved[n][1]
        full = self.plane(self.height[n], i - 0.5, j - 0.5)
        if full is None:
            return np.full(3, np.nan)
        half = 0.5 * (full[1:] + full[:-1])
        z = place[2]
        if not full[0] <= z <= half[-1]:
            return np.full(3, np.nan)
        u, v, w = self.plane(self.u[n], i, j - 0.5), self.plane(self.v[n], i - 0.5, j), self.plane(self.w[n], i - 0.5, j - 0.5)
        return np.array([np.interp(z, half, u), np.interp(z, half, v), np.interp(z, full, w)])

    def at(self, place, t):
        found = cell(self.time, t)
        if found is None:
            return np.full(3, np.nan)
        n, s = found
        before = self.at_time(n, place)
        return before if s == 0.0 else (1 - s) * before + s * self.at_time(n + 1, place)


def arrive(flow, start, begin, tau):
    # Steps end where the velocity in time has kinks.
    ends = [t for t in flow.time if min(begin, begin + tau) < t < max(begin, begin + tau)]
    ends = sorted(ends, reverse=tau < 0) + [begin + tau]
    # The way from the start, since the relative tolerance of metres from a far origin is coarser than the absolute one.
    start, way, t = np.asarray(start, dtype=float), np.zeros(len(start)), begin
    for end in ends:
        velocity = lambda t, way: flow.at(start + way, t)
        solution = solve_ivp(velocity, (t, end), way, method="DOP853", rtol=1e-13, atol=flow.tolerance, max_step=abs(tau) / 20)
        way, t = solution.y[:, -1], end
        if not solution.success or not np.isfinite(way).all():
            return np.full(len(start), np.nan)
    return start + way


KINDS = {"era5": Era5, "wrf": Wrf, "globcurrent": GlobCurrent, "rows": Rows, "roms": Roms, "roms columns": RomsColumns, "layers": Layers, "hybrid": Hybrid}


def main():
    task = json.load(sys.stdin)
    flow = KINDS[task["kind"]](task["files"], task["heights"])
    flow.is_cubic = task["interpolation"] == "cubic"
    out = []
    for point in task["points"]:
        if sum(not isinstance(value, str) for value in out) == task["count"]:
            break
        point = np.array(point[: len(flow.gaps)], dtype=float)
        columns, middles = [], []
        for axis, gap in enumerate(flow.gaps):
            ends = []
            for sign in (1, -1):
                moved = point.copy()
                moved[axis] += sign * gap
                ends.append(arrive(flow, moved, task["from"], task["tau"]))
            columns.append((ends[0] - ends[1]) / (2 * gap))
            middles.append((ends[0] + ends[1]) / 2)
        jacobian = np.stack(columns, axis=1)
        jacobian = jacobian * flow.metres(np.mean(middles, axis=0))[:, None] / flow.metres(point)[None, :]
        if np.isfinite(jacobian).all():
            out.append(float(np.log(np.linalg.svd(jacobian, compute_uv=False)[0])))
        else:
            complete = np.isfinite(arrive(flow, point, task["from"], task["tau"])).all()
            out.append("neighbour" if complete else "seed")
    json.dump(out, sys.stdout)


main()
