"""What a take comes to, summed up while it is written, so that the catalogue need not read all of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, assert_never

import msgspec
import numpy as np

from controller.stiffness import StiffnessTable, nearest_mode
from controller.types import Action, Array, CartesianTarget, Hold, JointTarget, Release

CONTACT = 1.0  # [N] a larger force counts as contact
JOINT_CONTROL = "joint control"  # in place of a stiffness mode
METADATA = "comp-act studio totals"  # name of the MCAP metadata record


@dataclass(frozen=True, slots=True)
class Totals:
    """Of a finished take."""

    duration: float  # [s] from the first state to the last
    peak_force: float  # [N] largest norm over all arms
    mean_force: float  # [N] mean norm over the samples in contact, 0 without any
    cameras: tuple[str, ...]  # of the header, and any other that sent an image
    success: bool | None  # None: nobody judged
    progress: float | None  # 0..1, None where the task does not measure it
    recovered: bool = False  # put together again after a crash
    stiffness_share: dict[str, float] = field(default_factory=dict)  # of the time, see `StiffnessTally`

    def to_entries(self) -> dict[str, str]:
        """For an MCAP metadata record."""
        return {"totals": msgspec.json.encode(self).decode()}

    @staticmethod
    def from_entries(entries: dict[str, str]) -> Totals | None:
        """None for a record of another version."""
        try:
            return msgspec.json.decode(entries["totals"], type=Totals)
        except (KeyError, msgspec.DecodeError):
            return None


class ForceTally:
    """Adds up forces as they come."""

    def __init__(self) -> None:
        self.peak = 0.0  # [N]
        self._sum, self._count = 0.0, 0

    @property
    def mean(self) -> float:
        """[N] over the samples in contact, 0 without any."""
        return self._sum / self._count if self._count else 0.0

    def add(self, forces: Array) -> None:
        """Add (..., 3) [N]; a dead sensor sends NaN, which counts as no contact."""
        norms = np.sqrt((forces * forces).sum(axis=-1))
        norms = norms[np.isfinite(norms)]
        in_contact = norms[norms > CONTACT]
        self._sum += float(in_contact.sum())
        self._count += in_contact.size
        self.peak = float(norms.max(initial=self.peak))


class StiffnessTally:
    """Counts the ticks of each stiffness mode as they come, over all arms."""

    def __init__(self, control: Mapping[str, Any]) -> None:
        """`control` is that of the take's header: it tells what the modes mean."""
        self._table: StiffnessTable = control.get("servo", {}).get("stiffness_table", "tuned")
        self._modes: dict[int, str] = {}  # of each arm now
        self._ticks: Counter[str] = Counter()

    @property
    def shares(self) -> dict[str, float]:
        """Of the time under each mode, and under JOINT_CONTROL; empty where no arm was ever told to move."""
        total = self._ticks.total()
        return {mode: round(n / total, 4) for mode, n in self._ticks.most_common()}

    def add(self, applied: Action) -> None:
        for arm, action in enumerate(applied.arms):
            match action.target:
                case CartesianTarget(stiffness=stiffness):
                    self._modes[arm] = nearest_mode(stiffness, self._table).value
                case JointTarget():
                    self._modes[arm] = JOINT_CONTROL
                case Hold() | Release():
                    pass  # stays as stiff as it was
                case unknown:
                    assert_never(unknown)
        self._ticks.update(self._modes.values())
