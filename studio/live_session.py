"""The live session: the loop and what it owns, commands in, reports out, takes to the disk."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import assert_never

import numpy as np

from controller.servo import ServoConfig
from controller.stiffness import nearest_mode
from controller.types import Pose, StiffnessMode
from studio import messages as m
from studio import tasks
from studio.cameras import LiveCameras
from studio.episode import Header
from studio.inputs.operator import HandOfOperator, OperatorAgent, step_of
from studio.inputs.scripted import ScriptedAgent
from studio.link import Hub
from studio.pilot import Pilot, Playing
from studio.recorder import Recorder
from studio.reporter import Reporter
from studio.session import CONTROL_PERIOD, Agent, Clock, Session
from studio.station import header_of
from studio.takes import Takes
from studio.twin import Twin

PACE_WINDOW = 10.0  # [s] over which rate and delays are reported
ORPHAN_TIME = 60.0  # [s] without any client

log = logging.getLogger(__name__)


class LiveSession:
    """The loop and what it owns. `run` is its thread; everything else reaches it through the hub."""

    def __init__(
        self,
        data_dir: Path,
        task: str,
        hub: Hub,
        *,
        seed: int = 0,
        cameras: bool = True,
        config: ServoConfig | None = None,
    ) -> None:
        self._hub = hub
        self._with_cameras = cameras
        self._config = config or ServoConfig()
        self._clock = Clock(CONTROL_PERIOD)
        self._robot: Twin
        self._session: Session
        self._cameras: LiveCameras | None = None
        self._hands: OperatorAgent
        self._agent: Agent
        self._ended = False
        self._driver: m.Driver = "nobody"
        self._collector: m.Driver = "operator"  # who drives again after each reset while collecting
        self._operator = ""
        self._pilot = Pilot(data_dir)
        self._takes = Takes(Recorder(data_dir), self._header, self._tell)
        self._reporter = Reporter(hub)
        self._alone_since: float | None = None
        self._load(task, seed, 1.0)

    # The loop

    def run(self) -> None:
        """Until a `Shutdown`, or until everybody has left for long enough."""
        clock = self._clock
        clock.restart()
        try:
            while not self._ended:
                for command in self._hub.commands.drain():
                    self._obey(command)
                self._look_around()
                self._advance()
                clock.wait()
        finally:
            self._robot.hold()
            self._takes.keep(None, "the session ended", self._robot.progress())
            self._close_cameras()
            self._pilot.close()

    def _advance(self) -> None:
        """One tick of the robot."""
        takes = self._takes
        step = self._session.tick(self._agent, takes.subscribers, takes.tick)
        if step is None:  # the script is done
            self._set_driver("nobody", self._operator)
            takes.keep(None, "the script finished", self._robot.progress())
            return
        takes.count_tick()
        self._reporter.publish(step, self._robot, self._status)

    def _look_around(self) -> None:
        """What happens by itself: countdowns, failing disks, the next scene to collect, being left alone."""
        for text in self._hands.clutch_changes():
            self._takes.add_event("clutch", text)
        self._takes.advance(self._robot.progress(), self._driver)
        if (seed := self._takes.due_seed()) is not None:
            driver = self._collector = self._driver if self._driver != "nobody" else self._collector
            self._reset(m.Reset(seed=seed, spread=self._robot.spread))
            self._takes.start(self._takes.collection.countdown)
            self._set_driver(driver, self._operator)
        if self._driver == "policy" and self._pilot.error:
            self._tell("error", f"{self._pilot.error} The arms hold.")
            self._set_driver("nobody", self._operator)
        self._watch_for_clients()

    def _watch_for_clients(self) -> None:
        if self._hub.n_clients:
            self._alone_since = None
            return
        now = time.monotonic()
        if self._alone_since is None:
            self._alone_since = now
            self._let_hold()
        elif now - self._alone_since > ORPHAN_TIME:
            log.warning("No client for %.0f s; the session ends.", ORPHAN_TIME)
            self._ended = True

    # Commands

    def _obey(self, command: m.Command) -> None:
        try:
            self._execute(command)
        except (KeyError, ValueError, OSError) as error:
            text = str(error.args[0]) if isinstance(error, KeyError) else str(error)
            log.warning("%s: %s", type(command).__name__, text)
            self._tell("error", text)
        except Exception as error:  # our own mistake must not take the robot down
            log.exception("%s failed", type(command).__name__)
            self._tell("error", f"{type(command).__name__} failed: {error!r}")

    def _execute(self, command: m.Command) -> None:
        match command:
            case m.MoveTo():
                self._take_over()
                self._hands.move_to(
                    self._arm(command.arm), Pose(np.array(command.position), np.array(command.wxyz))
                )
            case m.Nudge():
                self._take_over()
                self._hands.nudge(self._arm(command.arm), step_of(command.translation, command.rotation))
            case m.Mirror():
                self._hands.mirror(command.mirrored)
            case m.Engage():
                self._engage(command.arm, command.engaged)
            case m.SetMode():
                self._hand(command.arm).mode = StiffnessMode(command.mode)
            case m.SwitchMode():
                self._hand(command.arm).switch_mode()
            case m.SetGripper():
                self._hand(command.arm).gripper = command.opening
            case m.Hands():
                for sample in command.hands:
                    if sample.arm < len(self._hands.hands):  # else it was meant for the scene before
                        self._hand(sample.arm).track(sample, command)
            case m.Clutch():
                self._clutch(command)
            case m.LoseHand():
                self._hand(command.arm).lose(command.why)
            case m.Release():
                self._release()
            case m.OperatorLeft():
                self._let_hold()
            case m.Drive():
                playing = Playing(command.execution, command.replan_every)
                self._set_driver(command.driver, command.operator, command.policy, playing)
            case m.Reset():
                self._reset(command)
            case m.StartTake():
                self._operator = command.operator or self._operator
                self._takes.start(command.countdown)
            case m.EndTake():
                self._takes.stop(command.judgement, self._robot.progress())
            case m.DiscardTake():
                self._takes.discard()
            case m.Collect():
                self._start_collecting(command)
            case m.TakeTrashed():
                self._takes.collection.trashed(command.episode_id)
            case m.TakeRestored():
                self._takes.collection.restored(command.episode_id)
            case m.RestartCameras():
                self._restart_cameras()
            case m.Shutdown():
                self._ended = True
            case _:
                assert_never(command)

    def _arm(self, arm: int) -> int:
        """The arm's index. Raises ValueError where there is none."""
        if not 0 <= arm < len(self._hands.hands):
            raise ValueError(f"No arm {arm}; this task has {len(self._hands.hands)}, counted from 0.")
        return arm

    def _hand(self, arm: int) -> HandOfOperator:
        return self._hands.hands[self._arm(arm)]

    def _engage(self, arm: int, engaged: bool) -> None:
        hand = self._hand(arm)
        if not engaged:
            hand.park()
        elif self._driver == "operator":
            hand.engage(self._robot.arms[arm].servo.target)
        else:
            raise ValueError("Choose the operator as driver first.")

    def _clutch(self, command: m.Clutch) -> None:
        hand = self._hand(command.arm)
        wanted = not hand.clutch.engaged if command.engaged is None else command.engaged
        if not wanted:
            hand.open_clutch()
            return
        hand.check_tracked()
        if self._driver != "operator":
            self._set_driver("operator", command.operator or self._operator)
        hand.close_clutch(self._robot.arms[command.arm].servo.target)

    def _release(self) -> None:
        """Stop: every arm lets go of its press and waits to be engaged again."""
        self._set_driver("operator" if self._driver == "operator" else "nobody", self._operator)
        for hand in self._hands.hands:
            hand.release()

    def _let_hold(self) -> None:
        """Nobody is at the other end of the arms. A script needs nobody."""
        if self._driver not in ("nobody", "script"):
            self._set_driver("nobody", self._operator)

    def _take_over(self) -> None:
        """A person who grabs an arm drives it, in place of a policy."""
        if self._driver == "policy":
            self._set_driver("operator", self._operator)

    def _set_driver(
        self, driver: m.Driver, operator: str, policy: str = "", playing: Playing | None = None
    ) -> None:
        agent: Agent = self._hands
        if driver == "policy":
            agent = self._pilot.agent(self._robot, policy, playing)
        elif driver == "script":
            agent = ScriptedAgent(self._robot, self._robot.seed)
        self._driver, self._operator = driver, operator
        if self._agent is not self._hands:  # grippers and stiffness, too, stay as they are
            for index, hand in enumerate(self._hands.hands):
                hand.gripper = self._robot.arms[index].servo.gripper
                if (mode := self._mode_in_force(index)) in self._robot.task.arms[index].modes:
                    hand.mode = mode
        for arm, hand in enumerate(self._hands.hands):
            if driver == "operator":
                hand.engage(self._robot.arms[arm].servo.target)
            else:
                hand.park()
        agent.reset(self._robot.observe())
        self._agent = agent
        who = self._pilot.run if driver == "policy" else operator
        self._takes.add_event("driver", f"{driver} {who}".strip())

    def _reset(self, command: m.Reset) -> None:
        if self._takes.phase != "idle":
            raise ValueError("A take is being recorded; stop it before resetting.")
        is_other = command.task not in (None, self._robot.task.name)
        driver = self._driver
        if driver == "script" or (driver == "policy" and is_other):
            driver = "nobody"
        self._load(command.task or self._robot.task.name, command.seed, command.spread)
        self._set_driver(driver, self._operator)
        self._clock.restart()

    def _load(self, task: str, seed: int, spread: float) -> None:
        """Put the scene of a task on the stage; builds a new twin only for another task."""
        if not self._reporter.resets or task != self._robot.task.name:
            scene = tasks.load(task)  # refuses an unknown task before anything is given up
            if self._reporter.resets:
                self._close_cameras()
            self._cameras = LiveCameras(task) if self._with_cameras else None
            self._robot = Twin(scene, self._config, self._cameras)
            self._session = Session(self._robot)
            self._session.clock = self._clock
        self._robot.reset(seed, spread)
        if self._cameras:
            self._cameras.clear()
        is_mirrored = self._reporter.resets > 0 and self._hands.is_mirrored
        self._hands = OperatorAgent(self._robot.task.arms, self._config.stiffness_table)
        self._hands.mirror(is_mirrored and len(self._robot.task.arms) == 2)
        self._agent = self._hands
        self._session.inputs = self._hands.timings
        self._reporter.begin_scene()

    def _header(self) -> Header:
        """Of a take that begins now; its time begins with it."""
        self._robot.restart_time()
        names = {"operator": "operator", "script": "scripted", "nobody": "nobody", "policy": self._pilot.run}
        return header_of(
            self._robot,
            agent=names[self._driver],
            operator=self._operator or None,
            has_images=self._cameras is not None and self._cameras.error is None,
            provenance=self._pilot.provenance if self._driver == "policy" else None,
        )

    def _start_collecting(self, command: m.Collect) -> None:
        if command.count <= 0:
            self._takes.collection.stop()
            return
        if self._takes.phase != "idle":
            raise ValueError("A take is being recorded; stop it first.")
        self._operator = command.operator or self._operator
        self._takes.collection.start(command.count, command.seed, command.countdown)

    # Reports

    def _status(self) -> m.Status:
        robot, takes = self._robot, self._takes
        progress = robot.progress()
        pace = self._clock.pace(PACE_WINDOW)
        arms = []
        for index, (setup, hand) in enumerate(zip(robot.task.arms, self._hands.hands, strict=True)):
            level, why = self._reporter.level(index)
            arms.append(
                m.ArmStatus(
                    name=setup.name,
                    mode=self._mode_of(index).value,
                    modes=(setup.modes[0].value, setup.modes[1].value),
                    engaged=hand.engaged,
                    level=level,
                    why=why,
                    input_age=hand.input_age,
                    opening=robot.arms[index].servo.gripper,
                    hand=hand.status,
                )
            )
        return m.Status(
            task=robot.task.name,
            instruction=robot.task.instruction,
            seed=robot.seed,
            spread=robot.spread,
            resets=self._reporter.resets,
            driver=self._driver,
            operator=self._operator,
            policy=self._pilot.run,
            policy_late=self._pilot.late,
            phase=takes.phase,
            countdown=takes.countdown,
            take_seconds=takes.seconds,
            take_id=takes.running_id,
            last_take=takes.last,
            collected=takes.collection.done,
            to_collect=takes.collection.count,
            progress=progress.value,
            success=progress.success,
            task_phase=progress.phase,
            arms=tuple(arms),
            mirrored=self._hands.is_mirrored,
            rate=pace.rate,
            late_share=pace.late_share,
            worst_delay=pace.worst,
            camera_error=(self._cameras.error or "") if self._cameras else "Cameras are switched off.",
        )

    def _mode_of(self, arm: int) -> StiffnessMode:
        """The mode in force where someone else than the operator drives, else the operator's choice."""
        if self._driver not in ("script", "policy"):
            return self._hands.hands[arm].mode
        return self._mode_in_force(arm)

    def _mode_in_force(self, arm: int) -> StiffnessMode:
        return nearest_mode(self._robot.arms[arm].servo.stiffness, self._config.stiffness_table)

    def _tell(self, kind: m.NoticeKind, text: str, take: m.TakeStatus | None = None) -> None:
        self._hub.tell(m.Notice(kind=kind, text=text, take=take))

    # Cameras

    def _restart_cameras(self) -> None:
        self._close_cameras()
        self._cameras = LiveCameras(self._robot.task.name) if self._with_cameras else None
        self._robot.cameras = self._cameras

    def _close_cameras(self) -> None:
        if self._cameras:
            self._cameras.close()
