"""A twin with its cameras and a recorder: records whole takes of one task, headless."""

from __future__ import annotations

import getpass
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from controller.servo import ServoConfig
from controller.types import ARM_ROW, Step
from studio import tasks
from studio.cameras import HEIGHT, WIDTH, RenderedCameras
from studio.episode import Header, Outcome
from studio.recorder import Recorder, new_episode_id, versions
from studio.session import Agent, Ending, Session, Subscriber
from studio.tasks import Task
from studio.twin import Twin

CONTACT = 1.0  # [N] above which an arm counts as touching something


@dataclass(frozen=True, slots=True)
class Take:
    """One recorded take and what it felt like."""

    episode_id: str
    path: Path
    seed: int
    ending: Ending
    contact_force_sum: float  # [N] over the ticks in contact
    contact_ticks: int
    peak_force: float  # [N] over all fast steps
    limits: tuple[str, ...]  # kinds of limits that acted
    error: str | None  # why recording stopped early


class ForceMeter:
    """Subscriber: contact force over a take, of the arm that feels the most."""

    def __init__(self) -> None:
        self.total, self.ticks, self.peak = 0.0, 0, 0.0
        self.limits: set[str] = set()

    def on_step(self, step: Step) -> None:
        force = np.linalg.norm(step.applied.trace[:, :, ARM_ROW["wrench"]][..., :3], axis=-1)
        felt = float(force[:, 0].max())
        if felt > CONTACT:
            self.total += felt
            self.ticks += 1
        self.peak = max(self.peak, float(force.max()))
        self.limits |= {limit.kind for limit in step.applied.limits}


class Station:
    """Owns one twin. Use it in a `with`: its cameras are a process."""

    def __init__(
        self,
        task: str,
        data_dir: Path,
        *,
        cameras: bool = True,
        hide_objects: bool = False,
        config: ServoConfig | None = None,
    ) -> None:
        """`hide_objects` from the cameras: see `RenderedCameras`."""
        self._scene = tasks.load(task)
        self._cameras = RenderedCameras(task, hide_objects=hide_objects) if cameras else None
        self._recorder = Recorder(data_dir)
        self.twin = Twin(self._scene, config, self._cameras)

    def __enter__(self) -> Station:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._cameras:
            self._cameras.close()

    @property
    def camera_error(self) -> str | None:
        """Why there are no images, although asked for."""
        return self._cameras.error if self._cameras else None

    def record(
        self,
        make_agent: Callable[[Twin], Agent],
        *,
        agent_name: str,
        seed: int,
        spread: float = 1.0,
        operator: str | None = None,
        subscribers: Sequence[Subscriber] = (),
        provenance: Mapping[str, Any] | None = None,
    ) -> Take:
        """Reset to `seed`, let the agent drive until it is finished or time is up, keep the take.

        `provenance` goes into its header: which policy drove, and how.
        """
        self.twin.reset(seed, spread)
        header = header_of(
            self.twin,
            agent=agent_name,
            operator=operator,
            has_images=self._has_images(),
            provenance=provenance,
        )
        meter = ForceMeter()
        with self._recorder.start(header, realtime=False) as take:
            ending = Session(self.twin).run(
                make_agent(self.twin), [take, meter, *subscribers], time_limit=self._scene.time_limit
            )
            progress = ending.progress
            take.finish(Outcome(progress.success, f"{ending.reason}: {progress.phase}", progress.value))
        return Take(
            header.episode_id,
            take.path,
            seed,
            ending,
            meter.total,
            meter.ticks,
            meter.peak,
            tuple(sorted(meter.limits)),
            take.error,
        )

    def _has_images(self) -> bool:
        return self._cameras is not None and self._cameras.error is None


def header_of(
    twin: Twin,
    *,
    agent: str,
    operator: str | None,
    has_images: bool,
    provenance: Mapping[str, Any] | None = None,
) -> Header:
    """The header of a take that begins now."""
    task = twin.task
    cameras = {view.name: (WIDTH, HEIGHT) for view in task.cameras} if has_images else {}
    return Header(
        episode_id=new_episode_id(task.name),
        task=task.name,
        instruction=task.instruction,
        agent=agent,
        operator=operator or getpass.getuser(),
        robot=f"MuJoCo twin, {len(task.arms)} x UR5e with Robotiq 2F-85",
        arms=tuple(arm.name for arm in task.arms),
        started=time.time(),
        seed=twin.seed,
        spread=twin.spread,
        cameras=cameras,
        world_from_base=tuple((*map(float, arm.base_position), 1.0, 0.0, 0.0, 0.0) for arm in task.arms),
        versions=versions(),
        control=_control_of(task, twin.config),
        provenance=provenance or {},
    )


def _control_of(task: Task, config: ServoConfig) -> dict[str, Any]:
    return {
        "servo": asdict(config),
        "modes": {arm.name: [mode.value for mode in arm.modes] for arm in task.arms},
        "flange_from_tcp": {arm.name: arm.flange_from_tcp.vector.tolist() for arm in task.arms},
    }
