"""A data folder of made-up takes, for tests of exports."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

from controller.types import Action, ArmAction, Target
from studio.benchmarks.episodes import made_up_header, made_up_steps
from studio.episode import Header, Outcome
from studio.episode_writer import EpisodeWriter
from studio.session import CONTROL_PERIOD


def record(
    data: Path,
    seconds: float = 1.0,
    success: bool | None = True,
    action: Target | None = None,
    **header: object,
) -> str:
    """Write a take with textured images, of random actions or of one; return its id."""
    arms, cameras = header.pop("arms", ("right",)), header.pop("cameras", ("front", "wrist"))
    made: Header = dataclasses.replace(made_up_header(arms, cameras), **header)  # type: ignore[arg-type]
    writer = EpisodeWriter(data / "episodes" / made.task / f"{made.episode_id}.mcap", made)
    for step in made_up_steps(round(seconds / CONTROL_PERIOD), made):
        if action is not None:
            told = Action(tuple(ArmAction(action, 0.5) for _ in arms))
            step = dataclasses.replace(step, applied=dataclasses.replace(step.applied, action=told))
        writer.add(step, time.time())
    writer.finish(Outcome(success, "made up"))
    return made.episode_id


def names(folder: Path) -> Sequence[str]:
    """Of all files below a folder, hidden ones too."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
