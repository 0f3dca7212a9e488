"""What a measuring system recorded, before anybody said which point is where on the robot."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

Points = Mapping[str, Float[np.ndarray, "F 3"]]


@dataclass(frozen=True)
class Recording:
    """F frames.

    time: (F,) s, or None. points: positions by their names, in the file's unit and frame, NaN where not seen. rotations: (F, 4)
    unit quaternions (x, y, z, w) of those that are rigid bodies. values: other columns by their names, as they stand. fibre:
    arc lengths (N,) m along an optical fibre and its strain (F, N). line: (F, M, 3), points of a centre line, in the file's unit
    and frame, NaN where a frame has fewer. units: of length, where the file says.
    """

    time: Float[np.ndarray, " F"] | None
    points: Points = field(default_factory=dict)
    rotations: Mapping[str, Float[np.ndarray, "F 4"]] = field(default_factory=dict)
    values: Mapping[str, Float[np.ndarray, " F"]] = field(default_factory=dict)
    fibre: tuple[Float[np.ndarray, " N"], Float[np.ndarray, "F N"]] | None = None
    units: str | None = None
    line: Float[np.ndarray, "F M 3"] | None = None

    @property
    def frames(self) -> int:
        """F."""
        if self.fibre is not None:
            return len(self.fibre[1])
        if self.line is not None:
            return len(self.line)
        return max((len(v) for of in (self.points, self.rotations, self.values) for v in of.values()), default=0)
