"""Writes one ocean as NetCDF and as Zarr stores of many kinds, by xarray and zarr-python. Prints a line for each: NetCDF file, store."""

import sys
import warnings
from pathlib import Path

import numcodecs
import numpy as np
import xarray as xr
import zarr
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec, GzipCodec, TransposeCodec, ZstdCodec

warnings.simplefilter("ignore")
folder = Path(sys.argv[1])
random = np.random.default_rng(1)
nt, nz, ny, nx = 7, 3, 40, 70
time = np.arange(nt) * 6.0
level = np.array([5.0, 20.0, 90.0])
lat = np.linspace(30.0, 49.5, ny)
lon = np.linspace(-20.0, 14.5, nx)
land = random.random((ny, nx)) < 0.2


def ocean(dtype, calendar="standard"):
    def current(name, standard):
        values = random.normal(size=(nt, nz, ny, nx)) * 0.5
        values[:, :, land] = np.nan
        return ("time", "depth", "lat", "lon"), values.astype(dtype), {"standard_name": standard, "units": "m s-1"}

    return xr.Dataset(
        {"uo": current("uo", "eastward_sea_water_velocity"), "vo": current("vo", "northward_sea_water_velocity")},
        {
            "time": ("time", time, {"units": "hours since 2020-02-27", "calendar": calendar, "standard_name": "time"}),
            "depth": ("depth", level, {"units": "m", "positive": "down", "standard_name": "depth"}),
            "lat": ("lat", lat, {"units": "degrees_north", "standard_name": "latitude"}),
            "lon": ("lon", lon, {"units": "degrees_east", "standard_name": "longitude", "valid_min": -180.0}),
        },
        {"title": "an ocean", "missing": np.nan},
    )


def write(dataset, name, encodings, netcdf):
    """Writes `dataset` as NetCDF with the encoding of `netcdf`, and as stores."""
    file = f"{name}.nc"
    dataset.to_netcdf(folder / file, encoding={v: netcdf for v in ("uo", "vo")})
    for kind, (options, encoding) in encodings.items():
        store = f"{name}_{kind}"
        target = folder / store
        if kind.endswith(".zip"):
            target = zarr.storage.ZipStore(target, mode="w")
        dataset.to_zarr(target, mode="w", encoding={v: encoding | netcdf for v in ("uo", "vo")}, **options)
        if kind.endswith(".zip"):
            target.close()
        print(file, store)


v2, v3 = {"zarr_format": 2, "consolidated": True}, {"zarr_format": 3, "consolidated": True}
chunks = {"chunks": (3, 2, 17, 32)}
stores = {
    "v2.zarr": (v2, chunks),
    "v2_plain.zarr": (v2 | {"consolidated": False}, chunks | {"compressors": None}),
    "v2_one.zarr": (v2, {"chunks": (nt, nz, ny, nx)}),
    "v2_zlib.zarr": (v2, chunks | {"compressors": [numcodecs.Zlib(5)]}),
    "v2_lz4.zarr": (v2, chunks | {"compressors": [numcodecs.LZ4()]}),
    "v2_gzip.zarr": (v2, chunks | {"compressors": [numcodecs.GZip(5)]}),
    "v2_zstd.zarr": (v2, chunks | {"compressors": [numcodecs.Zstd(5)]}),
    "v2_shuffle.zarr": (v2, chunks | {"filters": [numcodecs.Shuffle(4)], "compressors": [numcodecs.Zstd(1)]}),
    "v2_blosclz.zarr": (v2, chunks | {"compressors": [numcodecs.Blosc("blosclz", 5, 1)]}),
    "v2_blosc_zlib.zarr": (v2, chunks | {"compressors": [numcodecs.Blosc("zlib", 9, 1)]}),
    "v2_blosc_bits.zarr": (v2, chunks | {"compressors": [numcodecs.Blosc("zstd", 3, 2)]}),
    "v2_blosc_lz4hc.zarr": (v2, chunks | {"compressors": [numcodecs.Blosc("lz4hc", 9, 0)]}),
    "v2.zarr.zip": (v2, chunks),
    "v3.zarr": (v3, chunks),
    "v3_plain.zarr": (v3 | {"consolidated": False}, chunks | {"compressors": None}),
    "v3_blosc.zarr": (v3, chunks | {"compressors": [BloscCodec(cname="lz4", shuffle="shuffle")]}),
    "v3_gzip.zarr": (v3, chunks | {"compressors": [GzipCodec(), Crc32cCodec()]}),
    "v3_shards.zarr": (v3, {"chunks": (1, 1, 10, 10), "shards": (4, 3, 20, 70), "compressors": [ZstdCodec()]}),
    "v3.zarr.zip": (v3, {"chunks": (1, 1, 10, 10), "shards": (4, 3, 20, 70)}),
}
write(ocean("float32"), "single", stores, {"dtype": "float32", "_FillValue": np.float32(9.96921e36)})
few = {key: stores[key] for key in ("v2.zarr", "v3.zarr", "v3_shards.zarr", "v2_one.zarr")}
write(ocean("float64", "noleap"), "double", few, {"dtype": "float64", "_FillValue": np.nan})
packed = {"dtype": "int16", "scale_factor": 0.0006103701889514923, "add_offset": -0.1, "_FillValue": np.int16(-32767)}
write(ocean("float64", "360_day"), "packed", few | {"v2_lz4.zarr": stores["v2_lz4.zarr"]}, packed)

# zarr-python alone: big-endian, columns first, other names of chunks. Its own fill value, 0, would be missing in version 2.
big = ocean("float32").fillna(0.0)
big.to_netcdf(folder / "big.nc")
for version in (2, 3):
    name = f"big_{version}.zarr"
    group = zarr.create_group(folder / name, zarr_format=version)
    for key, variable in big.variables.items():
        values = variable.values.astype(">f4" if key in ("uo", "vo") else ">f8")
        dims = {} if version == 2 else {"dimension_names": variable.dims}
        if version == 2:
            dims |= {"chunk_key_encoding": {"name": "v2", "separator": "/"}, "order": "F", "dtype": values.dtype}
        else:
            codecs = {"serializer": BytesCodec(endian="big"), "filters": [TransposeCodec(order=tuple(reversed(range(values.ndim))))]}
            dims |= codecs | {"chunk_key_encoding": {"name": "default", "separator": "."}, "dtype": values.dtype.newbyteorder("=")}
        array = group.create_array(key, shape=values.shape, chunks=tuple(-(-n // 2) for n in values.shape), fill_value=-9.0, **dims)
        array[...] = values
        array.attrs.update({k: (v if isinstance(v, str) else float(v)) for k, v in variable.attrs.items()})
        if version == 2:
            array.attrs["_ARRAY_DIMENSIONS"] = list(variable.dims)
    print("big.nc", name)
