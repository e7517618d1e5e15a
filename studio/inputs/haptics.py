"""What a hand should feel of a contact: the force as the strength of a vibration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

PULSE = 0.1  # [s] of one pulse. They overlap at 20 Hz and more, and silence follows soon where they stop.
STALE = 0.1  # [s] a force older than this is felt no more


@dataclass(frozen=True, slots=True)
class Haptics:
    """Nothing below the dead band, all of `strength` from `full` on, a straight line between."""

    dead_band: float = 3.0  # [N]
    full: float = 50.0  # [N]
    strength: float = 1.0  # 0 off .. 1

    def __post_init__(self) -> None:
        if not 0.0 <= self.dead_band < self.full <= 1000.0:
            raise ValueError(
                f"Vibration from {self.dead_band} N up to {self.full} N is not possible; "
                "it needs 0 <= dead band < full <= 1000 N."
            )
        if not 0.0 <= self.strength <= 1.0:
            raise ValueError(f"A strength of {self.strength} is not possible; it goes from 0 to 1.")

    def amplitude(self, force: Sequence[float]) -> float:
        """0 .. 1 for a contact force (3,) [N] with weight and tare removed."""
        newtons = math.hypot(*force)
        share = (newtons - self.dead_band) / (self.full - self.dead_band)
        return self.strength * min(max(share, 0.0), 1.0)
