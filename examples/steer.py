#!/usr/bin/env python3
"""Sends a command to a run that was started with --steer, and prints the answer. Needs pyzmq.

    steer.py FILE '{"paused": true}'        FILE: the connection file that the run printed

Exit status 0 if the command was accepted, 1 if it was refused or may have been lost.
"""

import hashlib
import hmac
import json
import secrets
import sys

import zmq

SECONDS = 5


def sign(key, *parts):
    return hmac.new(key, b"".join(parts), hashlib.sha256).digest()


def read_file(path):
    """Address and key of a connection file."""
    try:
        with open(path, encoding="ascii") as file:
            found = dict(line.strip().split(" = ", 1) for line in file)
        return found["address"], bytes.fromhex(found["key"])
    except OSError as error:
        sys.exit(f"the connection file cannot be read: {error}")
    except (KeyError, ValueError):
        sys.exit(f"{path} is no connection file")


def ask(socket, *parts):
    """The parts of the answer."""
    try:
        socket.send_multipart(parts)
        return socket.recv_multipart()
    except zmq.Again:
        sys.exit(f"no answer came within {SECONDS} seconds; what was sent may have been lost: is the run still there?")


def parse(text):
    try:
        answer = json.loads(text)
    except ValueError:
        answer = None
    if not isinstance(answer, dict):
        sys.exit(f"the answer is not understood: {text!r}")
    return answer


def greet(socket, key):
    """Key of the session."""
    nonce = secrets.token_bytes(32)
    answer = parse(ask(socket, json.dumps({"hello": 1, "nonce": nonce.hex()}).encode())[0])
    if "refused" in answer:
        sys.exit(f"the hello was refused: {answer['refused'].get('text')}")
    try:
        return sign(key, b"ridgewatch commands", nonce, bytes.fromhex(answer["challenge"]))
    except (KeyError, TypeError, ValueError):
        sys.exit(f"the answer to the hello is not understood: {answer}")


def main(path, command):
    address, key = read_file(path)
    try:
        changes = json.loads(command)
    except ValueError as error:
        sys.exit(f"the command is no JSON: {error}")
    socket = zmq.Context.instance().socket(zmq.REQ)
    socket.setsockopt(zmq.RCVTIMEO, 1000 * SECONDS)
    socket.setsockopt(zmq.SNDTIMEO, 1000 * SECONDS)
    socket.setsockopt(zmq.LINGER, 0)
    socket.connect(address)
    session = greet(socket, key)

    number = 1
    text = json.dumps({"number": number, "set": changes}).encode()
    *signature, body = ask(socket, sign(session, b"command", text).hex().encode(), text)
    answer = parse(body)
    expected = sign(session, b"answer", body).hex().encode()
    if len(signature) != 1 or not hmac.compare_digest(signature[0], expected):
        # Whoever holds the address may have written it.
        sys.exit(f"the answer is not signed by this run: {body.decode(errors='replace')}")
    # A command that cannot be read has no number to repeat.
    if answer.get("number", number) != number:
        sys.exit(f"the answer is that of command {answer['number']}, not of {number}")
    print(body.decode())
    return 0 if "accepted" in answer else 1


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    sys.exit(main(*sys.argv[1:]))
