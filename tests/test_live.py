"""The session process as its clients see it: a real process, a real socket, real takes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from studio import messages as m
from studio.api import Studio
from studio.link import Link, connect, socket_path


class Stage:
    """A session process and one client of it."""

    def __init__(self, data: Path) -> None:
        self.data = data
        self.process = self.start()
        self.reports: dict[str, m.Report] = {}
        self.notices: list[m.Notice] = []
        self.link = self.client(self._hear)
        self.wait(lambda: "Frame" in self.reports and "Status" in self.reports)

    def start(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "studio.live", "--data", str(self.data), "--no-cameras"]
        return subprocess.Popen(command, stderr=subprocess.DEVNULL)

    def client(self, on_report: Callable[[m.Report], None]) -> Link:
        return connect(socket_path(self.data), on_report)

    def _hear(self, report: m.Report) -> None:
        if isinstance(report, m.Notice):
            self.notices.append(report)
        else:
            self.reports[type(report).__name__] = report

    @property
    def status(self) -> m.Status:
        status = self.reports["Status"]
        assert isinstance(status, m.Status)
        return status

    @property
    def arm(self) -> m.ArmFrame:
        frame = self.reports["Frame"]
        assert isinstance(frame, m.Frame)
        return frame.arms[0]

    def wait(self, condition: Callable[[], object], seconds: float = 20.0) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, f"waited in vain; last: {self.reports} {self.notices}"
            time.sleep(0.01)

    def heard(self, kind: str) -> bool:
        return any(notice.kind == kind for notice in self.notices)

    def last_take(self) -> m.TakeStatus:
        """Of the newest notice that a take was kept or discarded."""
        return next(notice.take for notice in reversed(self.notices) if notice.take)

    def reset(self, seed: int) -> None:
        before = self.status.resets
        self.link.send(m.Reset(seed=seed))
        self.wait(lambda: self.status.resets > before and self.status.seed == seed)

    def drive(self) -> None:
        self.link.send(m.Drive(driver="operator", operator="ana"))
        self.wait(lambda: self.status.driver == "operator" and self.status.arms[0].engaged)

    def move(self, *offset: float) -> None:
        """Ask for a target that lies `offset` [m] from the present one."""
        x, y, z, *wxyz = self.arm.base_from_target
        self.link.send(
            m.MoveTo(
                arm=0,
                position=(x + offset[0], y + offset[1], z + offset[2]),
                wxyz=(wxyz[0], wxyz[1], wxyz[2], wxyz[3]),
            )
        )

    def close(self) -> None:
        self.link.send(m.Shutdown())
        self.link.close()
        try:
            self.process.wait(10)
        finally:
            self.process.kill()
            self.process.wait()


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    stage = Stage(tmp_path_factory.mktemp("live"))
    yield stage
    stage.close()


@pytest.fixture(autouse=True)
def quiet(request: pytest.FixtureRequest) -> None:
    """Each test begins with a fresh scene, nobody driving, no take."""
    if "stage" in request.fixturenames:
        stage: Stage = request.getfixturevalue("stage")
        stage.link.send(m.Collect(count=0))
        if stage.status.phase == "recording":
            stage.link.send(m.DiscardTake())
        stage.wait(lambda: stage.status.phase == "idle")
        stage.link.send(m.Drive(driver="nobody"))
        stage.reset(seed=stage.status.seed + 1)
        stage.notices.clear()


def test_engaging_moves_nothing(stage: Stage) -> None:
    before = np.array(stage.arm.base_from_tcp)
    stage.drive()
    time.sleep(0.5)
    assert np.abs(np.array(stage.arm.base_from_tcp) - before).max() < 1e-5


def test_the_arm_follows_the_operator_and_a_still_hand_keeps_its_target(stage: Stage) -> None:
    stage.drive()
    start = np.array(stage.arm.base_from_target)
    stage.move(0.02, 0.0, -0.02)
    goal = start[:3] + np.array([0.02, 0.0, -0.02])
    stage.wait(lambda: np.abs(np.array(stage.arm.base_from_tcp[:3]) - goal).max() < 2e-3)
    time.sleep(1.0)  # far longer than the watchdog of streams
    assert np.allclose(stage.arm.base_from_target[:3], goal)


def test_nobody_moves_a_parked_arm(stage: Stage) -> None:
    before = np.array(stage.arm.base_from_target)
    stage.move(0.05, 0.0, 0.0)
    time.sleep(0.3)
    assert np.allclose(stage.arm.base_from_target, before)


def test_a_limited_target_says_why(stage: Stage) -> None:
    stage.drive()
    stage.move(0.0, 0.4, 0.0)  # the workspace ends at 0.25 m
    stage.wait(lambda: stage.status.arms[0].level == "limited")
    stage.wait(lambda: "workspace" in stage.status.arms[0].why.lower())


def test_an_absurd_target_is_refused_and_the_arm_stays(stage: Stage) -> None:
    stage.drive()
    before = np.array(stage.arm.base_from_target)
    stage.move(3.0, 0.0, 0.0)
    stage.wait(lambda: stage.status.arms[0].level == "refused")
    assert np.allclose(stage.arm.base_from_target, before)


@pytest.mark.parametrize(
    "command",
    [
        m.MoveTo(arm=7, position=(0.0, 0.0, 0.0), wxyz=(1.0, 0.0, 0.0, 0.0)),
        m.MoveTo(arm=0, position=(0.0, 0.0, 0.0), wxyz=(0.0, 0.0, 0.0, 0.0)),
        m.MoveTo(arm=0, position=(float("nan"), 0.0, 0.0), wxyz=(1.0, 0.0, 0.0, 0.0)),
        m.SetGripper(arm=0, opening=float("nan")),
        m.Reset(seed=1, task="no such task"),
        m.Reset(seed=-1),
        m.Reset(seed=1, spread=0.0),
    ],
)
def test_bad_commands_are_refused_and_the_loop_goes_on(stage: Stage, command: m.Command) -> None:
    stage.drive()
    before = np.array(stage.arm.base_from_target)
    stage.link.send(command)
    stage.wait(lambda: stage.heard("error") or stage.status.arms[0].level == "refused")
    assert np.allclose(stage.arm.base_from_target, before)
    stage.link.send(m.SetGripper(arm=0, opening=0.0))
    stage.reset(seed=stage.status.seed + 1)


def test_a_driven_take_is_kept_and_replays_to_the_bit(stage: Stage) -> None:
    stage.drive()
    stage.link.send(m.StartTake(countdown=0.1, operator="ana"))
    stage.wait(lambda: stage.status.phase == "recording")
    for _ in range(10):
        stage.move(0.01, 0.0, -0.01)
        time.sleep(0.05)
    stage.link.send(m.SetMode(arm=0, mode="low"))
    stage.link.send(m.Engage(arm=0, engaged=False))  # a hold in the middle of the take
    time.sleep(0.2)
    stage.link.send(m.Release())
    time.sleep(0.2)
    stage.link.send(m.EndTake(judgement="failure"))
    stage.wait(lambda: stage.heard("take kept"))
    take = stage.last_take()
    with Studio(stage.data) as studio:
        assert studio.episodes()[0].outcome == "failure"
        with studio.open(take.episode_id) as episode:
            kinds = set(episode.columns("right/requested")["right/requested/kind"])
            assert kinds == {"cartesian", "hold", "release"}
            assert episode.header.operator == "ana"
        replay = studio.replay(take.episode_id)
    assert replay.is_exact, str(replay)


def test_two_people_pressing_start_make_one_take(stage: Stage) -> None:
    other = stage.client(lambda report: None)
    stage.link.send(m.StartTake(countdown=0.0))
    other.send(m.StartTake(countdown=0.0))
    stage.wait(lambda: stage.heard("recording") and stage.heard("error"))
    stage.link.send(m.DiscardTake())
    stage.wait(lambda: stage.heard("take discarded"))
    assert sum(notice.kind == "recording" for notice in stage.notices) == 1
    other.close()


def test_a_scene_is_not_reset_under_a_running_take(stage: Stage) -> None:
    seed = stage.status.seed
    stage.link.send(m.StartTake(countdown=0.0))
    stage.wait(lambda: stage.status.phase == "recording")
    stage.link.send(m.Reset(seed=seed + 50))
    stage.wait(lambda: stage.heard("error"))
    assert stage.status.seed == seed
    assert stage.status.phase == "recording"


def test_a_discarded_take_can_be_brought_back(stage: Stage) -> None:
    stage.link.send(m.StartTake(countdown=0.0))
    stage.wait(lambda: stage.status.take_seconds > 0.3)
    stage.link.send(m.DiscardTake())
    stage.wait(lambda: stage.heard("take discarded"))
    take = stage.last_take()
    with Studio(stage.data) as studio:
        assert take.episode_id not in [row.episode_id for row in studio.episodes()]
        studio.restore(take.episode_id)
        assert studio.catalog.get(take.episode_id).duration > 0.2


def test_the_script_collects_takes_of_the_next_seeds(stage: Stage) -> None:
    stage.link.send(m.Drive(driver="script"))
    stage.link.send(m.Collect(count=2, seed=300, countdown=0.0))
    stage.wait(lambda: sum(notice.kind == "take kept" for notice in stage.notices) == 2, seconds=60.0)
    stage.wait(lambda: stage.status.to_collect == 0)
    with Studio(stage.data) as studio:
        kept = studio.episodes(agent="scripted")
    assert sorted(row.seed or 0 for row in kept) == [300, 301]
    assert all(row.outcome == "success" for row in kept)


def test_a_client_that_leaves_while_driving_leaves_the_arm_holding(tmp_path: Path) -> None:
    stage = Stage(tmp_path)
    try:
        stage.drive()
        stage.link.send(m.StartTake(countdown=0.0))
        stage.wait(lambda: stage.status.phase == "recording")
        stage.link.close()
        time.sleep(0.5)
        stage.link = stage.client(stage._hear)  # the page comes back: the take goes on
        stage.reports.clear()
        stage.wait(lambda: "Status" in stage.reports)
        assert stage.status.driver == "nobody"
        assert stage.status.phase == "recording"
    finally:
        stage.close()
    with Studio(tmp_path) as studio:  # a shutdown in mid-take keeps it
        assert len(studio.episodes()) == 1


def test_a_killed_session_loses_half_a_second_at_most(tmp_path: Path) -> None:
    stage = Stage(tmp_path)
    try:
        stage.link.send(m.StartTake(countdown=0.0))
        stage.wait(lambda: stage.status.take_seconds > 1.5)
        seconds = stage.status.take_seconds
        os.kill(stage.process.pid, signal.SIGKILL)
        stage.process.wait()
    finally:
        stage.close()
    with Studio(tmp_path) as studio:
        assert [recovery.state for recovery in studio.recover()] == ["recovered"]
        (row,) = studio.episodes()
        assert row.recovered
        assert row.duration > seconds - 0.5


def test_a_second_session_on_one_folder_is_refused(stage: Stage) -> None:
    second = stage.start()
    assert second.wait(30) != 0
    assert stage.process.poll() is None
    stage.reset(seed=stage.status.seed + 1)  # the first one still listens


@pytest.mark.skipif(not hasattr(os, "SCHED_FIFO"), reason="Linux has real-time policies")
def test_the_loop_alone_runs_at_real_time_priority_where_the_user_may(stage: Stage) -> None:
    policies = {
        int(task.name): os.sched_getscheduler(int(task.name))
        for task in Path(f"/proc/{stage.process.pid}/task").iterdir()
    }
    loop = policies.pop(stage.process.pid)
    assert loop in {os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.SCHED_OTHER}
    assert (loop == os.SCHED_OTHER) != may_run_in_real_time()
    assert set(policies.values()) == {os.SCHED_OTHER}


def may_run_in_real_time() -> bool:
    probe = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))"
    return subprocess.run([sys.executable, "-c", probe], stderr=subprocess.DEVNULL).returncode == 0
