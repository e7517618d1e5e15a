"""The policies that may drive a live session: which there are, and the one that drives now.

A policy runs in a process of its own, which is kept while the same one is asked for again, so that a person
who takes over can hand back at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from policy.agent import ChunkExecutor, ExecutionMode, PolicySpec, read_spec
from studio import evaluation
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


@dataclass(frozen=True, slots=True)
class Playing:
    """How a policy's chunks are played, see `ChunkExecutor`."""

    execution: ExecutionMode = "replan"
    replan_every: int | None = None

    @property
    def steps(self) -> int:
        """Of a chunk, until the next is asked for."""
        return ChunkExecutor(self.execution, self.replan_every, n_arms=1).replan_every


@dataclass(frozen=True, slots=True)
class Tried:
    """A way of playing chunks, and how often the policy succeeded with it in evaluations."""

    playing: Playing
    successes: int = 0
    trials: int = 0


def ways_to_play(run: str, data_dir: Path) -> list[Tried]:
    """What a run was evaluated with, the best by Wilson's lower bound first; then what is usual.

    Evaluations that hid something, or that took place in wider or narrower scenes, do not count.
    """
    spec = read_spec(folder_of(run, data_dir))
    usual = (
        Playing("replan", 10),
        Playing("replan", 20),
        Playing("replan", spec.chunk),
        Playing("ensemble", 1),
    )
    tally = {way: (0, 0) for way in usual if way.steps <= spec.chunk}
    for done in evaluation.load_all(data_dir):
        told = done.provenance
        if done.run == run and done.spread == 1 and "replan_every" in told and not told.get("hidden"):
            way = Playing(told["execution"], told["replan_every"])
            successes, trials = tally.get(way, (0, 0))
            tally[way] = successes + done.successes, trials + len(done.judged)
    found = [Tried(way, *counts) for way, counts in tally.items()]
    return sorted(found, key=lambda tried: -evaluation.wilson(tried.successes, tried.trials)[0])


class Pilot:
    """Belongs to the session's thread, which it never keeps waiting."""

    def __init__(self, data_dir: Path) -> None:
        self._data_dir = data_dir
        self._mind: Thinking | None = None
        self._agent: PolicyAgent | None = None
        self._playing = Playing()

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

    def agent(self, twin: Twin, run: str = "", playing: Playing | None = None) -> PolicyAgent:
        """What lets a run's newest policy drive `twin`, or without `run` the one that did last, as it did.

        Raises KeyError or ValueError with why it cannot.
        """
        playing = playing if run and playing else self._playing
        folder, task = folder_of(run or self.run, self._data_dir), twin.task
        spec = read_spec(folder)
        arms, cameras = [arm.name for arm in task.arms], [view.name for view in task.cameras]
        spec.check(task.name, arms, cameras, twin.config.stiffness_table)
        spec.check_replan(playing.replan_every)
        if self._mind is None or self._mind.spec != spec or self._mind.error:
            self.close()
            self._mind = Thinking(spec, partial(start, folder))
        self._playing = playing
        self._agent = PolicyAgent(self._mind, playing.execution, playing.replan_every, grippers=twin.grippers)
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
