from collections.abc import Sequence
from os import PathLike
from types import TracebackType
from typing import Literal, Self, final

import numpy as np
import numpy.typing as npt

__all__ = ["Publisher", "RidgewatchError"]

_Field = npt.NDArray[np.float32] | npt.NDArray[np.float64]

class RidgewatchError(Exception):
    """The ring could not be opened, or a step was refused; raised only with strict=True."""

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
        """Opens a ring for the global grid of these coordinates (ascending, evenly spaced or not).

        ring: folder of the ring; by default RIDGEWATCH_RING. If that is not set, nothing is published.
        periods: period of each axis; None: not periodic.
        radius: makes x and y longitude and latitude in degrees on a sphere of this radius.
        block: (index, count, offset, extent) of this process's block, in nodes along x, y, z.
        start: a number that all blocks of one start of the simulation share, and the next start does not
        (comm.bcast(time.time_ns()) with mpi4py); 0: none.
        slots: number of steps that the ring holds. wait_ms: longest wait for ridgewatch; 0: never wait.
        time_unit: unit of the times, for display.
        order: order of the arrays' axes: "zyx" is [z, y, x], "xyz" is [x, y, z].
        strict: raises RidgewatchError if the ring cannot be opened (in use, no room, another user's folder, an invalid grid) or a step's
        time is not finite. Otherwise each of these errors is a RuntimeWarning: without a ring nothing is published, and the step is
        skipped. Arguments of a wrong shape or type always raise ValueError or TypeError.
        """

    def publish(self, step: int, time: float, u: _Field, v: _Field, w: _Field | None = None) -> bool:
        """Copies a step into the ring; False if publishing is off or the step was refused. The arrays share shape, dtype and strides.

        Arrays of the other byte order (from NetCDF or FITS files) and masked arrays are converted first, which allocates memory; masked values
        arrive as NaN, which is missing velocity. If the ring's file was removed, each step is refused: close the publisher and open another.
        Several threads may publish at once, and other Python threads run meanwhile; none of them may write to the arrays.
        """

    def close(self) -> None:
        """Ends the ring, after other threads have finished publishing."""

    @property
    def is_open(self) -> bool: ...
    @property
    def published(self) -> int: ...
    @property
    def overwrote(self) -> int:
        """Number of steps that overwrote one that no follower had taken."""

    def __enter__(self) -> Self: ...
    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None: ...
