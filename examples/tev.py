#!/usr/bin/env python3
"""Shows published frames in the image viewer tev (https://github.com/Tom94/tev) in linear colours. Needs pyzmq, and a run with raw payloads.

    ridgewatch replay SCENE --publish --set 'publish.payload="raw"'
    tev &
    python3 examples/tev.py                                              # frames of `--publish`
    python3 examples/tev.py tcp://127.0.0.1:5577 --tev 127.0.0.1:14158   # another endpoint; tev's own address

On a cluster: `ssh -R 14158:127.0.0.1:14158 HOST` leads from there to tev on this machine.
"""

import argparse
import json
import socket
import struct
import sys

import zmq
from subscriber import private_endpoint

CREATE_IMAGE, UPDATE_IMAGE = 4, 6
CHANNELS = ("R", "G", "B", "A")
# tev accepts packets of any length; rows in parts keep both sides' buffers small.
MAX_BYTES = 1 << 22
SECONDS = 10.0


def packet(kind, *fields):
    """A message to tev: its length, its kind, and fields in little endian."""
    body = struct.pack("<b", kind) + b"".join(fields)
    return struct.pack("<I", len(body) + 4) + body


def text(words):
    return words.encode() + b"\0"


def create(name, width, height):
    names = [text(channel) for channel in CHANNELS]
    return packet(CREATE_IMAGE, b"\0", text(name), struct.pack("<iii", width, height, len(CHANNELS)), *names)


def updates(name, width, height, pixels):
    """The pixels (little-endian f32, R, G, B, A of each, rows from the top) in parts of some rows."""
    count = len(CHANNELS)
    row = 4 * count * width
    step = max(1, MAX_BYTES // row)
    for top in range(0, height, step):
        rows = min(step, height - top)
        place = struct.pack("<iiii", 0, top, width, rows)
        layout = struct.pack(f"<{2 * count}q", *range(count), *[count] * count)
        names = [text(channel) for channel in CHANNELS]
        yield packet(UPDATE_IMAGE, b"\0", text(name), struct.pack("<i", count), *names, place, layout, pixels[top * row : (top + rows) * row])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("endpoint", nargs="?", help="by default that of `--publish`")
    parser.add_argument("--tev", default="127.0.0.1:14158", metavar="HOST:PORT", help="where tev listens (default: %(default)s)")
    parser.add_argument("--name", default="ridgewatch", help="name of the image in tev (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=0, help="stop after so many frames")
    options = parser.parse_args()
    host, _, port = options.tev.rpartition(":")
    if not host or not port.isdigit():
        parser.error(f"--tev is {options.tev!r}; accepted: HOST:PORT")
    try:
        viewer = socket.create_connection((host, int(port)), timeout=SECONDS)
    except OSError as error:
        sys.exit(f"tev is not reached at {options.tev}: {error}. Start tev first, or name its address with --tev")

    frames = zmq.Context().socket(zmq.SUB)
    # Old frames are useless.
    frames.setsockopt(zmq.RCVHWM, 2)
    frames.connect(options.endpoint or private_endpoint())
    frames.subscribe(b"frame")
    size, seen = None, 0
    while not options.frames or seen < options.frames:
        _, head, pixels = frames.recv_multipart()
        header = json.loads(head)
        if header["protocol"] != 3 or len(pixels) != header["payload_bytes"]:
            print(f"not understood: protocol {header['protocol']}, {len(pixels)} bytes", file=sys.stderr)
            continue
        if header["encoding"] != "raw":
            sys.exit(f"frames come as {header['encoding']}: start the run with --set 'publish.payload=\"raw\"'")
        height, width, _ = header["shape"]
        try:
            if size != (width, height):
                viewer.sendall(create(options.name, width, height))
                size = (width, height)
            for part in updates(options.name, width, height, pixels):
                viewer.sendall(part)
        except OSError as error:
            sys.exit(f"tev at {options.tev} takes no more frames: {error}")
        seen += 1


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        pass
