#!/usr/bin/env python3
"""Evaluates a checkpoint of `ridgewatch replay --checkpoint` with NumPy alone: evaluate_network.py CHECKPOINT < points > log_stretch

Points are lines of three unit coordinates and, for a network that is shown them, a start time and a duration in the unit of the flow's time;
the file is safetensors, whose metadata say how its tensors are to be evaluated.
"""
import json
import struct
import sys

import numpy as np

PRIMES = (1, 2654435761, 805459861, 3674653429)


def read(path):
    """Metadata and tensors."""
    data = open(path, "rb").read()
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + length])
    notes = header.pop("__metadata__")
    at = {name: [8 + length + offset for offset in entry["data_offsets"]] for name, entry in header.items()}
    return notes, {name: np.frombuffer(data[a:b], "<f4").reshape(header[name]["shape"]) for name, (a, b) in at.items()}


def interpolate(points, cells, entries):
    """Multilinear: `entries(nodes)` gives the values at nodes, a column an axis."""
    position = points.astype("f4") * np.asarray(cells, "f4")
    cell = np.minimum(position.astype(np.int64), np.asarray(cells) - 1)
    share, total = position - cell, 0.0
    for corner in np.ndindex(*[2] * len(cells)):
        weight = np.prod(np.where(corner, share, 1 - share), axis=1)
        total = total + weight[:, None] * entries(cell + corner)
    return total


def hash_grid(points, shape, tables):
    """Features of all levels, side by side."""
    columns = []
    for level in shape["levels"]:
        cells = level["cells"][: points.shape[1]]
        dense = np.cumprod([1] + [n + 1 for n in cells[:-1]])

        def entries(nodes):
            if level["hashed"]:
                index = np.bitwise_xor.reduce([nodes[:, k] * PRIMES[k] for k in range(len(cells))]) % level["entries"]
            else:
                index = nodes @ dense
            return tables[level["offset"] + index].astype("f8")

        columns.append(interpolate(points, cells, entries))
    return np.hstack(columns)


def frequencies(points, shape):
    """sin and cos of 2^l (pi/2) (2x - 1), ordered axis, octave, (sin, cos)."""
    angle = (2 * points[:, :, None] - 1) * np.pi / 2 * 2.0 ** np.arange(shape["octaves"])
    return np.stack([np.sin(angle), np.cos(angle)], -1).reshape(len(points), -1)


def inputs_of(points, notes):
    """What the network is shown, a column an input, all in the unit interval."""
    names = notes["network.inputs"].split()
    first, last = map(float, notes.get("network.start_range", "0 1").split())
    ranges = {"start": (first, last), "duration": (0.0, float(notes["network.tau"]))}
    columns = dict(zip("xyz", points.T))
    for name, column in zip([name for name in names if name in ranges], points.T[3:]):
        columns[name] = (column - ranges[name][0]) / (ranges[name][1] - ranges[name][0])
    missing = [name for name in names if name not in columns]
    if missing:
        sys.exit(f"points lack a column of {missing[0]}: this network wants x y z " + " ".join(name for name in names if name in ranges))
    return np.clip(np.stack([columns[name] for name in names], 1), 0, 1)


def log_stretch(path, points):
    """Log-stretch at points, of networks with the target ftle and the loss mean_square and of such networks on a table."""
    notes, tensors = read(path)
    shape, rest = json.JSONDecoder().raw_decode(notes["network.shape"])
    if shape["target"] != "ftle" or "MeanSquare" not in notes["network.shape"][rest:]:
        sys.exit(f"{path}: this evaluates the target ftle with the loss mean_square only")
    inputs = inputs_of(points, notes)
    values = hash_grid(inputs, shape, tensors["network.tables.average"]) if shape["levels"] else frequencies(inputs, shape)
    flat = tensors["network.layers.average"].astype("f8")
    for number, layer in enumerate(shape["layers"]):
        weights = flat[layer["weights"] : layer["biases"]].reshape(layer["inputs"], layer["outputs"])
        values = values @ weights + flat[layer["biases"] : layer["biases"] + layer["outputs"]]
        values = np.maximum(values, 0) if number + 1 < len(shape["layers"]) else values
    learned = values[:, 0] * float(notes["network.deviation.0"]) + float(notes["network.mean.0"])
    if notes["kind"] == "network":
        return learned
    table = tensors["table.values"].astype("f8")  # z, y, x
    cells = [n - 1 for n in table.shape[::-1] if n > 1]
    below = interpolate(np.clip(points, 0, 1)[:, : len(cells)], cells, lambda nodes: table[(0,) * (3 - len(cells)) + tuple(nodes.T[::-1])][:, None])
    return below[:, 0] + float(notes["shrinkage"]) * learned


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    np.savetxt(sys.stdout, log_stretch(sys.argv[1], np.loadtxt(sys.stdin, ndmin=2)), "%.9g")
