"""The headless API: takes are recorded, found, annotated, deleted, restored and replayed."""

from __future__ import annotations

import dataclasses
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from agents import Script
from mcap.reader import make_reader

from controller.types import Action, ArmAction, CartesianTarget, Hold, JointTarget, Pose, Release, Stiffness
from studio.api import DemoReport, Studio
from studio.catalog import edits_path
from studio.episode import open_episode
from studio.mcap_file import McapWriter
from studio.recorder import versions
from studio.replay import replay
from studio.twin import Twin

ROOT = Path(__file__).parent.parent
X_OF_TARGET = 14  # offset of the lowest byte of x in a recorded Cartesian action


def digests_of(studio: Studio, episode_id: str) -> list[bytes]:
    with studio.open(episode_id) as episode:
        return episode.digests()


def read_me() -> str:
    (snippet,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    return str(snippet)


def doctored(take: Path, copy: Path, tick: int) -> Path:
    """A copy of a take in which one byte of the action requested at `tick` is another."""
    copy.parent.mkdir(parents=True, exist_ok=True)
    with take.open("rb") as file, copy.open("wb") as out:
        reader, writer, number = make_reader(file), McapWriter(out, "test"), 0
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if not writer.has_topic(channel.topic):
                writer.add_topic(channel.topic, schema.name, schema.data)
            data = bytearray(message.data)
            if channel.topic == "/right/requested":
                data[X_OF_TARGET] ^= number == tick
                number += 1
            writer.add(channel.topic, bytes(data), message.log_time, message.publish_time)
        writer.finish()
    return copy


def test_the_lines_in_the_readme_run(tmp_path: Path) -> None:
    snippet = read_me()
    assert len([line for line in snippet.splitlines() if line.strip()]) <= 10
    told = subprocess.run(
        [sys.executable, "-c", snippet], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert told.stderr == ""
    assert "success" in told.stdout
    assert "every state and applied action equal to the bit" in told.stdout
    assert len(list((tmp_path / "data" / "episodes" / "wiping").glob("*.mcap"))) == 2


def test_a_demo_reports_what_it_recorded(recorded: tuple[Path, DemoReport]) -> None:
    data, report = recorded
    assert (report.task, report.episodes, report.successes, report.seeds) == ("wiping", 2, 2, [7, 8])
    assert (report.failures, report.errors, report.limits, report.images) == ([], [], {}, "no")
    assert 2.0 < report.mean_force_N < 4.5
    assert report.mean_force_N < report.max_force_N < 25.0
    with Studio(data) as studio:
        rows = studio.episodes(task="wiping")
        assert sorted(row.episode_id for row in rows) == sorted(report.ids)
        assert {row.seed for row in rows} == {7, 8}
        assert sum(row.duration for row in rows) == pytest.approx(report.simulated_seconds, abs=0.1)


def test_the_papers_stiffness_can_be_chosen_stands_in_the_take_and_replays(tmp_path: Path) -> None:
    with Studio(tmp_path) as studio:
        report = studio.demo("wiping", seed=7, cameras=False, stiffness_table="literal")
        assert report.successes == 1
        with studio.open(report.ids[0]) as episode:
            assert episode.header.control["servo"]["stiffness_table"] == "literal"
            column = episode.columns("right/applied")["right/applied/stiffness"]
            diagonals = [Stiffness.from_vector(row).diagonals for row in np.unique(column, axis=0)]
        np.testing.assert_array_equal(diagonals, [[250.0] * 6, [500.0] * 6])
        assert studio.replay(report.ids[0]).is_exact


def test_a_take_replays_to_the_bit(recorded: tuple[Path, DemoReport]) -> None:
    data, report = recorded
    with Studio(data) as studio:
        result = studio.replay(report.ids[0])
        assert result.is_exact
        assert result.ticks == len(digests_of(studio, report.ids[0])) > 500
        assert "equal to the bit" in str(result)


@pytest.mark.parametrize("tick", [0, 250])
def test_one_changed_bit_of_an_action_is_found_at_its_tick(
    recorded: tuple[Path, DemoReport], tmp_path: Path, tick: int
) -> None:
    data, report = recorded
    with Studio(data) as studio:
        path = studio.catalog.get(report.ids[0]).path
    with open_episode(doctored(path, tmp_path / path.name, tick)) as episode:
        result = replay(episode)
    assert result.first_difference == tick
    assert str(result).endswith(f"the applied action differs at tick {tick}.")


def test_a_take_of_another_version_is_reported(
    recorded: tuple[Path, DemoReport], monkeypatch: pytest.MonkeyPatch
) -> None:
    data, report = recorded
    monkeypatch.setattr("studio.replay.versions", lambda: {**versions(), "mujoco": "9.9"})
    with Studio(data) as studio:
        result = studio.replay(report.ids[0])
    assert result.other_versions == {"mujoco": (versions()["mujoco"], "9.9")}


def test_any_agent_can_be_recorded_with_holds_releases_and_joints(tmp_path: Path) -> None:
    def script(twin: Twin) -> Script:
        state = twin.observe().arms[0]
        pose, stiffness = state.base_from_tcp, twin.arms[0].servo.stiffness
        aside = CartesianTarget(Pose(pose.position + np.array([0.05, 0.0, 0.0]), pose.wxyz), stiffness)
        targets = [aside, Hold(), Release(), JointTarget(state.q + 0.05), Hold(), aside]
        return Script([Action((ArmAction(target, 0.0),)) for target in targets for _ in range(20)])

    with Studio(tmp_path) as studio:
        row = studio.record("wiping", script, agent_name="mine", operator="Ana", seed=4, cameras=False)
        assert (row.agent, row.operator, row.seed) == ("mine", "Ana", 4)
        assert row.outcome == "failure"
        with studio.open(row.episode_id) as episode:
            kinds = episode.columns("right/requested")["right/requested/kind"][::20]
            assert kinds.tolist() == ["cartesian", "hold", "release", "joint", "hold", "cartesian"]
            applied = episode.columns("right/applied")["right/applied/kind"][::20]
            assert applied.tolist() == ["cartesian"] * 3 + ["joint"] * 2 + ["cartesian"]  # what the arm held
        assert studio.replay(row.episode_id).is_exact


def test_a_take_is_annotated_deleted_and_restored(tmp_path: Path) -> None:
    with Studio(tmp_path) as studio:
        row = studio.record("wiping", lambda twin: Script([]), cameras=False)
        marked = studio.annotate(row.episode_id, author="Ana", quality=2, note="too short", outcome="failure")
        assert (marked.quality, marked.note, marked.outcome) == (2, "too short", "failure")
        assert studio.episodes(text="short") == [marked]
        studio.delete(row.episode_id)
        assert studio.episodes() == []
        assert not row.path.exists()
        restored = studio.restore(row.episode_id)
        assert dataclasses.replace(restored, path=marked.path) == marked
        assert edits_path(restored.path).exists()
    with Studio(tmp_path) as studio:  # another process would see the same
        assert [found.note for found in studio.episodes()] == ["too short"]


def test_a_lost_index_is_built_again(recorded: tuple[Path, DemoReport], tmp_path: Path) -> None:
    data, report = recorded
    (tmp_path / "episodes").symlink_to(data / "episodes")
    with Studio(tmp_path) as studio:
        assert {row.episode_id for row in studio.episodes()} == set(report.ids)
        (tmp_path / "catalog.sqlite").unlink(missing_ok=True)
    with Studio(tmp_path) as studio:
        assert studio.rebuild().indexed == 2


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        (lambda studio: studio.demo("whiping"), "No task 'whiping'; there are .*'wiping'"),
        (lambda studio: studio.demo("wiping", episodes=0), "at least 1, not 0"),
        (lambda studio: studio.demo("wiping", workers=0), "at least 1"),
        (lambda studio: studio.open("nothing"), "No episode 'nothing'"),
        (lambda studio: studio.annotate("nothing", quality=3), "No episode 'nothing'"),
        (lambda studio: studio.delete("nothing"), "No episode 'nothing'"),
        (lambda studio: studio.restore("nothing"), "No episode 'nothing' in the trash"),
        (lambda studio: studio.replay("nothing"), "No episode 'nothing'"),
    ],
)
def test_what_does_not_exist_is_refused_with_what_does(tmp_path: Path, wrong: object, told: str) -> None:
    with Studio(tmp_path) as studio, pytest.raises((KeyError, ValueError), match=told):
        wrong(studio)
    assert not list(tmp_path.rglob("*.mcap*"))


