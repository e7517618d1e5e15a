"""The policies that may drive a live session: which there are, and the one that drives now.

A policy runs in a process of its own, which is kept while the same one is asked for again, so that a person
who takes over can hand back at once.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from policy.agent import PolicySpec, read_spec
from studio.inputs.policy import PolicyAgent, Thinking
from studio.policy_link import start
from studio.twin import Twin


def folder_of(run: str, data_dir: Path) -> Path:
    """Of a run or checkpoint, by the name of a run in `data_dir` or by path."""
    for folder in (data_dir / "runs" / run, Path(run)):
        if run and folder.is_dir():
            return folder
    there = sorted(folder.name for folder in (data_dir / "runs").glob("*/"))
    raise KeyError(f"No run {run!r}; there are {there or 'none in ' + str(data_dir)}.")


def runs_of(task: str, data_dir: Path) -> list[str]:
    """Names of the runs that have learned a task, the newest first."""
    folders = sorted((data_dir / "runs").glob("*/"), key=lambda path: path.stat().st_mtime, reverse=True)
    return [folder.name for folder in folders if (spec := _spec_of(folder)) and spec.task == task]


class Pilot:
    """Belongs to the session's thread, which it never keeps waiting."""

    def __init__(self, data_dir: Path) -> None:
        self._data_dir = data_dir
        self._mind: Thinking | None = None
        self._agent: PolicyAgent | None = None

    @property
    def run(self) -> str:
        """The run whose policy was asked for last; empty before the first."""
        return self._mind.spec.run if self._mind else ""

    @property
    def error(self) -> str | None:
        """Why that policy drives no more."""
        return self._mind.error if self._mind else None

    @property
    def late(self) -> int:
        """Ticks for which it had no word since it took over, and its last target was held."""
        return self._agent.late if self._agent else 0

    @property
    def provenance(self) -> dict[str, Any]:
        """For the header of a take that it begins."""
        if self._mind is None or self._agent is None:
            return {}
        spec = self._mind.spec
        return {"run": spec.run, "step": spec.step, **self._agent.execution}

    def agent(self, run: str, twin: Twin) -> PolicyAgent:
        """What lets a run's newest policy drive `twin`. Raises KeyError or ValueError with why it cannot."""
        folder, task = folder_of(run, self._data_dir), twin.task
        spec = read_spec(folder)
        arms, cameras = [arm.name for arm in task.arms], [view.name for view in task.cameras]
        spec.check(task.name, arms, cameras, twin.config.stiffness_table)
        if self._mind is None or self._mind.spec != spec or self._mind.error:
            self.close()
            self._mind = Thinking(spec, partial(start, folder))
        self._agent = PolicyAgent(self._mind, grippers=twin.grippers)
        return self._agent

    def close(self) -> None:
        """End its process."""
        if self._mind:
            self._mind.close()
        self._mind = self._agent = None


def _spec_of(folder: Path) -> PolicySpec | None:
    """None where a run has no checkpoint that this version reads."""
    try:
        return read_spec(folder)
    except (OSError, ValueError):
        return None
