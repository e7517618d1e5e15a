"""Rolling out one agent over many seeds: does it succeed, how hard does it press, how stiff is it?

Time is the simulator's. A rollout ends when the agent is finished, when success has held for half a second,
or when the task's time is up. One that raises is an error and counts neither as success nor as failure.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from dataclasses import dataclass, field
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import numpy as np

from controller.servo import ServoConfig
from controller.stiffness import StiffnessTable
from controller.types import ARM_ROW, Action, Array, CartesianTarget, Observation, Step
from policy import checkpoint
from policy.agent import ChunkExecutor, ExecutionMode, PolicySpec, load_policy, read_spec
from studio import tasks
from studio.evaluation import Curves, Evaluation, Rollout
from studio.inputs.policy import Immediate, PolicyAgent
from studio.pilot import folder_of
from studio.policy_link import connect_to, is_address
from studio.recorder import new_episode_id, versions
from studio.references import REFERENCES
from studio.session import CONTROL_PERIOD, Agent
from studio.station import CONTACT, Station, Take
from studio.tasks import HELD_SUCCESS
from studio.training import EVALUATION
from studio.twin import Twin

_MakeAgent = Callable[[Twin], Agent]

CURVE_EVERY = 5  # ticks between two points of a curve: 20 Hz


Hidden = Literal["images", "objects", "wrench"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What is evaluated. Two plans of the same task, seeds and spread meet the same scenes."""

    agent: str  # one of `REFERENCES`, a run's or checkpoint's folder, or ws://HOST:PORT of a policy server
    task: str
    seeds: tuple[int, ...]
    spec: PolicySpec | None = None  # of a policy
    # What a policy is not shown: its images or wrenches (their training mean instead), or in the images the
    # painted marks and the objects that no hand holds at the start.
    hide: tuple[Hidden, ...] = ()
    execution: ExecutionMode = "replan"
    replan_every: int | None = None  # steps of a chunk, see `ChunkExecutor`
    latency: float = 0.02  # [s] between a question and its answer, in simulated time
    device: str = "cpu"
    spread: float = 1.0
    # What the stiffness modes mean and the controller is set up for; of a policy always as it learned.
    stiffness_table: StiffnessTable | None = None
    cameras: bool = False  # record images although the agent needs none

    def __post_init__(self) -> None:
        if not self.seeds or len(set(self.seeds)) != len(self.seeds) or min(self.seeds) < 0:
            raise ValueError(f"An evaluation needs different seeds from 0 on, not {list(self.seeds)}.")
        task = tasks.load(self.task)  # an unknown one is refused
        if self.spec is None:
            if self.agent not in REFERENCES:
                raise KeyError(f"No agent {self.agent!r}; there are {sorted(REFERENCES)}.")
            if self.hide:
                raise ValueError(f"Nothing can be hidden from {self.agent!r}: it is no policy.")
            return
        arms, cameras = [arm.name for arm in task.arms], [view.name for view in task.cameras]
        self.spec.check(self.task, arms, cameras, self.stiffness_table)
        ChunkExecutor(self.execution, self.replan_every, n_arms=len(task.arms))  # refuses what it cannot do
        self.spec.check_replan(self.replan_every)
        if is_address(self.agent) and {"images", "wrench"} & set(self.hide):
            raise ValueError("Hide images or wrenches where the policy runs: studio policy-server … --hide.")

    @staticmethod
    def of(agent: str, task: str | None, seeds: Sequence[int], data_dir: Path, **settings: Any) -> Plan:
        """For a reference, a policy server, a folder, or the name of a run in `data_dir`.

        A policy's task need not be told. `settings` are further fields.
        """
        spec, wanted = None, agent
        if agent not in REFERENCES:
            if is_address(agent):
                with closing(connect_to(agent)) as policy:
                    spec = policy.spec
            else:
                wanted = str(_checkpoint_of(agent, data_dir))
                spec = read_spec(Path(wanted))
        if task is None and spec is None:
            raise ValueError(f"Tell the task that {agent!r} shall do; there are {tasks.names()}.")
        return Plan(
            agent=wanted, task=task or (spec.task if spec else ""), seeds=tuple(seeds), spec=spec, **settings
        )

    @property
    def run(self) -> str:
        """The agent's name."""
        return self.spec.run if self.spec else self.agent

    @property
    def provenance(self) -> dict[str, Any]:
        """What a rollout's header tells of its agent."""
        if self.spec is None:
            return {"run": self.run, "stiffness_table": self.table}
        executor = ChunkExecutor(self.execution, self.replan_every, n_arms=len(self.spec.arms))
        return {
            "run": self.run,
            "step": self.spec.step,
            "execution": self.execution,
            "replan_every": executor.replan_every,
            "hidden": list(self.hide),
            "latency_s": self.latency,
            "stiffness_table": self.table,
        }

    @property
    def table(self) -> StiffnessTable:
        """What the controller is set up for: as the policy learned; for a reference as asked, or tuned."""
        return self.spec.stiffness_table if self.spec else self.stiffness_table or "tuned"

    @property
    def sees(self) -> bool:
        """Whether the agent needs images."""
        return self.spec is not None and bool(self.spec.cameras)

    def station(self, data_dir: Path) -> Station:
        """Where the agent is rolled out."""
        return Station(
            self.task,
            data_dir,
            cameras=self.cameras or self.sees,
            hide_objects="objects" in self.hide,
            config=ServoConfig.for_table(self.table),
        )

    def opened(self) -> Callable[[Twin], Agent]:
        """What makes an agent for a twin that has just been reset. Loads a policy, so once per process."""
        if self.spec is None:
            return REFERENCES[self.agent]
        policy = (
            connect_to(self.agent)
            if is_address(self.agent)
            else load_policy(
                Path(self.agent),
                device=self.device,
                hide_images="images" in self.hide,
                hide_wrench="wrench" in self.hide,
            )
        )
        mind = Immediate(policy, self.latency)
        return lambda twin: PolicyAgent(
            mind, self.execution, self.replan_every, seed=twin.seed, grippers=twin.grippers
        )