def test_an_unknown_camera_or_column_is_refused_with_what_exists(recorded: tuple[Path, DemoReport]) -> None:
    data, report = recorded
    with Studio(data) as studio, studio.open(report.ids[0]) as episode:
        with pytest.raises(KeyError, match="No camera 'side'; this episode has"):
            episode.image("side", 0)
        with pytest.raises(KeyError, match=r"No columns 'left/state'; this episode has .*right/state"):
            episode.columns("left/state")


def test_workers_record_the_same_takes_as_one_process(
    recorded: tuple[Path, DemoReport], tmp_path: Path
) -> None:
    program = (
        "from studio import Studio\n"
        "if __name__ == '__main__':\n"
        f"    Studio({str(tmp_path)!r}).demo('wiping', episodes=2, seed=7, cameras=False, workers=2)\n"
    )
    (tmp_path / "script.py").write_text(program)
    subprocess.run([sys.executable, tmp_path / "script.py"], cwd=ROOT, check=True)
    data, report = recorded
    with Studio(tmp_path) as many, Studio(data) as one:
        ids = {row.seed: row.episode_id for row in many.episodes()}
        for seed, episode_id in zip(report.seeds, report.ids, strict=True):
            assert digests_of(many, ids[seed]) == digests_of(one, episode_id)


