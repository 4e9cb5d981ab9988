"""Publishes NumPy velocity fields of a running simulation to ridgewatch, by a copy into shared memory.

    from ridgewatch_adapter import Publisher

    with Publisher(x, y, z) as publisher:        # coordinates of the grid; RIDGEWATCH_RING names the ring
        for step in range(steps):
            ...
            publisher.publish(step, time, u, v, w)   # arrays [z, y, x], float32 or float64, any strides

If RIDGEWATCH_RING is not set and no ring is named, nothing is published and `publish` returns False. If the ring cannot be opened, the same happens after a
RuntimeWarning, so that the simulation goes on. With strict=True this error raises RidgewatchError.
"""

from ._core import Publisher, RidgewatchError

__all__ = ["Publisher", "RidgewatchError"]
