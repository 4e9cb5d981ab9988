"""Publishes NumPy velocity fields of a running simulation to ridgewatch: a copy into shared memory, and nothing else.

    from ridgewatch_adapter import Publisher

    with Publisher(x, y, z) as publisher:        # coordinates of the grid; the ring is where RIDGEWATCH_RING says
        for step in range(steps):
            ...
            publisher.publish(step, time, u, v, w)   # arrays [z, y, x], float32 or float64, any strides

Where RIDGEWATCH_RING is not set and no ring is named, nothing happens and `publish` returns False. So it does, after a RuntimeWarning, where the
ring cannot be had: a simulation does not end for want of somebody who looks on. With strict=True that raises RidgewatchError.
"""

from ._core import Publisher, RidgewatchError

__all__ = ["Publisher", "RidgewatchError"]
