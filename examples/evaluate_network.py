#!/usr/bin/env python3
"""Evaluates a checkpoint of `ridgewatch replay --checkpoint` with NumPy alone: evaluate_network.py CHECKPOINT < points > log_stretch

Points are lines of unit coordinates x y z and, for a network that is shown them, a start time and a duration in the unit of the flow's time.
Takes networks with the target ftle, alone or on a table. docs/protocol.md says what is in the file.
"""
import json
import sys
import numpy as np
HASH = np.array([1, 2654435761, 805459861, 3674653429])


def interpolate(points, grid, values):
    """Multilinear between the nodes of a grid, whose values lie x fastest, or where a hash of the node says."""
    cells = np.array(grid["cells"][: points.shape[1]])
    position = points.astype("f4") * cells.astype("f4")
    cell = np.minimum(position.astype(int), cells - 1)
    share, total = position - cell, 0
    for corner in np.ndindex(*[2] * len(cells)):
        node, weight = cell + corner, np.prod(np.where(corner, share, 1 - share), axis=1)
        in_order, hashed = node @ np.cumprod([1, *(cells[:-1] + 1)]), np.bitwise_xor.reduce(node * HASH[: len(cells)], axis=1)
        entry = hashed % grid["entries"] if grid["hashed"] else in_order
        total = total + weight[:, None] * values[grid["offset"] + entry].astype("f8")
    return total


if len(sys.argv) != 2:
    sys.exit(__doc__)
data = open(sys.argv[1], "rb").read()
length = int.from_bytes(data[:8], "little")
header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
notes = header.pop("__metadata__")
tensors = {name: np.frombuffer(body[slice(*entry["data_offsets"])], "<f4").reshape(entry["shape"]) for name, entry in header.items()}
if "network.shape" not in notes or (shape := json.loads(notes["network.shape"]))["target"] != "ftle":
    sys.exit(f"{sys.argv[1]}: no network, or its target is not ftle")
# What the network is shown, a column an input, all in the unit interval.
points, names, tau = np.loadtxt(sys.stdin, ndmin=2), notes["network.inputs"].split(), float(notes["network.tau"])
ranges = {"start": [float(t) for t in notes.get("network.start_range", "0 1").split()], "duration": [0, tau]}
columns = ["x", "y", "z"] + [name for name in names if name in ranges]
if points.shape[1] != len(columns):
    sys.exit(f"points have {points.shape[1]} columns; this network takes {len(columns)}: {' '.join(columns)}")
inputs = np.stack([np.interp(points[:, columns.index(name)], ranges.get(name, [0, 1]), [0, 1]) for name in names], 1)
if shape["levels"]:
    values = np.hstack([interpolate(inputs, level, tensors["network.tables.average"]) for level in shape["levels"]])
else:  # sin and cos of 2^l (pi/2) (2x - 1), ordered axis, octave l, (sin, cos)
    angle = (2 * inputs[:, :, None] - 1) * np.pi / 2 * 2.0 ** np.arange(shape["octaves"])
    values = np.stack([np.sin(angle), np.cos(angle)], -1).reshape(len(points), -1)
flat = tensors["network.layers.average"].astype("f8")
for number, layer in enumerate(shape["layers"]):
    weights, biases = np.split(flat[layer["weights"] : layer["biases"] + layer["outputs"]], [layer["inputs"] * layer["outputs"]])
    values = (np.maximum(values, 0) if number > 0 else values) @ weights.reshape(-1, layer["outputs"]) + biases
result = values[:, 0] * float(notes["network.deviation.0"]) + float(notes["network.mean.0"])
if notes["network.loss"] == "published":  # sign(y) ln(1 + |y|) of the FTLE y
    result = tau * np.sign(result) * np.expm1(np.abs(result))
if notes["kind"] == "residual":
    cells = [n - 1 for n in tensors["table.values"].shape[::-1] if n > 1]
    table = {"cells": cells, "hashed": False, "offset": 0}, tensors["table.values"].reshape(-1, 1)
    below = interpolate(points[:, : len(cells)].clip(0, 1), *table)
    result = below[:, 0] + float(notes["shrinkage"]) * result
np.savetxt(sys.stdout, result, "%.9g")
