#!/usr/bin/env python3
"""Evaluates a checkpoint of `ridgewatch replay --checkpoint` with NumPy alone: evaluate_network.py CHECKPOINT < points > log_stretch

Points are lines of unit coordinates x y z and, for a network that is shown them, a start time and a duration in the unit of the flow's time.
Takes networks with the target ftle and the loss mean_square, alone or on a table; the file is safetensors, whose metadata say the rest.
"""
import json
import sys

import numpy as np

PRIMES = np.array([1, 2654435761, 805459861, 3674653429])


def interpolate(points, cells, values_at):
    """Multilinear, between the nodes 0 to `cells` of each axis."""
    position = points.astype("f4") * np.array(cells, "f4")
    cell = np.minimum(position.astype(int), np.array(cells) - 1)
    share = position - cell
    weight = lambda corner: np.prod(np.where(corner, share, 1 - share), axis=1)[:, None]
    return sum(weight(corner) * values_at(cell + corner) for corner in np.ndindex(*[2] * len(cells)))


def features(points, level, tables):
    """Of one level of the hash grid."""
    cells = level["cells"][: points.shape[1]]
    strides = np.cumprod([1] + [n + 1 for n in cells[:-1]])
    hashed = lambda nodes: np.bitwise_xor.reduce(nodes * PRIMES[: len(cells)], axis=1) % level["entries"]
    entry = hashed if level["hashed"] else lambda nodes: nodes @ strides
    return interpolate(points, cells, lambda nodes: tables[level["offset"] + entry(nodes)].astype("f8"))


if len(sys.argv) != 2:
    sys.exit(__doc__)
data = open(sys.argv[1], "rb").read()
length = int.from_bytes(data[:8], "little")
header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
notes = header.pop("__metadata__")
tensors = {name: np.frombuffer(body[slice(*entry["data_offsets"])], "<f4").reshape(entry["shape"]) for name, entry in header.items()}
if notes.get("network.loss") != "mean_square" or (shape := json.loads(notes["network.shape"]))["target"] != "ftle":
    sys.exit(f"{sys.argv[1]}: no network, or its loss (network.loss) is not mean_square, or its target not ftle")

# What the network is shown, a column an input, all in the unit interval.
points, names = np.loadtxt(sys.stdin, ndmin=2), notes["network.inputs"].split()
first, last = map(float, notes.get("network.start_range", "0 1").split())
ranges = {"x": (0, 1), "y": (0, 1), "z": (0, 1), "start": (first, last), "duration": (0, float(notes["network.tau"]))}
columns = ["x", "y", "z"] + [name for name in names if len(name) > 1]
if points.shape[1] != len(columns):
    sys.exit(f"points have {points.shape[1]} columns; this network takes {len(columns)}: {' '.join(columns)}")
given = dict(zip(columns, points.T))
inputs = np.stack([(given[name] - ranges[name][0]) / (ranges[name][1] - ranges[name][0]) for name in names], 1).clip(0, 1)
if shape["levels"]:
    values = np.hstack([features(inputs, level, tensors["network.tables.average"]) for level in shape["levels"]])
else:  # sin and cos of 2^l (pi/2) (2x - 1), ordered axis, octave l, (sin, cos)
    angle = (2 * inputs[:, :, None] - 1) * np.pi / 2 * 2.0 ** np.arange(shape["octaves"])
    values = np.stack([np.sin(angle), np.cos(angle)], -1).reshape(len(points), -1)
flat = tensors["network.layers.average"].astype("f8")
for layer in shape["layers"]:
    weights = flat[layer["weights"] : layer["biases"]].reshape(layer["inputs"], layer["outputs"])
    values = values @ weights + flat[layer["biases"] : layer["biases"] + layer["outputs"]]
    values = values if layer is shape["layers"][-1] else np.maximum(values, 0)
result = values[:, 0] * float(notes["network.deviation.0"]) + float(notes["network.mean.0"])
if notes["kind"] == "residual":
    table = tensors["table.values"].squeeze()  # z, y, x; in two dimensions y, x
    cells = [n - 1 for n in table.shape[::-1]]
    below = interpolate(points[:, : len(cells)].clip(0, 1), cells, lambda nodes: table[tuple(nodes.T[::-1])].astype("f8")[:, None])
    result = below[:, 0] + float(notes["shrinkage"]) * result
np.savetxt(sys.stdout, result, "%.9g")
