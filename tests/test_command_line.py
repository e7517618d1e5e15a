"""The command line: what it prints, what it exits with, what it says when asked for nonsense."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from test_api import doctored

from studio import __main__ as command_line
from studio import recorder
from studio.api import DemoReport, Studio
from studio.commands import terminal
from studio.references import REFERENCES

ROOT = Path(__file__).parent.parent
DEMO_KEYS = {"task", "episodes", "successes", "seeds", "mean_force_N", "max_force_N", "ids"}

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def studio(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command: its exit status, what it printed and what it complained."""

    def run(*arguments: object) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as left:
            command_line.main([str(argument) for argument in arguments])
        told = capsys.readouterr()
        return int(left.value.code or 0), told.out, told.err

    return run


@pytest.fixture
def copy(recorded: tuple[Path, DemoReport], tmp_path: Path) -> tuple[Path, list[str]]:
    """A data folder of its own with two takes, and their ids."""
    data, report = recorded
    takes = tmp_path / "data" / "episodes" / "wiping"
    takes.mkdir(parents=True)
    for path in (data / "episodes" / "wiping").glob("*.mcap"):
        (takes / path.name).write_bytes(path.read_bytes())
    return tmp_path / "data", report.ids


def last_json(printed: str) -> Any:
    return json.loads(printed.splitlines()[-1])


def test_tasks_are_listed(studio: Run) -> None:
    status, text, _ = studio("tasks")
    assert status == 0
    assert "wiping" in text
    listed = {task["task"]: task for task in last_json(studio("tasks", "--json")[1])}
    assert listed["wiping"]["arms"] == {"right": ["medium", "low"]}
    assert listed["wiping"]["cameras"] == ["front", "right_wrist"]


