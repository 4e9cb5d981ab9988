"""The newest frame of a run in a notebook (Jupyter, marimo, VS Code), and its records. Needs pyzmq and anywidget.

    from widget import LiveFrames              # this file, widget.js and subscriber.py beside the notebook
    live = LiveFrames()                        # frames of `--publish`; or LiveFrames("tcp://127.0.0.1:5577")
    live                                       # shows the picture, which follows the run
    live.records[-1]["picture_error"]          # records of the newest frames
    live.close()                               # ends the connection, and takes the view away; live.picture keeps the last one

Each object has a connection of its own: close the old one before the cell that makes it is run again.
"""

import collections
import json
import pathlib
import threading
import time

import anywidget
import traitlets
import zmq
from subscriber import private_endpoint

PROTOCOL = 3
# Encodings that a browser draws.
DRAWN = ("jpeg", "png")
# A view that says nothing, since its notebook is busy or was closed, gets a frame in so many seconds.
SILENT = 2.0
# A publisher that is silent for so many seconds has ended, pauses, or is slow.
QUIET = 5.0


class LiveFrames(anywidget.AnyWidget):
    """A view of the frames of a run. The next one is sent when a view has drawn the one before, so that none queue up.

    endpoint: a ZeroMQ endpoint; by default that of `--publish`.
    kept: number of records in `records`, newest last.
    """

    _esm = pathlib.Path(__file__).with_name("widget.js")
    picture = traitlets.Bytes(b"").tag(sync=True)
    encoding = traitlets.Unicode("jpeg").tag(sync=True)
    record = traitlets.Dict().tag(sync=True)
    state = traitlets.Unicode("").tag(sync=True)

    def __init__(self, endpoint=None, kept=2000):
        self._ended = threading.Event()
        self._reader = None
        super().__init__()
        self.endpoint = endpoint or private_endpoint()
        self.records = collections.deque(maxlen=kept)
        self.state = f"waiting for frames at {self.endpoint}"
        self._drawn = threading.Event()
        self._drawn.set()
        self.on_msg(self._hear)
        self._reader = threading.Thread(target=self._follow, daemon=True, name="ridgewatch frames")
        self._reader.start()

    def close(self):
        """Ends the connection, and takes the view away, as of every widget; the last picture stays in `picture`."""
        self._ended.set()
        if self._reader is not None:
            self._reader.join(timeout=2.0)
        super().close()

    def _hear(self, _widget, content, _buffers):
        if isinstance(content, dict) and "drawn" in content:
            self._drawn.set()

    def _follow(self):
        # A context of its own: it ends with the thread, whatever else the notebook does.
        with zmq.Context() as context, context.socket(zmq.SUB) as socket:
            socket.setsockopt(zmq.RCVHWM, 2)
            socket.setsockopt(zmq.LINGER, 0)
            socket.connect(self.endpoint)
            # Not to what the run is at for long (`work`): no picture comes of that. Nor to all layers (`layers`), which no browser draws.
            socket.subscribe(b"frame")
            socket.subscribe(b"record")
            waiting, sent, heard = None, 0.0, None
            while not self._ended.is_set():
                if socket.poll(50):
                    heard = time.monotonic()
                    try:
                        waiting = self._sort(socket.recv_multipart()) or waiting
                    except (ValueError, KeyError) as error:
                        self.state = f"not understood: {error!r}"
                now = time.monotonic()
                self._tell_silence(heard, now)
                if waiting and (self._drawn.is_set() or now - sent > SILENT):
                    self._drawn.clear()
                    self._show_frame(*waiting)
                    waiting, sent = None, now

    def _sort(self, parts):
        """Keeps a record; returns header and picture of a frame."""
        if parts[0] == b"record" and len(parts) == 2:
            self.records.append(json.loads(parts[1]))
            return None
        if parts[0] != b"frame" or len(parts) != 3:
            return None
        header = json.loads(parts[1])
        if header["protocol"] != PROTOCOL:
            self.state = f"not understood: protocol {header['protocol']}, this client knows {PROTOCOL}"
        elif header["encoding"] not in DRAWN:
            self.state = f"frames come as {header['encoding']}, which browsers do not draw: set publish.payload to \"jpeg\" or \"png\""
        elif len(parts[2]) == header["payload_bytes"]:
            return header, parts[2]
        return None

    def _tell_silence(self, heard, now):
        if heard is None:
            return
        silent = now - heard
        state = f"nothing new for {silent:.0f} s" if silent > QUIET else ""
        if state != self.state and not self.state.startswith(("not understood", "frames come as")):
            self.state = state

    def _show_frame(self, header, picture):
        self.state = ""
        with self.hold_sync():
            self.record = header["record"]
            self.encoding = header["encoding"]
            self.picture = picture
