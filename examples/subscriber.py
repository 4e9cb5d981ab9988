#!/usr/bin/env python3
"""Prints a line for each frame that ridgewatch publishes, and saves the pictures if asked. Needs pyzmq.

    python3 examples/subscriber.py --save pictures                       # frames of `--publish`
    python3 examples/subscriber.py tcp://127.0.0.1:5577                  # frames of `--publish tcp://127.0.0.1:5577`
"""

import argparse
import contextlib
import json
import os
import pathlib
import stat
import sys
import time

import zmq

SUFFIX = {"jpeg": "jpg", "png": "png", "exr": "exr", "raw": "f32"}


def is_private(folder):
    """Whether a folder exists and is this user's alone. Frames in a folder of another user would be theirs."""
    try:
        about = os.lstat(folder)
    except OSError:
        return False
    return stat.S_ISDIR(about.st_mode) and about.st_uid == os.geteuid() and about.st_mode & 0o077 == 0


def private_endpoint():
    """The endpoint of `--publish`, in a folder that only this user enters."""
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    folder = f"{runtime}/ridgewatch" if os.path.isabs(runtime) and is_private(runtime) else f"/dev/shm/ridgewatch-{os.geteuid()}"
    # Made now, so that no other user makes it before ridgewatch starts.
    with contextlib.suppress(OSError):
        os.mkdir(folder, 0o700)
    if not is_private(folder):
        sys.exit(f"{folder} is not a folder of this user with mode 0700: set XDG_RUNTIME_DIR to such a folder, or name an endpoint")
    return f"ipc://{folder}/frames"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("endpoint", nargs="?", help="by default that of `--publish`")
    parser.add_argument("--save", type=pathlib.Path, help="folder for the pictures")
    parser.add_argument("--frames", type=int, default=0, help="stop after so many frames")
    parser.add_argument("--records", action="store_true", help="print the record messages too")
    options = parser.parse_args()
    if options.save:
        options.save.mkdir(parents=True, exist_ok=True)

    socket = zmq.Context().socket(zmq.SUB)
    # Two waiting messages are enough: old frames are useless.
    socket.setsockopt(zmq.RCVHWM, 2)
    # Reconnecting is libzmq's default (every 100 ms): after a disconnect the frames continue.
    socket.connect(options.endpoint or private_endpoint())
    socket.subscribe(b"frame")
    if options.records:
        socket.subscribe(b"record")

    last, seen = None, 0
    while not options.frames or seen < options.frames:
        topic, *parts = socket.recv_multipart()
        if topic == b"record":
            record = json.loads(parts[0])
            print(f"record {record['frame']}: traced {100 * record['traced_share']:.1f} %", flush=True)
            continue
        header, payload = json.loads(parts[0]), parts[1]
        if header["protocol"] != 3 or len(payload) != header["payload_bytes"]:
            print(f"not understood: protocol {header['protocol']}, {len(payload)} bytes", file=sys.stderr)
            continue
        now, record = time.monotonic(), header["record"]
        gap = 0.0 if last is None else now - last
        last, seen = now, seen + 1
        error = record["picture_error"]
        stated = "" if error is None else f", {error['psnr']['value']:.1f} dB stated"
        print(
            f"frame {header['frame']}: time {record['time']:g}, {header['shape'][1]}x{header['shape'][0]} {header['encoding']}, "
            f"{len(payload)} bytes, traced {100 * record['traced_share']:.1f} %{stated}, gap {gap:.3f} s",
            flush=True,
        )
        for warning in record["warnings"]:
            print(f"  {warning}", flush=True)
        if options.save:
            name = f"frame_{header['frame']:06d}.{SUFFIX[header['encoding']]}"
            (options.save / name).write_bytes(payload)


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        pass
