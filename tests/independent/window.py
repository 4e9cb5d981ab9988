"""Reads a window of a store with xarray, as a replay does and at once. Prints for each: seconds, bytes read, sum of the speeds.

Given a folder and `write`, writes the stores first: currents of 40 times on 800 x 1000 nodes, in chunks of 10 times.
"""

import sys
import time
import warnings

import numpy as np
import xarray as xr
from zarr.codecs import BloscCodec, ZstdCodec

warnings.simplefilter("ignore")
if sys.argv[2] == "write":
    nt, ny, nx = 40, 800, 1000
    lat, lon = np.linspace(-40, 40, ny), np.linspace(0, 99.9, nx)
    x, y = np.meshgrid(np.radians(lon), np.radians(lat))
    wave = lambda t, k: (np.sin(9 * x + k + 0.1 * t) * np.cos(11 * y - 0.2 * t)).astype("float32")
    names = {"uo": "eastward_sea_water_velocity", "vo": "northward_sea_water_velocity"}
    field = lambda name, k: (("time", "lat", "lon"), np.stack([wave(t, k) for t in range(nt)]), {"units": "m s-1", "standard_name": names[name]})
    axes = {
        "time": ("time", np.arange(nt), {"units": "days since 2020-01-01"}),
        "lat": ("lat", lat, {"units": "degrees_north"}),
        "lon": ("lon", lon, {"units": "degrees_east"}),
    }
    data = xr.Dataset({"uo": field("uo", 0.0), "vo": field("vo", 1.0)}, axes)
    chunks = {"chunks": (10, 200, 250)}
    for store, version, encoding in [
        ("blosc.zarr", 2, chunks),
        ("zstd.zarr", 3, chunks | {"compressors": [ZstdCodec(level=1)]}),
        ("daily.zarr", 3, {"chunks": (1, 200, 250), "compressors": [BloscCodec(cname="zstd")]}),
        ("shards.zarr", 3, {"chunks": (1, 100, 125), "shards": (20, 400, 500)}),
    ]:
        data.to_zarr(f"{sys.argv[1]}/{store}", zarr_format=version, encoding={"uo": encoding, "vo": encoding}, mode="w")
    sys.exit()

west, east, south, north = map(float, sys.argv[2:])
read = lambda: int(open("/proc/self/io").readline().split()[1])
for at_once in [False, True]:
    begin, bytes_before = time.perf_counter(), read()
    window = xr.open_zarr(sys.argv[1], chunks=None).sel(lat=slice(south, north), lon=slice(west, east))
    total = 0.0
    steps = [slice(None)] if at_once else range(window.sizes["time"])
    for step in steps:
        u, v = window.uo.isel(time=step).values, window.vo.isel(time=step).values
        total += float(np.sqrt(u.astype("f8") ** 2 + v.astype("f8") ** 2).sum())
    print(time.perf_counter() - begin, read() - bytes_before, total)