def _checkpoint_of(agent: str, data_dir: Path) -> Path:
    """The very checkpoint: training may go on meanwhile."""
    try:
        return checkpoint.find(folder_of(agent, data_dir))
    except KeyError as error:
        raise KeyError(f"{error.args[0]} References are {sorted(REFERENCES)}.") from None


@dataclass(slots=True)
class Feel:
    """Subscriber: what each arm feels and how stiff it is, tick by tick."""

    force: list[Array] = field(default_factory=list)  # (arms,) [N] at the tick's beginning
    stiffness: list[list[float]] = field(default_factory=list)  # (arms,) [N/m] mean; NaN under joint control
    peak: float = 0.0  # [N] over all fast steps

    def on_step(self, step: Step) -> None:
        force = np.linalg.norm(step.applied.trace[:, :, ARM_ROW["wrench"]][..., :3], axis=-1)
        self.force.append(force[:, 0])
        self.peak = max(self.peak, float(force.max()))
        self.stiffness.append(
            [
                float(arm.target.stiffness.translational.trace()) / 3
                if isinstance(arm.target, CartesianTarget)
                else math.nan
                for arm in step.applied.action.arms
            ]
        )


class UntilDone:
    """Another agent, finished as soon as success has held."""

    def __init__(self, agent: Agent, twin: Twin) -> None:
        self._agent, self._twin = agent, twin
        self._held = 0.0  # [s]

    def reset(self, observation: Observation) -> None:
        self._agent.reset(observation)

    def act(self, observation: Observation) -> Action | None:
        self._held = self._held + CONTROL_PERIOD if self._twin.progress().success else 0.0
        return None if self._held > HELD_SUCCESS else self._agent.act(observation)


@dataclass(frozen=True, slots=True)
class _Done:
    """What a worker sends back of one seed."""

    rollout: Rollout
    path: Path | None = None
    feel: Feel = field(default_factory=Feel)
    camera_error: str | None = None


def evaluate(
    plan: Plan,
    data_dir: Path,
    *,
    workers: int = 1,
    on_rollout: Callable[[Rollout, Path | None], None] = lambda rollout, path: None,
) -> Evaluation:
    """Roll out every seed and save what came of it; `on_rollout` hears of each with its episode."""
    if workers < 1:
        raise ValueError(f"Workers must be at least 1, not {workers}.")
    started, evaluation_id = time.time(), new_episode_id(plan.task)
    done = []
    for one in _rollouts(plan, data_dir, evaluation_id, workers):
        done.append(one)
        on_rollout(one.rollout, one.path)
    done.sort(key=lambda one: one.rollout.seed)
    asked = "yes" if plan.cameras or plan.sees else "no"
    evaluation = Evaluation(
        evaluation_id=evaluation_id,
        started=started,
        run=plan.run,
        task=plan.task,
        spread=plan.spread,
        provenance=plan.provenance,
        versions=versions(),
        rollouts=tuple(one.rollout for one in done),
        curves=_curves(plan.task, [one.feel for one in done if one.rollout.error is None]),
        images=next((one.camera_error for one in done if one.camera_error), asked),
    )
    evaluation.save(data_dir)
    return evaluation


