"""Two-armed insertion of a round peg: 30 mm across, into a hole 2 mm wider."""

from __future__ import annotations

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
from studio.parts import add_round_hole, add_round_peg


class Task(Insertion):
    name = "peg-cylinder"
    instruction = "Insert the round peg in the right hand into the hole in the left hand."

    def add_peg(self, body: mujoco.MjsBody) -> None:
        add_round_peg(body, PEG_HALF, PEG_LENGTH, CHAMFER, PEG_RGBA)

    def add_hole(self, body: mujoco.MjsBody) -> None:
        add_round_hole(body, HOLE_HALF, HOLE_DEPTH, OUTER, HOLE_RGBA)
