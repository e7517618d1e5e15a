"""Every defect that is planted in a take is found, where it is; a sound take has none."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest

from controller.types import (
    ARM_ROW,
    ARM_ROW_WIDTH,
    Action,
    Applied,
    ArmAction,
    ArmState,
    Array,
    Hold,
    Image,
    Observation,
    Step,
)
from studio.__main__ import main
from studio.api import DemoReport, Studio
from studio.episode import Header, Outcome, open_episode
from studio.episode_writer import EpisodeWriter
from studio.health import Finding, TakeHealth, check, grade_of
from studio.index import EpisodeRow
from studio.survey import examine, survey

ARMS, CAMERAS = ("left", "right"), ("front", "left_wrist")
SECONDS, TICKS = 4.0, 400


@dataclass
class Recorded:
    """What a test spoils before it is written: two arms that swing, noise on their wrenches, two cameras."""

    states: Array  # (arms, 5 * ticks, ARM_ROW_WIDTH), the last of each tick comes right before the next
    late: Array  # (ticks,) [s]
    wall: Array  # (ticks,) [s]
    pictures: dict[str, dict[int, int]] = field(default_factory=dict)  # camera -> tick -> what it shows
    dropped: set[int] = field(default_factory=set)  # ticks that are not written

    def part(self, name: str, arm: int = 1) -> Array:
        """A view of (n, k) of one arm."""
        return self.states[arm, :, ARM_ROW[name]]


def sound(seed: int = 0) -> Recorded:
    rng = np.random.default_rng(seed)
    time = 0.002 * np.arange(1, 5 * TICKS + 1)
    states = np.zeros((2, len(time), ARM_ROW_WIDTH))
    for arm, state in enumerate(states):
        swing = np.sin(2 * time + arm + rng.uniform(0, 0.5))
        state[:, 0] = time
        state[:, ARM_ROW["q"]] = 0.3 * swing[:, None] + np.arange(6)
        state[:, ARM_ROW["dq"]] = np.gradient(0.3 * swing, 0.002)[:, None]
        state[:, ARM_ROW["base_from_tcp"]] = (0, 0, 0, 1, 0, 0, 0)
        state[:, ARM_ROW["base_from_tcp"]][:, 0] = 0.4 + 0.1 * swing
        state[:, ARM_ROW["wrench"]] = rng.normal(0, 0.3, (len(time), 6)) + 8 * (swing[:, None] > 0.5)
    pictures = {camera: {tick: tick for tick in range(0, TICKS, 5)} for camera in CAMERAS}
    return Recorded(states, np.full(TICKS, 1e-4), 1.7e9 + 0.01 * np.arange(TICKS), pictures)


def written(recorded: Recorded, folder: Path, episode_id: str = "take", **header: object) -> Path:
    told = Header(
        **{
            "episode_id": episode_id,
            "task": "peg-cylinder",
            "instruction": "insert the peg",
            "agent": "gizmo",
            "operator": "ann",
            "robot": "none",
            "arms": ARMS,
            "started": 1.7e9,
            "cameras": {camera: (8, 8) for camera in CAMERAS},
            **header,
        }
    )
    writer = EpisodeWriter(folder / f"{episode_id}.mcap", told)
    action = Action(tuple(ArmAction(Hold(), 1.0) for _ in ARMS))
    first = recorded.states[:, 0].copy()
    first[:, 0] = 0.0
    for tick in range(TICKS):
        before = recorded.states[:, 5 * tick - 1] if tick else first
        now = 0.01 * tick
        images = {
            camera: Image(now, None, jpegs[shown[tick]])
            for camera, shown in recorded.pictures.items()
            if tick in shown
        }
        observation = Observation(now, tuple(ArmState.from_row(row) for row in before), images)
        trace = recorded.states[:, 5 * tick : 5 * tick + 5]
        poses = {"pose/peg": np.array([0.4, 0.1, 0.2, 1, 0, 0, 0])} if tick == 0 else None
        if tick not in recorded.dropped:
            applied = Applied(action, (), trace)
            step = Step(observation, action, applied, b"", poses, None, late=recorded.late[tick])
            writer.add(step, recorded.wall[tick])
    return writer.finish(Outcome(True, "done"))


jpegs = [
    cv2.imencode(".jpg", np.full((8, 8, 3), level % 256, np.uint8) + level // 256)[1].tobytes()
    for level in range(TICKS)
]


def health_of(recorded: Recorded, folder: Path, **header: object) -> TakeHealth:
    with open_episode(written(recorded, folder, **header)) as episode:
        return check(episode)


def test_a_sound_take_is_good_for_no_reason_at_all(tmp_path: Path) -> None:
    told = health_of(sound(), tmp_path)
    assert (told.findings, told.grade) == ((), "good")
    assert told.rates == pytest.approx(
        {
            "states of left": 500.0,
            "states of right": 500.0,
            "ticks": 100.0,
            "images of front": 20.0,
            "images of left_wrist": 20.0,
        },
        rel=1e-3,
    )
    assert told.late_share == 0.0
    assert set(told.start) == {"tool of left", "tool of right", "peg"}
    assert told.start["peg"] == (0.4, 0.1, 0.2)


def drop_ticks(take: Recorded) -> None:
    take.dropped = set(range(150, 180))


def drop_images(take: Recorded) -> None:
    for tick in range(200, 240, 5):
        del take.pictures["front"][tick]


def drop_last_images(take: Recorded) -> None:
    for tick in range(350, 400, 5):
        del take.pictures["front"][tick]


def halve_images(take: Recorded) -> None:
    for tick in range(0, TICKS, 10):
        del take.pictures["front"][tick]


def blind(take: Recorded) -> None:
    take.pictures["front"].clear()


def freeze(take: Recorded) -> None:
    take.pictures["left_wrist"] |= {tick: 100 for tick in range(100, 250, 5)}


def lag(take: Recorded) -> None:
    take.late[::20] = 0.02


def crawl(take: Recorded) -> None:
    take.wall[:] = 1.7e9 + 0.011 * np.arange(TICKS)


def kill_sensor(take: Recorded) -> None:
    take.part("wrench")[500:1000] = np.nan


def stick_sensor(take: Recorded) -> None:
    take.part("wrench")[500:1000, 2] = take.part("wrench")[500, 2]


def clip_sensor(take: Recorded) -> None:
    wrench = take.part("wrench")
    wrench[:, 0] = 12 * np.sin(take.part("q")[:, 0] * 10)
    wrench[:] = wrench.clip(-10, 10)


def wait_first(take: Recorded) -> None:
    take.states[:, :600, 1:] = take.states[:, 600:601, 1:]
    take.states[:, :600, ARM_ROW["wrench"]] += np.random.default_rng(1).normal(0, 0.3, (2, 600, 6))
    take.states[:, :601, ARM_ROW["dq"]] = take.states[:, 601:602, ARM_ROW["dq"]]


def wait_last(take: Recorded) -> None:
    for backwards in (take.states[:, ::-1],):
        backwards[:, :700, 1:] = backwards[:, 700:701, 1:]
        backwards[:, :700, ARM_ROW["wrench"]] += np.random.default_rng(1).normal(0, 0.3, (2, 700, 6))


def never_move(take: Recorded) -> None:
    take.part("q", 0)[:] = take.part("q", 1)[:] = 1.0
    take.part("dq", 0)[:] = take.part("dq", 1)[:] = 0.0


def press(take: Recorded) -> None:
    take.part("wrench")[800:900, 1] += 60.0


def glitch_force(take: Recorded) -> None:
    take.part("wrench")[800, 1] += 30.0


def glitch_speed(take: Recorded) -> None:
    take.part("dq")[800, 3] += 1.0


def jump(take: Recorded) -> None:
    take.part("q")[800:, 3] += 0.05


@pytest.mark.parametrize(
    ("spoil", "kind", "severity", "where", "at"),
    [
        (drop_ticks, "gap", "fault", "ticks", 1.5),
        (drop_images, "gap", "fault", "images of front", 2.0),
        (drop_last_images, "gap", "fault", "images of front", 3.6),
        (halve_images, "rate", "fault", "images of front", None),
        (blind, "missing_images", "fault", "front", None),
        (freeze, "frozen_camera", "fault", "left_wrist", 1.5),
        (lag, "late", "warning", "ticks", None),
        (crawl, "rate", "warning", "clock", None),
        (kill_sensor, "dead_sensor", "fault", "right", 1.1),
        (stick_sensor, "dead_sensor", "fault", "right", 1.1),
        (clip_sensor, "saturated_sensor", "fault", "right", None),
        (wait_first, "idle_head", "warning", "", 0.5),
        (wait_last, "idle_tail", "warning", "", 3.5),
        (never_move, "idle_head", "fault", "", 2.0),
        (press, "force_spike", "warning", "right", 1.7),
        (glitch_force, "force_spike", "warning", "right", 1.602),
        (glitch_speed, "velocity_spike", "warning", "right", 1.601),
        (jump, "velocity_spike", "warning", "right", 1.601),
    ],
)
def test_a_planted_defect_is_found_where_it_is(
    tmp_path: Path, spoil: Callable[[Recorded], None], kind: str, severity: str, where: str, at: float | None
) -> None:
    recorded = sound()
    spoil(recorded)
    told = health_of(recorded, tmp_path)
    found = [finding for finding in told.findings if finding.kind == kind and finding.where == where]
    assert [finding.severity for finding in found] == [severity], told.findings
    assert told.grade == {"fault": "poor", "warning": "fair"}[severity]
    if at is not None:
        assert found[0].start is not None
        assert found[0].end is not None
        assert found[0].start - 1e-3 <= at <= found[0].end + 1e-3, found


def test_a_still_camera_is_not_frozen_while_the_arm_that_carries_it_rests(tmp_path: Path) -> None:
    recorded = sound()
    freeze(recorded)
    rest = recorded.states[0, 490:1300]
    rest[:, 1:] = rest[0, 1:]
    rest[:, ARM_ROW["wrench"]] += np.random.default_rng(1).normal(0, 0.3, (len(rest), 6))
    told = health_of(recorded, tmp_path)
    assert not [finding for finding in told.findings if finding.kind == "frozen_camera"]


def test_a_headless_take_has_no_deadlines(tmp_path: Path) -> None:
    recorded = sound()
    recorded.late[:] = 0.0
    recorded.wall[:] = 1.7e9 + 0.5 * np.arange(TICKS)
    assert health_of(recorded, tmp_path).findings == ()


def test_a_trim_takes_off_what_it_cuts_off_and_the_rest_stays(tmp_path: Path) -> None:
    recorded = sound()
    glitch_force(recorded)
    told = health_of(recorded, tmp_path)
    assert told.within(None).findings == told.within((1.0, 3.0)).findings == told.findings
    assert told.within((2.0, 3.0)).findings == told.within((0.0, 1.0)).findings == ()
    blind(recorded)
    assert [f.kind for f in health_of(recorded, tmp_path / "blind").within((2.0, 3.0)).findings] == [
        "missing_images"
    ]


def test_a_grade_is_that_of_the_worst_finding() -> None:
    note, warning, fault = (Finding("gap", severity, "x") for severity in ("note", "warning", "fault"))
    assert [grade_of(found) for found in ((), (note,), (note, warning), (fault, note))] == [
        "good",
        "good",
        "fair",
        "poor",
    ]


# Of many takes


def row_of(number: int, **changes: object) -> EpisodeRow:
    fields: dict[str, object] = {f.name: None for f in dataclasses.fields(EpisodeRow)}
    fields |= {"episode_id": f"take-{number}", "task": "wiping", "operator": "ann", "agent": "gizmo"}
    return EpisodeRow(**fields | {"outcome": "success"} | changes)  # type: ignore[arg-type]


def told_of(number: int, x: float | None = None, **changes: object) -> TakeHealth:
    place = (0.02 * number if x is None else x, 0.0, 0.0)
    fields: dict[str, object] = {"findings": (), "fingerprint": str(number), "start": {"tool": place}}
    return TakeHealth(f"take-{number}", 5.0, {}, 0.0, **fields | changes)  # type: ignore[arg-type]


def test_even_takes_are_good_together() -> None:
    found = survey([(row_of(n), told_of(n)) for n in range(12)])
    assert (found.grade, found.reasons, found.findings) == ("good", (), ())
    assert found.balance["operator"] == {"ann": 12}
    assert found.starts["wiping"]["tool"].thirds[0] == (4, 4, 4)
    assert survey([]).grade == "good"


def test_the_same_motion_twice_is_a_duplicate_of_both(tmp_path: Path) -> None:
    once, again = (
        health_of(sound(), tmp_path, episode_id=name, operator=name, started=1.7e9 + start)
        for name, start in (("one", 0), ("two", 99))
    )
    other = health_of(sound(1), tmp_path, episode_id="other")
    found = survey([(row_of(n, episode_id=t.episode_id), t) for n, t in enumerate((once, again, other))])
    assert [[(f.kind, f.text) for f in told.findings] for told in found.takes] == [
        [("duplicate", "The very motion of two.")],
        [("duplicate", "The very motion of one.")],
        [],
    ]
    assert [told.grade for told in found.takes] == ["fair", "fair", "good"]
    assert len(found.takes) == 3  # nothing is left out


@pytest.mark.parametrize(
    ("change", "start", "where", "text"),
    [
        (lambda n: {"task": "drawing" if n < 2 else "wiping"}, None, "task", "28 takes of wiping, only 2 of"),
        (lambda n: {"operator": "bob" if n < 2 else "ann"}, None, "operator", "ann recorded 28 of 30"),
        (lambda n: {"outcome": "unmarked" if n < 9 else "success"}, None, "outcome", "Nobody judged 9 of 30"),
        (lambda n: {"outcome": "failure" if n < 20 else "success"}, None, "outcome", "20 failures, only 10"),
        (lambda n: {}, lambda n: 0.3, "start", "All 30 takes of wiping begin alike"),
        (lambda n: {}, lambda n: 0.1 * (n > 4), "start", "middle third of its range in x (10 cm) in only 0"),
    ],
)
def test_what_takes_have_too_much_of_is_told(
    change: Callable[[int], dict[str, object]], start: Callable[[int], float] | None, where: str, text: str
) -> None:
    takes = [(row_of(n, **change(n)), told_of(n, start(n) if start else None)) for n in range(30)]
    found = [finding for finding in survey(takes).findings if finding.where == where]
    assert text in " ".join(finding.text for finding in found)


def test_many_poor_takes_make_a_poor_dataset_and_say_so() -> None:
    fault = Finding("gap", "fault", "x")
    takes = [(row_of(n), told_of(n, findings=(fault,) if n < 4 else ())) for n in range(12)]
    found = survey(takes)
    assert (found.grade, found.reasons) == ("poor", ("4 of 12 takes are poor.",))
    assert found.grades == {"good": 8, "fair": 0, "poor": 4}


# Files


def test_demonstrations_are_good_and_examined_once(recorded: tuple[Path, DemoReport], tmp_path: Path) -> None:
    with Studio(recorded[0]) as studio:
        rows = studio.episodes()
        first = [examine(tmp_path, row) for row in rows]
        assert [(told.grade, told.episode_id) for told in first] == [("good", row.episode_id) for row in rows]
        kept = sorted((tmp_path / "cache" / "health").glob("*"))
        assert [path.name for path in kept] == sorted(f"{row.episode_id}.json" for row in rows)
        stamps = [path.stat().st_mtime_ns for path in kept]
        assert [examine(tmp_path, row) for row in rows] == first
        assert [path.stat().st_mtime_ns for path in kept] == stamps  # not written again
        kept[0].write_text("damaged")
        assert [examine(tmp_path, row) for row in rows] == first


def test_a_damaged_take_is_graded_and_not_left_out(tmp_path: Path) -> None:
    path = written(sound(), tmp_path / "episodes" / "peg-cylinder")
    with Studio(tmp_path) as studio:
        (row,) = studio.episodes()
        whole = path.read_bytes()
        path.write_bytes(whole[:5000] + bytes(50_000) + whole[55_000:])
        (told,) = studio.health([row]).takes
        assert (told.grade, [finding.kind for finding in told.findings]) == ("poor", ["unreadable"])
        path.write_bytes(whole)
        assert studio.health([row]).takes[0].grade == "good"


def test_the_command_tells_grades_and_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recorded = sound()
    press(recorded)
    written(recorded, tmp_path / "episodes" / "peg-cylinder")
    for arguments in ([], ["take"], ["--task", "peg-cylinder"]):
        with pytest.raises(SystemExit) as ended:
            main(["health", *arguments, "--data", str(tmp_path), "--json"])
        assert ended.value.code == 0
        told = json.loads(capsys.readouterr().out)
        assert [take["grade"] for take in told["takes"]] == ["fair"]
        assert told["grade"] == "fair"
    with pytest.raises(SystemExit):
        main(["health", "--data", str(tmp_path)])
    said = capsys.readouterr().out
    assert "above 50 N" in said
    assert "All together fair. 1 of 1 takes are fair or poor." in said