def _rollouts(plan: Plan, data_dir: Path, evaluation_id: str, workers: int) -> Iterator[_Done]:
    """In the order in which they end."""
    if workers == 1:
        with plan.station(data_dir) as station:
            opened = cache(plan.opened)
            for seed in plan.seeds:
                yield _roll_out(station, opened, plan, evaluation_id, seed)
        return

    def pool(size: int) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(size, get_context("spawn"), _prepare, (plan, data_dir, evaluation_id))

    lost = []
    with pool(min(workers, len(plan.seeds))) as side_by_side:
        seeds = {side_by_side.submit(_roll_out_here, seed): seed for seed in plan.seeds}
        try:
            for future in as_completed(seeds):
                try:
                    yield future.result()
                except BrokenProcessPool:
                    lost.append(seeds[future])
        finally:
            side_by_side.shutdown(wait=False, cancel_futures=True)  # interrupted: the others need not come
    for seed in lost:  # a process that dies takes the pool along; who killed it shows alone
        with pool(1) as alone:
            try:
                yield alone.submit(_roll_out_here, seed).result()
            except BrokenProcessPool as error:
                yield _Done(Rollout(seed, False, error=f"Its process died: {error}"))


def _roll_out(
    station: Station, opened: Callable[[], _MakeAgent], plan: Plan, evaluation_id: str, seed: int
) -> _Done:
    feel, begun = Feel(), time.monotonic()
    make = opened()  # a policy that cannot be loaded ends the evaluation: it would fail in every scene
    agent: Agent | None = None

    def make_agent(twin: Twin) -> Agent:
        nonlocal agent
        if plan.sees and station.camera_error:
            raise RuntimeError(station.camera_error)
        agent = make(twin)
        return UntilDone(agent, twin)

    try:
        take = station.record(
            make_agent,
            agent_name=plan.run,
            operator=EVALUATION,
            seed=seed,
            spread=plan.spread,
            subscribers=[feel],
            provenance={"evaluation": evaluation_id, **plan.provenance},
        )
        if plan.sees and station.camera_error:
            raise RuntimeError(station.camera_error)
    except Exception as error:  # whatever stops one rollout must neither stop nor colour the others
        return _Done(Rollout(seed, False, error=f"{type(error).__name__}: {error}"))
    late = agent.late if isinstance(agent, PolicyAgent) else 0
    rollout = _rollout_of(take, feel, time.monotonic() - begun, late)
    return _Done(rollout, take.path, feel, station.camera_error)


def _rollout_of(take: Take, feel: Feel, wall_seconds: float, late: int) -> Rollout:
    felt = np.max(feel.force, axis=1) if feel.force else np.zeros(0)
    contact = felt[felt > CONTACT]
    progress = take.ending.progress
    return Rollout(
        seed=take.seed,
        success=progress.success,
        error=take.error,
        episode_id=take.episode_id,
        progress=progress.value,
        phase=progress.phase,
        seconds=take.ending.seconds,
        wall_seconds=wall_seconds,
        contact_seconds=len(contact) * CONTROL_PERIOD,
        force_mean_N=float(contact.mean()) if len(contact) else 0.0,
        force_sd_N=float(contact.std()) if len(contact) else 0.0,
        force_max_N=feel.peak,
        impulse_Ns=float(contact.sum()) * CONTROL_PERIOD,
        limits=take.limits,
        late_ticks=late,
    )


def _curves(task: str, feels: Sequence[Feel]) -> dict[str, Curves]:
    """Of each arm, over all trials."""
    return {
        arm.name: _curve(
            [np.array(feel.force)[:, n] for feel in feels if feel.force],
            [np.array(feel.stiffness)[:, n] for feel in feels if feel.force],
        )
        for n, arm in enumerate(tasks.load(task).arms)
    }


def _curve(forces: Sequence[Array], stiffnesses: Sequence[Array]) -> Curves:
    ticks = range(0, max(map(len, forces), default=0), CURVE_EVERY)
    force = [np.array([trial[tick] for trial in forces if tick < len(trial)]) for tick in ticks]
    stiffness = [np.array([t[tick] for t in stiffnesses if tick < len(t)]) for tick in ticks]
    known = [row[np.isfinite(row)] for row in stiffness]
    return Curves(
        time_s=[round(tick * CONTROL_PERIOD, 3) for tick in ticks],
        trials=[len(row) for row in force],
        force_mean_N=[round(float(row.mean()), 4) for row in force],
        force_sd_N=[round(float(row.std()), 4) for row in force],
        stiffness_mean_N_m=[round(float(row.mean()), 2) if len(row) else None for row in known],
        stiffness_sd_N_m=[round(float(row.std()), 2) if len(row) else None for row in known],
    )


# A worker process

_worker: tuple[Station, Callable[[], _MakeAgent], Plan, str]


def _prepare(plan: Plan, data_dir: Path, evaluation_id: str) -> None:
    global _worker
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # the workers share the cores; read when torch is loaded
    _worker = plan.station(data_dir), cache(plan.opened), plan, evaluation_id


def _roll_out_here(seed: int) -> _Done:
    return _roll_out(*_worker, seed)