RECORD_AND_TELL = """
import sys
from studio import Studio
from studio.inputs.scripted import ScriptedAgent

class Telling(ScriptedAgent):
    def act(self, observation):
        print(observation.time, flush=True)
        return super().act(observation)

Studio(sys.argv[1]).record("wiping", lambda twin: Telling(twin, 7), seed=7, cameras=False)
"""


def test_a_killed_recording_loses_half_a_second_and_comes_back(
    recorded: tuple[Path, DemoReport], tmp_path: Path
) -> None:
    child = subprocess.Popen(
        [sys.executable, "-c", RECORD_AND_TELL, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert child.stdout is not None
    reached = 0.0
    while reached < 4.0:
        reached = float(child.stdout.readline())
    os.kill(child.pid, signal.SIGKILL)
    reached = max(reached, *map(float, child.stdout.read().split()), 0.0)
    child.stdout.close()
    child.wait()
    assert [path.suffix for path in tmp_path.rglob("*wiping*") if path.is_file()] == [".part"]
    with Studio(tmp_path) as studio:
        (recovery,) = studio.recover()
        assert recovery.state == "recovered"
        (row,) = studio.episodes()
        assert row.recovered
        assert row.duration > reached - 0.5
        assert studio.replay(row.episode_id).is_exact
        data, report = recorded
        with Studio(data) as other:
            whole, torn = digests_of(other, report.ids[0]), digests_of(studio, row.episode_id)
        assert torn == whole[: len(torn)]
        assert studio.recover() == []


def test_two_recordings_at_once_share_a_folder(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "studio", "demo", "wiping", "--no-cameras", "--json", "--data", tmp_path]
    children = [
        subprocess.Popen([*command, "--seed", str(seed)], cwd=ROOT, stdout=subprocess.DEVNULL)
        for seed in (7, 8)
    ]
    time.sleep(1.0)
    with Studio(tmp_path) as studio:
        assert all(
            found.state == "live" for found in studio.recover()
        )  # what is being recorded is left alone
        assert [child.wait() for child in children] == [0, 0]
        assert sorted(row.seed for row in studio.episodes() if row.seed is not None) == [7, 8]
        assert studio.recover() == []


def test_an_episode_says_what_was_measured_requested_and_applied(recorded: tuple[Path, DemoReport]) -> None:
    data, report = recorded
    with Studio(data) as studio, studio.open(report.ids[0]) as episode:
        columns = episode.columns()
    assert np.allclose(np.diff(columns["right/state/time"]), 0.002)
    assert np.allclose(np.diff(columns["right/requested/time"]), 0.01)
    stiffness = columns["right/applied/stiffness"][:, 0]
    assert set(stiffness) == {250.0, 500.0}
    force = columns["right/state/wrench"][:, 2]
    touching = force[::5] > 2.0
    assert (stiffness[touching] == 250.0).mean() > 0.9
    depth = columns["right/state/base_from_tcp"][::5, 2] - columns["right/applied/base_from_target"][:, 2]
    assert np.median((stiffness * depth)[touching]) == pytest.approx(np.median(force[::5][touching]), rel=0.1)
