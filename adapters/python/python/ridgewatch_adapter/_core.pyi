from collections.abc import Sequence
from os import PathLike
from types import TracebackType
from typing import Literal, Self, final

import numpy as np
import numpy.typing as npt

__all__ = ["Publisher", "RidgewatchError"]

_Field = npt.NDArray[np.float32] | npt.NDArray[np.float64]

class RidgewatchError(Exception):
    """The ring could not be opened, or a step was refused; raised with strict=True only."""

@final
class Publisher:
    def __new__(
        cls,
        x: npt.ArrayLike,
        y: npt.ArrayLike,
        z: npt.ArrayLike | None = None,
        *,
        ring: str | PathLike[str] | None = None,
        periods: Sequence[float | None] | None = None,
        radius: float | None = None,
        block: tuple[int, int, Sequence[int], Sequence[int]] | None = None,
        start: int = 0,
        slots: int = 4,
        wait_ms: int = 0,
        time_unit: str = "s",
        order: Literal["zyx", "xyz"] = "zyx",
        strict: bool = False,
    ) -> Self:
        """Opens a ring for the global grid of these coordinates (ascending; uneven ones are welcome).

        ring: its folder; without it that of RIDGEWATCH_RING, and nothing is published where that is not set.
        periods: length after which each axis repeats, None where it does not.
        radius: x and y are longitude and latitude in degrees on a sphere of this radius.
        block: (index, count, offset, extent) of this process's part, nodes along x, y, z.
        start: a number that all blocks of one start of the simulation name, and those of the next do not
        (comm.bcast(time.time_ns()) with mpi4py); 0: none.
        slots: steps that the ring holds. wait_ms: how long to wait for ridgewatch; 0: never.
        order: of the arrays' axes: "zyx" is [z, y, x], "xyz" is [x, y, z].
        strict: a ring that cannot be had (in use, no room, another user's folder, a grid that cannot be) raises RidgewatchError, and so
        does a step with a time that is not finite. Otherwise each of them is a RuntimeWarning and the program goes on: without a ring
        nothing is published, and such a step is left out. Arguments of a wrong shape or type raise ValueError or TypeError in any case.
        """

    def publish(self, step: int, time: float, u: _Field, v: _Field, w: _Field | None = None) -> bool:
        """Copies a step into the ring; False where publishing is off or the step was refused. The arrays have one shape, dtype and strides.

        Threads may publish at once, and other threads of Python run meanwhile: let none of them write into the arrays.
        """

    def close(self) -> None:
        """Ends the ring, after what other threads are publishing."""

    @property
    def is_open(self) -> bool: ...
    @property
    def published(self) -> int: ...
    @property
    def overwrote(self) -> int:
        """Steps that overwrote one that ridgewatch had not taken."""

    def __enter__(self) -> Self: ...
    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None: ...
