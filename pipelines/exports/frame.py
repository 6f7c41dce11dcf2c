"""The one frame of everything that is exported, and how each file format turns it.

The world of `cameras.json`: right-handed, +Z up as far as the capture tells, in metres where
`metric`, else in a unit of its own. Every artifact of a job lies there, in one place. Formats
differ in their axes alone: glTF and USD have +Y up by custom, (x, y, z) -> (x, z, -y), the others
+Z, or +Y where asked for. No format scales or moves anything.

Light: the API reads options that name the axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

Axis = Literal["z", "y"]


@dataclass(frozen=True)
class Frame:
    """The axes of a file. up: which one is up. metric: whether a unit is a metre."""

    up: Axis = "z"
    metric: bool = False

    def of_world(self, vectors: Floats) -> Floats:
        """[N, 3] positions or directions of the world in these axes: a turn about X, if any."""
        import numpy as np

        if self.up == "z":
            return vectors
        turned: Floats = np.stack((vectors[:, 0], vectors[:, 2], -vectors[:, 1]), axis=1)
        return turned

    def to_world(self, vectors: Floats) -> Floats:
        """The inverse of `of_world`."""
        import numpy as np

        if self.up == "z":
            return vectors
        turned: Floats = np.stack((vectors[:, 0], -vectors[:, 2], vectors[:, 1]), axis=1)
        return turned

    def note(self) -> str:
        """One line for files that can hold one, ASCII."""
        unit = "1 unit is 1 metre" if self.metric else "the unit's length is unknown"
        return f"right-handed, +{self.up.upper()} up, the world of cameras.json; {unit}"
