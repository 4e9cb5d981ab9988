"""Log-stretch of the flow map by other tools than ridgewatch's: netCDF4 reads, SciPy integrates (DOP853), neighbours 2 gap apart are
differenced. The interpolation is written here, straight from what the files hold.

Standard input: {"kind": "era5" | "wrf" | "globcurrent" | "rows", "files": [...], "points": [[x, y, z], ...], "count": how many are wanted,
"from": seconds, "tau": seconds (signed)}. Coordinates in metres, heights above the sea (ERA5: -7000 ln(p / 1000 hPa)); of GlobCurrent
longitude and latitude in degrees. Standard output: log-stretches of the points, up to the one by which as many as wanted are known; where one
of a point's neighbours met missing values, "neighbour", and "seed" where the point itself did."""

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


class GlobCurrent:
    """Currents by longitude and latitude: bilinear in both, linear in time. A particle is carried in degrees."""

    # Degrees: a metre, and a millionth of it in a step.
    gaps, tolerance = [1e-5, 1e-5], 1e-11

    def __init__(self, files):
        sets = sorted((netCDF4.Dataset(f) for f in files), key=lambda d: d["time"][0])
        # Files have `Unit` instead of `units`: days since 1900.
        self.time = np.array([(float(d["time"][0]) - 25567.0) * 86400.0 for d in sets])
        self.x, self.y = filled(sets[0]["lon"][:]), filled(sets[0]["lat"][:])
        read = lambda name: np.stack([filled(d[f"{name}ward_eulerian_current_velocity"][0]) for d in sets])
        self.v = np.stack([read("east"), read("north")])

    def at(self, place, t):
        found = [cell(a, q) for a, q in zip((self.y, self.x, self.time), (place[1], place[0], t))]
        if any(f is None for f in found):
            return np.full(2, np.nan)
        (j, b), (i, a), (n, s) = found
        out = 0.0
        for dn, wn in ((0, 1 - s), (1, s)):
            if wn == 0.0:
                continue
            block = self.v[:, n + dn, j : j + 2, i : i + 2]
            along = block[..., 0] * (1 - a) + block[..., 1] * a
            out = out + wn * (along[..., 0] * (1 - b) + along[..., 1] * b)
        return np.degrees(out / self.metres(place))

    @staticmethod
    def metres(place):
        """Metres a radian, along longitude and latitude."""
        return EARTH_RADIUS * np.array([np.cos(np.radians(place[1])), 1.0])


class Era5:
    """Pressure levels on a projected grid: trilinear in x, y and height, linear in time."""

    # Coarser steps err by more at the faces of cells: with 1e-8 m by 3e-5 of the FTLE, with 1e-6 m by 2e-4.
    gaps, tolerance = [1.0, 1.0, 0.05], 1e-9

    def __init__(self, files):
        sets = sorted((netCDF4.Dataset(f) for f in files), key=lambda d: seconds(d["time"])[0])
        self.time = np.concatenate([seconds(d["time"]) for d in sets])
        pressure = filled(sets[0]["plev"][:])
        self.x, self.y = filled(sets[0]["x"][:]), filled(sets[0]["y"][:])
        up = np.argsort(-pressure)
        self.z = (-7000.0 * np.log(pressure / 1e5))[up]
        factor = (-7000.0 / pressure[up])[:, None, None]
        read = lambda name: np.stack([filled(d[name][0])[up] for d in sets])
        # (component, time, z, y, x)
        east, north = read("u"), read("v")
        (xe, xn), (ye, yn) = self.plane(*np.meshgrid(self.x, self.y))
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

    def at(self, place, t):
        found = [cell(a, q) for a, q in zip((self.z, self.y, self.x, self.time), (place[2], place[1], place[0], t))]
        if any(f is None for f in found):
            return np.full(3, np.nan)
        (k, c), (j, b), (i, a), (n, s) = found
        out = 0.0
        for dn, wn in ((0, 1 - s), (1, s)):
            if wn == 0.0:
                continue
            block = self.v[:, n + dn, k : k + 2, j : j + 2, i : i + 2]
            along = block[..., 0] * (1 - a) + block[..., 1] * a
            along = along[..., 0] * (1 - b) + along[..., 1] * b
            out = out + wn * (along[..., 0] * (1 - c) + along[..., 1] * c)
        return out


class Rows:
    """u, v and w as `UVEL`, `VVEL`, `WVEL` on (time, level, y, x), each with its own coordinates of one dimension, in metres: trilinear, linear in time;
    beyond its levels a component is that of the last one."""

    gaps, tolerance = [0.01, 0.01, 1e-3], 1e-11

    def __init__(self, files):
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

    def at(self, place, t):
        time = cell(self.time, t)
        if time is None:
            return np.full(3, np.nan)
        n, s = time
        # Together they cover the levels of all.
        lowest, highest = min(a[0][0] for a, _ in self.own), max(a[0][-1] for a, _ in self.own)
        if not lowest <= place[2] <= highest:
            return np.full(3, np.nan)
        out = []
        for axes, values in self.own:
            z = np.clip(place[2], axes[0][0], axes[0][-1])
            found = [cell(axis, q) for axis, q in zip(axes, (z, place[1], place[0]))]
            if any(f is None for f in found):
                return np.full(3, np.nan)
            (k, c), (j, b), (i, a) = found
            block = values[n : n + 2, k : k + 2, j : j + 2, i : i + 2]
            along = block[..., 0] * (1 - a) + block[..., 1] * a
            along = along[..., 0] * (1 - b) + along[..., 1] * b
            along = along[..., 0] * (1 - c) + along[..., 1] * c
            out.append(along[0] * (1 - s) + along[1] * s)
        return np.array(out)


class Wrf:
    """Arakawa C: each component from its own faces, each column between its own levels at the particle's place."""

    gaps, tolerance = [1.0, 1.0, 0.05], 1e-6

    def __init__(self, files):
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


def main():
    task = json.load(sys.stdin)
    flow = {"era5": Era5, "wrf": Wrf, "globcurrent": GlobCurrent, "rows": Rows}[task["kind"]](task["files"])
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
        if isinstance(flow, GlobCurrent):
            jacobian = jacobian * flow.metres(np.mean(middles, axis=0))[:, None] / flow.metres(point)[None, :]
        if np.isfinite(jacobian).all():
            out.append(float(np.log(np.linalg.svd(jacobian, compute_uv=False)[0])))
        else:
            complete = np.isfinite(arrive(flow, point, task["from"], task["tau"])).all()
            out.append("neighbour" if complete else "seed")
    json.dump(out, sys.stdout)


main()
