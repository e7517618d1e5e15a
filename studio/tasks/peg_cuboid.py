"""Two-armed insertion of a square peg: 30 mm wide, into a hole 2 mm wider, the corners in line."""

from __future__ import annotations

import math

import mujoco

from studio.insertion import (
    CHAMFER,
    HOLE_DEPTH,
    HOLE_HALF,
    HOLE_RGBA,
    OUTER,
    PEG_HALF,
    PEG_LENGTH,
    PEG_RGBA,
    Insertion,
)
from studio.parts import add_square_hole, add_square_peg


class Task(Insertion):
    name = "peg-cuboid"
    instruction = "Insert the square peg in the right hand into the hole in the left hand."
    turn = math.radians(4.0)
    wiggle = math.radians(4.0)

    def add_peg(self, body: mujoco.MjsBody) -> None:
        add_square_peg(body, PEG_HALF, PEG_LENGTH, CHAMFER, PEG_RGBA)

    def add_hole(self, body: mujoco.MjsBody) -> None:
        add_square_hole(body, HOLE_HALF, HOLE_DEPTH, OUTER, HOLE_RGBA)