def test_a_demo_ends_with_one_json_object(tmp_path: Path) -> None:
    options = ("--episodes", "1", "--seed", "5", "--no-cameras", "--json", "--data", str(tmp_path))
    command = [sys.executable, "-m", "studio", "demo", "wiping", *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    report = last_json(done.stdout)
    assert report.keys() >= DEMO_KEYS
    assert (report["task"], report["episodes"], report["successes"], report["seeds"]) == ("wiping", 1, 1, [5])
    assert done.stderr == ""
    assert [path.stem for path in tmp_path.rglob("*.mcap")] == report["ids"]


def test_the_list_fits_80_columns_without_folding_ids(
    studio: Run, copy: tuple[Path, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    data, ids = copy
    studio("annotate", ids[0], "--quality", 4, "--add-flags", "a-long-flag", "another", "--data", data)
    piped = studio("episodes", "--data", data)[1].splitlines()
    assert len(piped) == 3  # however long: one line a take
    assert "a-long-flag, another" in "".join(piped)
    monkeypatch.setattr(terminal.console, "width", 80)
    narrow = studio("episodes", "--data", data)[1].splitlines()
    assert max(map(len, narrow)) <= 80
    for episode_id in ids:
        assert any(line.startswith(f"{episode_id} ") for line in narrow)


def test_takes_are_found_shown_annotated_deleted_and_restored(
    studio: Run, copy: tuple[Path, list[str]]
) -> None:
    data, (one, other) = copy
    assert studio("annotate", one, "--quality", 4, "--note", "clean stroke", "--data", data)[0] == 0
    found = last_json(studio("episodes", "--min-quality", 4, "--json", "--data", data)[1])
    assert [row["episode_id"] for row in found] == [one]
    shown = last_json(studio("show", one, "--json", "--data", data)[1])
    assert (shown["note"], shown["header"]["seed"], shown["outcome"]) == ("clean stroke", 7, "success")
    assert "clean stroke" in studio("show", one, "--data", data)[1]

    assert studio("delete", one, "--data", data)[0] == 0
    assert [row["episode_id"] for row in last_json(studio("episodes", "--json", "--data", data)[1])] == [
        other
    ]
    trash = last_json(studio("episodes", "--trash", "--json", "--data", data)[1])
    assert [row["episode_id"] for row in trash] == [one]
    assert studio("restore", one, "--data", data)[0] == 0
    assert len(last_json(studio("episodes", "--json", "--data", data)[1])) == 2


def test_replay_checks_to_the_bit(studio: Run, copy: tuple[Path, list[str]]) -> None:
    data, (one, other) = copy
    status, text, _ = studio("replay", one, "--check", "--data", data)
    assert status == 0
    assert "equal to the bit" in text
    assert "\n" not in text.strip()
    path = data / "episodes" / "wiping" / f"{other}.mcap"
    altered = doctored(path, path.with_suffix(".altered"), tick=3)
    altered.replace(path)
    status, text, _ = studio("replay", other, "--check", "--json", "--data", data)
    assert status == 1
    assert last_json(text)["is_exact"] is False
    assert last_json(text)["first_difference"] == 3
    assert studio("replay", other, "--data", data)[0] == 0  # without --check it only tells


def test_a_take_from_elsewhere_that_differs_is_reported_not_failed(
    studio: Run, copy: tuple[Path, list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    data, (one, _) = copy
    path = data / "episodes" / "wiping" / f"{one}.mcap"
    doctored(path, path.with_suffix(".altered"), tick=3).replace(path)
    monkeypatch.setattr("studio.replay.versions", lambda: {"mujoco": "9.9"})
    status, text, _ = studio("replay", one, "--check", "--data", data)
    assert status == 0
    assert "recorded elsewhere" in text


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("demo", "whiping"), "No task 'whiping'; there are"),
        (("demo", "wiping", "--episodes", 0), "at least 1, not 0"),
        (("show", "nothing"), "No episode 'nothing'"),
        (("replay", "nothing", "--check"), "No episode 'nothing'"),
        (("delete", "nothing"), "No episode 'nothing'"),
        (("restore", "nothing"), "No episode 'nothing' in the trash"),
        (("annotate", "nothing", "--quality", 3), "No episode 'nothing'"),
        (("bench", "--only", "nothing"), "No part nothing; there are ['fdcc',"),
    ],
)
def test_wrong_use_exits_with_2_and_one_line_that_helps(
    studio: Run, tmp_path: Path, arguments: tuple[object, ...], told: str
) -> None:
    where = () if arguments[0] == "bench" else ("--data", tmp_path)
    status, text, complaint = studio(*arguments, *where)
    assert status == 2
    assert text == ""
    assert complaint.startswith("studio: ")
    assert told in complaint
    assert complaint.count("\n") == 1


@pytest.mark.parametrize(
    "arguments", [(), ("frobnicate",), ("demo",), ("annotate", "x", "--quality", "good")]
)
def test_what_cannot_be_parsed_exits_with_2(studio: Run, arguments: tuple[str, ...]) -> None:
    status, _, complaint = studio(*arguments)
    assert status == 2
    assert complaint


def test_a_quality_that_does_not_exist_is_refused(studio: Run, copy: tuple[Path, list[str]]) -> None:
    data, (one, _) = copy
    status, _, complaint = studio("annotate", one, "--quality", 9, "--data", data)
    assert status == 2
    assert "1" in complaint
    assert "5" in complaint
    assert studio("annotate", one, "--data", data)[0] == 2  # nothing was said


def test_an_empty_folder_says_how_to_begin(studio: Run, tmp_path: Path) -> None:
    status, text, _ = studio("episodes", "--data", tmp_path / "new")
    assert status == 0
    assert "studio demo wiping" in text
    assert last_json(studio("episodes", "--json", "--data", tmp_path / "new")[1]) == []
    assert studio("recover", "--data", tmp_path / "new")[1] == "Nothing to recover.\n"


def test_a_foreign_file_is_told_and_stops_nothing(studio: Run, copy: tuple[Path, list[str]]) -> None:
    data, _ = copy
    (data / "episodes" / "wiping" / "notes.mcap").write_bytes(b"not an MCAP file")
    status, text, _ = studio("episodes", "--data", data)
    assert status == 0
    assert "notes.mcap" in text
    assert len(last_json(studio("episodes", "--json", "--data", data)[1])) == 2


def test_a_full_disk_refuses_a_take_in_one_line(
    studio: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder, "_lack_of_space", lambda *_: "Only 900 MB are free; recording needs more.")
    status, _, complaint = studio("demo", "wiping", "--no-cameras", "--data", tmp_path)
    assert status == 1
    assert "recording needs" in complaint
    assert complaint.count("\n") == 1


def test_a_take_that_stops_early_is_kept_and_told(
    studio: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = iter([None] * 3)  # free at the start and a little longer, then full
    monkeypatch.setattr(recorder, "SYNC_PERIOD", 0.05)
    monkeypatch.setattr(recorder, "_lack_of_space", lambda *_: next(seen, "Only 900 MB are free."))
    status, text, _ = studio("demo", "wiping", "--no-cameras", "--json", "--data", tmp_path)
    assert status == 1
    (error,) = last_json(text)["errors"]
    assert "The take stopped and is kept" in error
    with Studio(tmp_path) as data:
        (row,) = data.episodes()
        assert 0.0 < row.duration < 8.0


def test_evaluate_ends_with_one_json_object(studio: Run, tmp_path: Path) -> None:
    arguments = ("evaluate", "--task", "wiping", "--seeds", "1000:1002", "--data", tmp_path)
    status, text, _ = studio(*arguments, "demonstrator", "--json", "--workers", 2)
    told = last_json(text)
    assert status == 0
    assert told.keys() >= {"wilson_95", "force_mean_N", "force_max_N", "seconds_per_episode"}
    assert (told["run"], told["task"], told["episodes"]) == ("demonstrator", "wiping", 2)
    assert told["successes"] == 2
    assert len(list(tmp_path.glob("episodes/wiping/*.mcap"))) == 2
    status, text, _ = studio(*arguments, "nothing", "--compare", "demonstrator", "--json")
    paired = last_json(text)["comparison"]
    assert status == 0
    assert (paired["pairs"], paired["difference"], paired["mcnemar_p"]) == (2, -1.0, 0.5)
    assert "0 of 2 succeeded" in studio(*arguments, "nothing")[1]


def test_evaluate_refuses_nonsense(studio: Run, tmp_path: Path) -> None:
    for arguments, words in (
        (("nobody", "--task", "wiping"), "No run 'nobody'"),
        (("nothing", "--task", "wiping", "--seeds", "a:b"), "1000:1020"),
        (("nothing", "--task", "wiping", "--compare", "demonstrator"), "none yet"),
    ):
        status, _, complaint = studio("evaluate", *arguments, "--data", tmp_path)
        assert status == 2
        assert words in complaint


def test_a_part_that_cannot_be_measured_costs_the_others_nothing(
    studio: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse() -> None:
        raise TimeoutError("the disk is [slow]")

    monkeypatch.setattr("studio.benchmarks.cameras.measure", refuse)
    monkeypatch.setattr("studio.benchmarks.loop.measure", lambda: {"one_arm": 9.0, "two_arms": 3.0})
    status, text, _ = studio("bench", "--only", "cameras", "loop", "--json")
    told = last_json(text)
    assert status == 1
    assert told["failed"] == {"cameras": "TimeoutError: the disk is [slow]"}
    assert [goal["met"] for goal in told["goals"]] == [True, False]
    status, text, _ = studio("bench", "--only", "cameras", "loop")
    assert status == 1
    assert "cameras failed: TimeoutError: the disk is [slow]" in text
    assert studio("bench", "--only", "loop")[0] == 0  # a goal that is missed is no failure


def test_references_are_one_table(studio: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in REFERENCES.keys() - {"demonstrator", "all-high"}:
        monkeypatch.delitem(REFERENCES, name)
    arguments = ("references", "wiping", "--episodes", 1, "--data", tmp_path)
    status, text, _ = studio(*arguments)
    assert status == 0
    assert [row.split(" | ")[1] for row in text.splitlines()[2:]] == ["demonstrator", "all-high"]
    report = ("report", "demonstrator", "all-high", "--data", tmp_path, "--out", tmp_path / "out", "--json")
    told = last_json(studio(*report)[1])
    assert [evaluation["run"] for evaluation in told["evaluations"]] == ["demonstrator", "all-high"]
    assert {Path(path).name for path in told["files"]} == {path.name for path in (tmp_path / "out").iterdir()}


def test_a_certificate_is_made_for_this_machine_and_further_names(
    studio: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    status, text, _ = studio("cert", "--names", "studio.lab.example", "192.0.2.7", "--json")
    told = json.loads(text)
    assert status == 0
    assert {"studio.lab.example", "192.0.2.7", "localhost", "127.0.0.1"} <= set(told["names"])
    assert Path(told["key"]).stat().st_mode & 0o777 == 0o600
    status, text, _ = studio("cert")
    assert told["fingerprint"] not in text  # another key
    status, _, complaint = studio("serve", "--data", tmp_path / "data", "--cert", told["cert"])
    assert (status, "--cert and --key belong together" in complaint) == (2, True)
    status, _, complaint = studio(
        "serve", "--data", tmp_path / "data", "--cert", told["key"], "--key", told["cert"]
    )
    assert (status, "hold no certificate" in complaint) == (2, True)
    assert not (tmp_path / "data").exists()
