"""The one frame of everything that is exported, and how each file format turns it.

The world of `cameras.json`: right-handed, +Z up as far as the capture tells, in metres where
`metric`, else in a unit of its own. Every artifact of a job lies there, in one place, unless
another frame is asked for (`pipelines.exports.placement`). Formats differ in their axes alone: glTF
and USD have +Y up by their specifications, OBJ by custom, (x, y, z) -> (x, z, -y), the others +Z,
unless asked for otherwise. No format moves anything, and none scales but STL of a mesh in metres,
which is in millimetres unless asked for otherwise (`MeshOptions.stl_unit`).

A file in another frame also says how the world of `cameras.json` came into its own coordinates,
axes and all: `Frame.matrix`, in formats that can hold it.

Light: the API reads options that name the axes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

Axis = Literal["z", "y"]
FrameName = Literal["gravity", "source", "normalised"]
Rows = tuple[tuple[float, ...], ...]

WORLDS: dict[FrameName, str] = {
    "gravity": "the world of cameras.json",
    "source": "the world of the capture's own poses",
    "normalised": "the world of cameras.json moved and scaled: cameras within 1 of the origin",
}
"""What files say of where they lie."""
FROM_WORLD = "from_world"
"""What files call their matrix."""
_UPRIGHT = 0.99
_FAR = 200.0
"""Extents from the origin, where a float32 is off by a hundred-thousandth of the extent."""


@dataclass(frozen=True)
class Frame:
    """Where a file lies. up: "y" turns what is up there to +Y, "z" leaves the axes as they are.

    metric: whether a unit is a metre. world: its name. from_world: [3, 4], there from the world of
    cameras.json; None where it is that world.
    """

    up: Axis = "z"
    metric: bool = False
    world: str = WORLDS["gravity"]
    from_world: Rows | None = None

    def y_up(self) -> Frame:
        """The same in a format that has +Y up."""
        return replace(self, up="y")

    def of_world(self, vectors: Floats) -> Floats:
        """[N, 3] positions or directions of the frame in the file's axes."""
        turn = self._turn()
        return vectors if turn is None else _turned(vectors, turn)

    def to_world(self, vectors: Floats) -> Floats:
        """The inverse of `of_world`."""
        turn = self._turn()
        return vectors if turn is None else _turned(vectors, turn.T)

    def matrix(self) -> Floats | None:
        """[3, 4] from the world of cameras.json to coordinates of the file; None for that world."""
        import numpy as np

        if self.from_world is None:
            return None
        return self.of_world(np.asarray(self.from_world, np.float64).T).T

    def note(self) -> str:
        """One line for files that can hold one, ASCII."""
        unit = "1 unit is 1 metre" if self.metric else "the unit's length is unknown"
        if self.up == "z" and not self.is_upright():
            return f"right-handed, {self.world}; {unit}"
        return f"right-handed, +{self.up.upper()} up, {self.world}; {unit}"

    def lines(self) -> list[str]:
        """The note, and the matrix where there is one, row by row, for formats that hold text."""
        matrix = self.matrix()
        if matrix is None:
            return [self.note()]
        numbers = " ".join(repr(float(value)) for value in matrix.reshape(-1))
        return [self.note(), f"{FROM_WORLD} {numbers}"]

    def is_upright(self) -> bool:
        """Whether +Z is up in the frame, as far as it is in the world of cameras.json."""
        return bool(self._upwards()[2] > _UPRIGHT)

    def _upwards(self) -> Floats:
        """[3] unit, what +Z of the world of cameras.json is in the frame."""
        import numpy as np

        if self.from_world is None:
            return np.array([0.0, 0.0, 1.0])
        up = np.asarray(self.from_world, np.float64)[:, 2]
        unit: Floats = up / np.linalg.norm(up)
        return unit

    def _turn(self) -> Floats | None:
        """[3, 3] from the frame's axes to the file's: what is nearest to up there to +Y."""
        import numpy as np

        if self.up == "z":
            return None
        upwards, target = self._upwards(), np.array([0.0, 1.0, 0.0])
        nearest = int(np.abs(upwards).argmax())
        up = np.zeros(3)
        up[nearest] = np.sign(upwards[nearest])
        if up[1] > 0:
            return None
        if up[1] < 0:
            return np.diag([1.0, -1.0, -1.0])
        # A quarter turn about their cross product, which stays where it is.
        axis = np.cross(up, target)
        turn: Floats = np.outer(target, up) - np.outer(up, target) + np.outer(axis, axis)
        return turn


def _turned(vectors: Floats, turn: Floats) -> Floats:
    """[N, 3] by a turn that only swaps axes and their signs: exactly."""
    import numpy as np

    source = np.abs(turn).argmax(axis=1)
    signs = turn[np.arange(3), source]
    turned: Floats = np.stack(
        [vectors[:, s] * sign for s, sign in zip(source, signs, strict=True)], 1
    )
    return turned


def is_far(points: Floats) -> bool:
    """Whether 32 bits would blur [N, 3] positions, as those in map coordinates: N may be 0."""
    import numpy as np

    if len(points) == 0:
        return False
    extent = float(np.ptp(points, axis=0).max())
    return float(np.abs(points).max()) > _FAR * extent > 0.0


def matrix_of(line: str) -> Floats | None:
    """[3, 4], what one of `Frame.lines` tells; None where it is no such line."""
    import numpy as np

    words = line.split()
    if len(words) != 13 or words[0] != FROM_WORLD:
        return None
    try:
        return np.asarray([float(word) for word in words[1:]], np.float64).reshape(3, 4)
    except ValueError:
        return None


def back_to_world(points: NDArray[np.floating[Any]], matrix: Floats | None) -> Floats:
    """[P, 3] points of a file in the world of cameras.json. matrix: the file's own, if any."""
    import numpy as np

    world: Floats = points.astype(np.float64)
    if matrix is not None:
        world = (world - matrix[:, 3]) @ np.linalg.inv(matrix[:, :3]).T
    return world
