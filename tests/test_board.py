"""Laws of ink: who sees which cell, what rubbing takes away."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.types import Array, quaternion_from_rotation_vector, rotation_of
from studio.board import CELL, CELLS, HALF, MIN_WIPE_FORCE, Board

FLAT = np.eye(3)
FELT = np.array([0.015, 0.02])  # [m] half sides


def inked(level: int = 255) -> Board:
    board = Board()
    board.grid[:] = level
    return board


def rub(board: Board, millimetres: float = 10.0, force: float = 3.0, at: Array | None = None) -> None:
    board.wipe(np.zeros(3) if at is None else at, FLAT, FELT, 0.0, millimetres / 1000, force)


def test_a_line_inks_the_cells_within_its_radius() -> None:
    board = Board()
    board.draw(np.array([[-0.05, 0.02], [0.05, 0.02]]), radius=0.004)
    i, j = np.nonzero(board.grid)
    x, y = (np.stack((i, j)) + 0.5) * CELL - HALF
    assert np.abs(y - 0.02).max() <= 0.004
    assert (x.min(), x.max()) == pytest.approx((-0.054, 0.054), abs=2 * CELL)
    assert board.inked() * CELL**2 == pytest.approx(0.1 * 0.008 + np.pi * 0.004**2, rel=0.05)  # its area


def test_the_picture_has_x_to_the_right_and_y_upwards() -> None:
    board = Board()
    board.draw(np.array([[0.1, 0.05], [0.1, 0.05]]), radius=0.005)
    row, column = np.argwhere(board.picture().sum(axis=2) < 400).mean(axis=0)
    assert column == pytest.approx((0.1 + HALF) / CELL, abs=1)
    assert row == pytest.approx((HALF - 0.05) / CELL, abs=1)


@settings(deadline=None)
@given(
    st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3),
    st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3),
    st.floats(0.0, 0.01),
    st.floats(0.0, 100.0),
)
def test_wiping_never_adds_ink_and_stays_on_the_board(
    at: list[float], turn: list[float], rubbed: float, force: float
) -> None:
    board = inked(200)
    axes = rotation_of(quaternion_from_rotation_vector(np.array(turn)))
    board.wipe(np.array(at), axes, FELT, 0.0, rubbed, force)
    assert board.grid.max() <= 200


@pytest.mark.parametrize("parts", [1, 2, 7, 100])
def test_wiping_takes_as_much_in_many_small_strokes_as_in_one(parts: int) -> None:
    # Rounding each of 100 strokes down to whole levels would leave all of the ink.
    board = inked()
    for _ in range(parts):
        rub(board, millimetres=5.0 / parts, force=3.0)
    assert board.grid[CELLS // 2, CELLS // 2] == pytest.approx(255 - 90, abs=1)


def test_wiping_reaches_only_under_the_felt() -> None:
    board = inked()
    rub(board)
    i, j = np.nonzero(board.grid < 255)
    x, y = np.abs((np.stack((i, j)) + 0.5) * CELL - HALF).max(axis=1)
    assert x <= FELT[0]
    assert y <= FELT[1]
    assert len(i) * CELL**2 == pytest.approx(4 * FELT.prod(), rel=0.05)


def test_too_light_a_touch_wipes_nothing() -> None:
    board = inked()
    rub(board, force=0.9 * MIN_WIPE_FORCE)
    assert board.grid.min() == 255


def test_resting_wipes_nothing() -> None:
    board = inked()
    rub(board, millimetres=0.0, force=20.0)
    assert board.grid.min() == 255


@pytest.mark.parametrize("degrees", [2.0, 5.0, 15.0])
def test_a_tilted_felt_wipes_only_along_its_lower_edge(degrees: float) -> None:
    flat, tilted = inked(), inked()
    rub(flat)
    axes = rotation_of(quaternion_from_rotation_vector(np.array([np.radians(degrees), 0.0, 0.0])))
    lower_edge_on_board = np.array([0.0, 0.0, FELT[1] * np.sin(np.radians(degrees))])
    tilted.wipe(lower_edge_on_board, axes, FELT, 0.0, 0.01, 3.0)
    wiped = np.nonzero(tilted.grid < 255)[1]
    assert 0 < len(wiped) < 0.5 * np.count_nonzero(flat.grid < 255)
    assert ((wiped + 0.5) * CELL - HALF).max() < 0.0  # at the side that is down


def test_a_board_reads_back_its_state() -> None:
    board, other = inked(), Board()
    rub(board, millimetres=0.123)
    other.restore(board.state())
    for one in (board, other):
        rub(one, millimetres=0.456)
    np.testing.assert_array_equal(other.grid, board.grid)
    assert other.state()["ink_carry"] == board.state()["ink_carry"]
