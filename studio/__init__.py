"""Comp-ACT Studio: teleoperation, datasets, training and evaluation for contact-rich manipulation.

from studio import Studio

with Studio("data") as studio:
studio.demo("wiping", episodes=3, seed=7)
"""

import os
from typing import Any

# The session's process never draws: cameras have a process of their own (`studio.cameras`), so that a missing
# or crashing OpenGL costs the images only. MuJoCo reads this once, at its first import.
os.environ.setdefault("MUJOCO_GL", "disable")

__all__ = ["Studio"]


def __getattr__(name: str) -> Any:
    """Import the API when it is first asked for: the camera process and the doctor do without it."""
    if name == "Studio":
        from studio.api import Studio

        return Studio
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
