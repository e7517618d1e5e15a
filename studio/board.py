"""A whiteboard whose ink is one uint8 grid: cameras, page and metrics all read the same cells."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import mujoco
import numpy as np

from controller.types import Array

CELLS = 256
CELL = 0.0011  # [m] side of a cell; the board is 28 cm square
HALF = CELLS * CELL / 2  # [m]
THICKNESS = 0.02  # [m]
INKED = 64  # a cell above this level counts as inked, of 255

# Ink taken away per newton of pressing and millimetre of rubbing, in levels. At the 3 N of a normal wipe a
# cell loses 18 levels per mm, so a 30 mm felt clears it twice over; below 1 N one pass is not enough.
WIPE_RATE = 6.0
MIN_WIPE_FORCE = 0.5  # [N]
FELT_REACH = 0.0005  # [m] felt fibres reach this far below the felt's plane

_PAPER = np.array([236, 238, 240], np.float32)
_INK = np.array([24, 38, 84], np.float32)
_SHARES = (np.arange(256)[:, None] / np.float32(255)).astype(np.float32)
_COLORS = (_PAPER + (_INK - _PAPER) * _SHARES).astype(np.uint8)  # (256, 3) of each level


class Board:
    """The grid lies in board axes: cell [i, j] is centred at x = (i + .5) CELL - HALF, y likewise from j."""

    TEXTURE = "ink"

    def __init__(self) -> None:
        self.grid = np.zeros((CELLS, CELLS), np.uint8)
        self._carry = 0.0  # levels below one, kept for the next wipe
        centers = (np.arange(CELLS) + 0.5) * CELL - HALF
        self._x, self._y = np.meshgrid(centers, centers, indexing="ij")

    @staticmethod
    def build(spec: mujoco.MjSpec, position: Array) -> None:
        """Add body `board` with its top face at `position`, and a painted skin that does not collide."""
        texture = spec.add_texture(
            name=Board.TEXTURE,
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            width=CELLS,
            height=CELLS,
            nchannel=3,
        )
        texture.data = np.full((CELLS, CELLS, 3), 238, np.uint8).tobytes()
        material = spec.add_material(name="board_skin", specular=0.0)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = Board.TEXTURE
        body = spec.worldbody.add_body(name="board", pos=position)
        body.add_geom(
            name="board",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=(HALF + 0.01, HALF + 0.01, THICKNESS / 2),
            pos=(0, 0, -THICKNESS / 2),
            rgba=(0.72, 0.74, 0.76, 1),
        )
        body.add_geom(
            name="board_skin",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=(HALF, HALF, 0.01),
            pos=(0, 0, 0.0002),  # above the board's face, against z-fighting
            material="board_skin",
            contype=0,
            conaffinity=0,
            group=2,
        )

    def clear(self) -> None:
        self.grid[:] = 0
        self._carry = 0.0

    def draw(self, points: Array, radius: float) -> None:
        """Ink the polyline `points` (n, 2) [m] in board axes with a round nib of `radius` [m]."""
        for start, end in itertools.pairwise(points):
            window, distance = self._near_segment(start, end, radius)
            self.grid[window][distance <= radius] = 255

    def stroke(self, start: Array, end: Array, radius: float) -> None:
        """Ink the line between two points (2,) [m]; its soft edge shows widths below a cell."""
        window, distance = self._near_segment(start, end, radius + CELL)
        level = 255 * np.clip((radius - distance) / CELL + 0.5, 0.0, 1.0)
        cells = self.grid[window]
        np.maximum(cells, level.astype(np.uint8), out=cells)

    def wipe(self, center: Array, axes: Array, half: Array, height: float, rub: float, force: float) -> None:
        """Rub with a flat rectangular felt.

        `center` (3,) [m] of the felt's face in board axes, `axes` (3, 3) its rotation, `half` (2,) [m] its
        half sides, `height` [m] of the board's face, `rub` [m] travelled, `force` [N] normal.
        Where a tilted felt does not reach the board, nothing is wiped.
        """
        if force < MIN_WIPE_FORCE:
            return
        level = self._carry + WIPE_RATE * force * rub * 1000.0
        whole = int(level)
        self._carry = level - whole
        if whole == 0:
            return
        reach = float(np.hypot(*half)) + CELL
        window = self._window(center[:2] - reach, center[:2] + reach)
        dx, dy = self._x[window] - center[0], self._y[window] - center[1]
        along_x = dx * axes[0, 0] + dy * axes[1, 0]
        along_y = dx * axes[0, 1] + dy * axes[1, 1]
        felt_height = center[2] - (dx * axes[0, 2] + dy * axes[1, 2]) / axes[2, 2]
        rubbed = (
            (np.abs(along_x) <= half[0]) & (np.abs(along_y) <= half[1]) & (felt_height <= height + FELT_REACH)
        )
        cells = self.grid[window]
        cells[rubbed] -= np.minimum(cells[rubbed], min(whole, 255)).astype(np.uint8)

    def inked(self) -> int:
        """Number of inked cells."""
        return int(np.count_nonzero(self.grid > INKED))

    def picture(self) -> Array:
        """(256, 256, 3) uint8 as a texture: columns run along +x, the top row is +y."""
        return _COLORS.take(self.grid.T[::-1], axis=0)

    def state(self) -> dict[str, Array]:
        return {"ink": self.grid.copy(), "ink_carry": np.array([self._carry])}

    def restore(self, state: Mapping[str, Array]) -> None:
        self.grid[:] = state["ink"]
        self._carry = float(state["ink_carry"][0])

    def _near_segment(self, start: Array, end: Array, reach: float) -> tuple[tuple[slice, slice], Array]:
        """A window with all cells within `reach` [m] of a line, and their distances [m] from it."""
        window = self._window(np.minimum(start, end) - reach, np.maximum(start, end) + reach)
        direction = end - start
        length_squared = float(direction @ direction)
        dx, dy = self._x[window] - start[0], self._y[window] - start[1]
        along = np.clip((dx * direction[0] + dy * direction[1]) / max(length_squared, 1e-12), 0.0, 1.0)
        return window, np.hypot(dx - along * direction[0], dy - along * direction[1])

    @staticmethod
    def _window(low: Array, high: Array) -> tuple[slice, slice]:
        first = np.clip(np.floor((low + HALF) / CELL), 0, CELLS).astype(int)
        last = np.clip(np.ceil((high + HALF) / CELL), 0, CELLS).astype(int)
        return slice(first[0], last[0]), slice(first[1], last[1])
