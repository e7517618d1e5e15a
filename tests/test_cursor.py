"""A cursor shows a take as it was: what the simulator held, what was painted, what was felt."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest

from controller.types import (
    Action,
    ArmAction,
    Array,
    CartesianTarget,
    Limit,
    Observation,
    Pose,
    Step,
    Stiffness,
    StiffnessMode,
)
from studio import cursor as cursors
from studio import models, tasks
from studio.api import DemoReport
from studio.benchmarks.episodes import made_up_header, made_up_steps
from studio.board import Board
from studio.cursor import CONTACT, FREE, PARTS, STEP, TOUCHES, Cursor, peaks, steps
from studio.episode import Episode, Event, Outcome, open_episode
from studio.episode_writer import EpisodeWriter
from studio.station import Station
from studio.twin import Twin, build_model


@dataclasses.dataclass
class Grasping:
    """Moves the tool a little while the hand opens, drops what it holds, closes. Keeps what really was."""

    twin: Twin
    seen: dict[float, Array] = dataclasses.field(default_factory=dict)  # time [s]: (nq,)

    def reset(self, observation: Observation) -> None:
        self._start = observation.arms[0].base_from_tcp

    def act(self, observation: Observation) -> Action | None:
        now = observation.time
        if now > 2.55:
            return None
        self.seen[now] = self.twin.data.qpos.copy()
        target = Pose(
            self._start.position + np.array([0.0, 0.03, 0.02]) * np.sin(2.0 * now), self._start.wxyz
        )
        stiffness = Stiffness.diagonal([500.0] * 3 + [35.0] * 3)
        gripper = float(np.clip(1.5 * (now - 0.4), 0.0, 1.0)) if now < 1.7 else 0.2
        return Action((ArmAction(CartesianTarget(target, stiffness), gripper),))


@dataclasses.dataclass(frozen=True)
class Truth:
    """A take, and what the simulator held at each of its ticks."""

    path: Path
    model: mujoco.MjModel
    seen: dict[float, Array]


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    with Station("wiping", tmp_path_factory.mktemp("truth"), cameras=False) as station:
        agent = Grasping(station.twin)
        take = station.record(lambda _: agent, agent_name="test", seed=3)
        return Truth(take.path, station.twin.model, agent.seen)


@pytest.fixture
def wiped(recorded: tuple[Path, DemoReport]) -> Iterator[Episode]:
    """A demonstration of wiping."""
    data, _ = recorded
    with open_episode(sorted(data.glob("episodes/wiping/*.mcap"))[0]) as episode:
        yield episode


def moved(model: mujoco.MjModel, qpos: Array) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    return data


def pads(model: mujoco.MjModel, qpos: Array) -> Array:
    """(4, 3) [m] of the finger pads in the world."""
    data = moved(model, qpos)
    return np.array([data.geom(f"right_hand_{pad}").xpos for pad in models.PADS])


def test_the_tool_is_where_it_was_measured_at_every_tick(truth: Truth) -> None:
    with open_episode(truth.path) as episode:
        cursor = Cursor(episode, truth.model)
        for at in truth.seen:
            moment = cursor.at(at)
            assert moment.qpos is not None
            tcp = moved(truth.model, moment.qpos).site("right_tcp").xpos
            assert (
                np.abs(tcp - moment.arms[0].base_from_tcp.position).max() < 1e-6
            )  # the base is at the origin
            assert np.abs(moment.qpos[:6] - truth.seen[at][:6]).max() < 1e-12


def test_the_hand_is_as_open_as_it_was_at_every_tick(truth: Truth) -> None:
    driver = int(truth.model.joint("right_hand_right_driver_joint").qposadr[0])
    with open_episode(truth.path) as episode:
        cursor = Cursor(episode, truth.model)
        snapshots = [at for at, _ in episode.snapshots()]
        openings = []
        for at, seen in truth.seen.items():
            qpos = cursor.at(at).qpos
            assert qpos is not None
            assert abs(qpos[driver] - seen[driver]) < 1e-12
            off = np.abs(pads(truth.model, qpos) - pads(truth.model, seen)).max()
            # Blending whole snapshots, a second apart, would be off by 25 mm while the hand moves.
            assert off < (1e-6 if at in snapshots else 3.5e-3)
            openings.append(cursor.at(at).arms[0].gripper)
        assert max(openings) > 0.9
        assert min(openings) < 0.4


def test_a_dropped_object_falls_as_it_fell(truth: Truth) -> None:
    eraser = slice(14, 21)
    with open_episode(truth.path) as episode:
        cursor = Cursor(episode, truth.model)
        times = episode.task_state_times()
        positions = []
        for at in times:
            qpos = cursor.at(float(at)).qpos
            assert qpos is not None
            seen = truth.seen[min(truth.seen, key=lambda tick: abs(tick - at))]
            assert np.abs(qpos[eraser] - seen[eraser]).max() < 1e-9
            positions.append(seen[eraser][:3])
        fallen = np.array(positions)
        assert np.ptp(fallen[:, 2]) > 0.1
        for number, (start, end) in enumerate(itertools.pairwise(times.tolist())):
            qpos = cursor.at((start + end) / 2).qpos
            assert qpos is not None
            assert np.abs(qpos[eraser][:3] - fallen[number : number + 2].mean(axis=0)).max() < 1e-9


def test_ink_is_as_it_was(wiped: Episode) -> None:
    task, board = tasks.load("wiping"), Board()
    cursor = Cursor(wiped, task=task)
    grids = []
    for at, state in wiped.task_states():
        board.restore(state)
        for shown in (at, at + 0.9 * STEP):  # until the next one is recorded
            assert np.array_equal(cursor.task_state(shown)["ink"], state["ink"])
            picture = cursor.picture(shown)
            assert picture is not None
            assert np.array_equal(picture, board.picture())
        grids.append(int(state["ink"].sum()))
    assert grids[-1] < 0.2 * grids[0]


def test_phases_tell_where_force_was_felt(wiped: Episode) -> None:
    (arm,) = Cursor(wiped).arms
    assert [phase.label for phase in arm.phases] == [FREE, CONTACT, FREE]
    assert arm.phases[0].start == 0.0
    assert arm.phases[-1].end == wiped.duration
    for phase in arm.phases:
        force = arm.force[(arm.time >= phase.start) & (arm.time < phase.end)]
        assert (force >= PARTS).all() if phase.label == CONTACT else (force <= TOUCHES).all()


def test_modes_and_their_switches_are_those_that_were_applied(wiped: Episode) -> None:
    cursor = Cursor(wiped)
    (arm,) = cursor.arms
    assert [mode.label for mode in arm.modes] == ["medium", "low", "medium"]
    assert [mark.text for mark in cursor.marks] == ["medium to low", "low to medium"]
    for mode in arm.modes:
        during = arm.stiffness[(arm.action_time >= mode.start) & (arm.action_time < mode.end)]
        assert set(during) == {500.0 if mode.label == StiffnessMode.MEDIUM.value else 250.0}
        assert cursor.at((mode.start + mode.end) / 2).arms[0].mode == mode.label


def test_measured_values_are_those_recorded(wiped: Episode) -> None:
    cursor = Cursor(wiped)
    columns = wiped.columns("right/state", "right/applied")
    for row in (0, 1, 700, -1):
        moment = cursor.at(float(columns["right/state/time"][row]))
        assert np.array_equal(moment.arms[0].wrench.vector, columns["right/state/wrench"][row])
        assert np.array_equal(moment.arms[0].base_from_tcp.vector, columns["right/state/base_from_tcp"][row])
    target = cursor.at(float(columns["right/applied/time"][300])).arms[0].base_from_target
    assert target is not None
    assert np.array_equal(target.vector, columns["right/applied/base_from_target"][300])


def test_time_is_clamped_to_the_take(wiped: Episode) -> None:
    cursor = Cursor(wiped)
    assert cursor.at(-1.0).time == 0.0
    assert cursor.at(1e6).time == wiped.duration


def test_steps_go_from_image_to_image(wiped: Episode) -> None:
    cursor = Cursor(wiped)
    assert cursor.stepped(0.0, 1) == pytest.approx(0.05)
    assert cursor.stepped(0.07, 1) == pytest.approx(0.10)
    assert cursor.stepped(0.07, -1) == pytest.approx(0.05)
    assert cursor.stepped(0.15, -1) == pytest.approx(0.10)  # 0.15 is 2.9999999999999996 steps
    assert cursor.stepped(0.0, -1) == 0.0
    assert cursor.stepped(wiped.duration, 1) == wiped.duration


def test_a_take_of_another_version_of_the_task_is_refused(wiped: Episode) -> None:
    class Another(type(tasks.load("wiping"))):  # type: ignore[misc]
        def build(self, spec: mujoco.MjSpec) -> None:
            super().build(spec)
            spec.worldbody.add_body(name="box").add_freejoint()
            spec.body("box").add_geom(size=(0.01, 0.01, 0.01))

    with pytest.raises(ValueError, match="another version of its task"):
        Cursor(wiped, build_model(Another()))


def made_up_take(folder: Path, limits: dict[int, Limit]) -> Path:
    """A second of noise with two arms and three cameras, in which limits act in some ticks."""
    header = made_up_header()
    path = folder / f"{header.episode_id}.mcap"
    writer = EpisodeWriter(path, header)
    for tick, step in enumerate(made_up_steps(100, header)):
        acting = (limits[tick],) if tick in limits else ()
        writer.add(with_limits(step, acting), time.time())
    writer.add_event(Event(0.5, "takeover", "the operator takes over"))
    return writer.finish(Outcome(None, "made up"))


def with_limits(step: Step, limits: tuple[Limit, ...]) -> Step:
    return dataclasses.replace(step, applied=dataclasses.replace(step.applied, limits=limits))


def test_a_limit_that_goes_on_is_one_mark(tmp_path: Path) -> None:
    cut = Limit(1, "workspace", "the target left the workspace")
    refused = Limit(0, "not_finite", "the target is not finite", refused=True)
    acting = dict.fromkeys(range(20, 30), cut) | {40: refused} | dict.fromkeys(range(60, 62), cut)
    with open_episode(made_up_take(tmp_path, acting)) as episode:
        cursor = Cursor(episode)
        told = [(round(m.start, 3), round(m.end, 3), m.kind, m.arm) for m in cursor.marks if m.kind != "mode"]
        assert told == [
            (0.2, 0.3, "limited", "right"),
            (0.4, 0.41, "refused", "left"),
            (0.5, 0.5, "event", None),
            (0.6, 0.62, "limited", "right"),
        ]
        assert [arm.level for arm in cursor.at(0.205).arms] == ["ok", "limited"]
        assert cursor.at(0.205).arms[1].why == cut.why
        assert [arm.level for arm in cursor.at(0.40).arms] == ["refused", "ok"]
        assert [arm.level for arm in cursor.at(0.30).arms] == ["ok", "ok"]


def test_images_are_the_newest_of_their_time(tmp_path: Path) -> None:
    with open_episode(made_up_take(tmp_path, {})) as episode:
        cursor = Cursor(episode)
        assert list(cursor.jpegs(0.0)) == ["front", "left_wrist", "right_wrist"]
        for number, at in enumerate(episode.image_times("front")):
            for shown in (at, at + 0.9 * STEP):
                assert cursor.jpegs(float(shown))["front"] == episode.jpeg("front", number)


def test_a_take_without_states_is_refused(tmp_path: Path) -> None:
    header = made_up_header()
    path = EpisodeWriter(tmp_path / "empty.mcap", header).finish(Outcome(None, "nothing happened"))
    with open_episode(path) as episode, pytest.raises(ValueError, match="holds no states"):
        Cursor(episode)


def test_thinned_curves_keep_their_peaks() -> None:
    values = np.random.default_rng(0).normal(size=5000)
    kept = peaks(values, 300)
    assert len(kept) <= 302
    assert (np.diff(kept) > 0).all()
    assert {0, int(values.argmax()), int(values.argmin()), 4999} <= set(kept.tolist())
    assert peaks(values[:10], 300).tolist() == list(range(10))


def test_steps_keep_both_sides_of_an_edge() -> None:
    one, other = np.array([5.0, 5, 5, 7, 7, 7, 7]), np.array([np.nan] * 6 + [1.0])
    assert steps(one, other).tolist() == [0, 2, 3, 5, 6]


def test_a_short_touch_belongs_to_the_phase_before() -> None:
    times = np.arange(0.0, 1.0, 0.002)
    force = np.where((times > 0.5) & (times < 0.53), 5.0, 0.0)  # 30 ms
    assert [span.label for span in cursors._spans(times, cursors._touching(force), 1.0)] == [FREE]
    force = np.where((times > 0.5) & (times < 0.6), 5.0, 0.0)
    assert len(cursors._spans(times, cursors._touching(force), 1.0)) == 3


def test_between_the_thresholds_nothing_changes() -> None:
    force = np.array([0.0, 1.2, 2.0, 1.2, 0.5, np.nan, 1.2])
    assert cursors._touching(force).tolist() == [FREE, FREE, CONTACT, CONTACT, FREE, FREE, FREE]
