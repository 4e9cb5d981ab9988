#!/usr/bin/env python3
"""Sends a command to a run that was started with --steer, and prints the answer. Needs pyzmq.

    steer.py FILE '{"paused": true}'        FILE: the connection file that the run printed
"""

import hashlib
import hmac
import json
import secrets
import sys

import zmq


def sign(key, *parts):
    return hmac.new(key, b"".join(parts), hashlib.sha256).digest()


def main(path, command):
    with open(path, encoding="ascii") as file:
        found = dict(line.strip().split(" = ", 1) for line in file)
    key = bytes.fromhex(found["key"])
    socket = zmq.Context.instance().socket(zmq.REQ)
    socket.setsockopt(zmq.RCVTIMEO, 5000)
    socket.setsockopt(zmq.LINGER, 0)
    socket.connect(found["address"])

    nonce = secrets.token_bytes(32)
    socket.send(json.dumps({"hello": 1, "nonce": nonce.hex()}).encode())
    challenge = bytes.fromhex(json.loads(socket.recv())["challenge"])
    session = sign(key, b"ridgewatch commands", nonce, challenge)

    text = json.dumps({"number": 1, "set": json.loads(command)}).encode()
    socket.send_multipart([sign(session, b"command", text).hex().encode(), text])
    *signature, answer = socket.recv_multipart()
    if not signature or not hmac.compare_digest(bytes.fromhex(signature[0].decode()), sign(session, b"answer", answer)):
        sys.exit(f"not signed by this run: {answer.decode()}")
    print(answer.decode())
    return 0 if "accepted" in json.loads(answer) else 1


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    sys.exit(main(*sys.argv[1:]))
