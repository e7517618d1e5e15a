"""Nothing recorded is lost: not by an error in the session, a full disk, or a kill."""

from __future__ import annotations

import dataclasses
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from controller.types import Step
from studio import recorder as recorders
from studio.benchmarks import episodes as bench
from studio.benchmarks.episodes import made_up_header, made_up_steps
from studio.episode import Header, Outcome, open_episode
from studio.recorder import NotEnoughSpaceError, Recorder, new_episode_id, versions
from studio.recovery import recover_all

ROOT = Path(__file__).parent.parent
DONE = Outcome(True, "done")


@pytest.fixture(scope="module")
def steps() -> list[Step]:
    return list(made_up_steps(200, made_up_header()))


def header() -> Header:
    return made_up_header()


def digests(path: Path) -> list[bytes]:
    with open_episode(path) as episode:
        return episode.digests()


def test_a_take_holds_every_step_and_event(tmp_path: Path, steps: list[Step]) -> None:
    about = header()
    with Recorder(tmp_path).start(about) as take:
        for step in steps:
            take.on_step(step)
        take.add_event("operator", "Ana took over")
        path = take.finish(DONE)
        assert take.error is None
    assert path == take.path == tmp_path / "episodes" / "made-up" / f"{about.episode_id}.mcap"
    with open_episode(path) as episode:
        assert episode.header == about
        assert episode.outcome.success is True  # not what leaving the `with` would have said
        assert episode.digests() == [step.digest for step in steps]
        assert [(event.kind, event.text) for event in episode.events()] == [("operator", "Ana took over")]
        walls = episode.columns("tick")["tick/wall"]
        assert np.all(np.diff(walls) >= 0)
        assert abs(walls[-1] - time.time()) < 60


def test_a_take_is_kept_when_the_session_raises(tmp_path: Path, steps: list[Step]) -> None:
    take = Recorder(tmp_path).start(header())

    def session() -> None:
        with take:
            take.on_step(steps[0])
            raise ZeroDivisionError("in an agent")

    with pytest.raises(ZeroDivisionError):
        session()
    with open_episode(take.path) as episode:
        assert (episode.outcome.success, episode.outcome.reason) == (None, "ZeroDivisionError: in an agent")
        assert len(episode.digests()) == 1


def test_a_discarded_take_waits_in_the_trash(tmp_path: Path, steps: list[Step]) -> None:
    with Recorder(tmp_path).start(header()) as take:
        take.on_step(steps[0])
        path = take.discard()
    assert path == take.path == tmp_path / "trash" / "made-up" / f"{take.header.episode_id}.mcap"
    assert digests(path) == [steps[0].digest]
    assert list((tmp_path / "episodes" / "made-up").iterdir()) == []


def test_headless_the_session_waits_for_the_disk(tmp_path: Path, steps: list[Step]) -> None:
    with Recorder(tmp_path).start(header(), realtime=False) as take:
        waiting = 0
        for step in steps:
            take.on_step(step)
            waiting = max(waiting, take._queue.qsize())
        take.finish(DONE)
    assert waiting <= recorders.HEADLESS_BACKLOG
    assert digests(take.path) == [step.digest for step in steps]


def test_in_real_time_a_disk_that_lags_ends_the_take(
    tmp_path: Path, steps: list[Step], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorders, "BACKLOG", 20)
    with Recorder(tmp_path).start(header()) as take:
        begin = time.monotonic()
        for step in steps:  # all at once: no disk keeps up with that
            take.on_step(step)
        assert time.monotonic() - begin < 0.2
        assert take.error is not None
        assert "too slow: 20 steps wait for it. The take stopped and is kept." in take.error
        take.finish(DONE)
    with open_episode(take.path) as episode:
        n = len(episode.digests())
        assert 20 <= n < 200
        assert episode.digests() == [step.digest for step in steps[:n]]
        assert (episode.outcome.success, episode.outcome.reason) == (None, take.error)


def test_a_step_that_cannot_be_recorded_ends_the_take_and_is_told(tmp_path: Path, steps: list[Step]) -> None:
    bad = dataclasses.replace(steps[1], task_state={"board": np.array([object()])})
    with Recorder(tmp_path).start(header(), realtime=False) as take:
        for step in (steps[0], bad, *steps[2:]):
            take.on_step(step)
    assert take.error is not None
    assert "Array 'board' of dtype object cannot be recorded" in take.error
    assert digests(take.path) == [steps[0].digest]


def test_a_full_disk_refuses_a_new_take(tmp_path: Path) -> None:
    with pytest.raises(
        NotEnoughSpaceError, match=r"^Only \d+ MB are free in .*; recording needs 1000000000 MB"
    ):
        Recorder(tmp_path, min_free=1e15).start(header())
    assert not (tmp_path / "episodes").exists()


@contextmanager
def small_disk(path: Path, megabytes: int) -> Iterator[None]:
    """A real file system at `path`."""
    mount = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(path)]
    if subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("mounting a small file system needs root")
    try:
        yield
    finally:
        subprocess.run(["umount", str(path)], check=True)


def test_a_disk_that_runs_low_finishes_the_take(tmp_path: Path) -> None:
    with small_disk(tmp_path, 64):
        with Recorder(tmp_path, min_free=48e6).start(header(), realtime=False) as take:
            recorded = record_until_error(take)
        assert take.error is not None
        assert "MB are free" in take.error
        with open_episode(take.path) as episode:
            assert (episode.outcome.success, episode.outcome.reason) == (None, take.error)
            n = len(episode.digests())
            assert n > 50
            assert episode.digests() == recorded[:n]


def test_a_disk_that_is_full_keeps_what_was_written(tmp_path: Path) -> None:
    with small_disk(tmp_path, 8):
        with Recorder(tmp_path, min_free=0.0).start(header(), realtime=False) as take:
            recorded = record_until_error(take)
        assert take.error is not None
        assert "No space left on device" in take.error
        assert "`studio recover` finishes it" in take.error
        assert take.path.suffix == ".part"
        (kept,) = recover_all(tmp_path)
        assert kept.state == "failed"  # there is no room for the copy
        subprocess.run(["mount", "-o", "remount,size=32m", str(tmp_path)], check=True)
        (recovery,) = recover_all(tmp_path)
        assert recovery.episode is not None
        n = len(digests(recovery.episode))
        assert n > 200
        assert digests(recovery.episode) == recorded[:n]


def record_until_error(take: recorders.Take) -> list[bytes]:
    recorded = []
    for step in made_up_steps(3000, take.header):
        take.on_step(step)
        recorded.append(step.digest)
        if take.error:
            return recorded
    raise AssertionError("the disk was larger than the take")


LIMITED = """
import resource, sys
from pathlib import Path
from studio.benchmarks.episodes import made_up_header, made_up_steps
from studio.recorder import Recorder

resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, 3_000_000))
header = made_up_header()
with Recorder(Path(sys.argv[1])).start(header, realtime=False) as take:
    for step in made_up_steps(1000, header):
        take.on_step(step)
print(take.error)
"""


def test_a_write_that_fails_keeps_what_was_written(tmp_path: Path) -> None:
    told = subprocess.run(
        [sys.executable, "-c", LIMITED, str(tmp_path)], cwd=ROOT, check=True, capture_output=True, text=True
    )
    assert "File too large" in told.stdout
    (recovery,) = recover_all(tmp_path)
    assert recovery.episode is not None
    kept = digests(recovery.episode)
    assert kept == [step.digest for step in made_up_steps(1000, made_up_header())][: len(kept)]
    assert len(kept) > 100  # 3 MB at 1.8 MB/s


ENDLESS = """
import sys, time
from pathlib import Path
from studio.benchmarks.episodes import made_up_header, made_up_steps
from studio.recorder import Recorder

header = made_up_header()
steps = list(made_up_steps(1000, header))
realtime = sys.argv[2] == "realtime"
period = 0.01 if realtime else 0.001
with Recorder(Path(sys.argv[1])).start(header, realtime) as take:
    begin = time.monotonic()
    for number, step in enumerate(steps):
        time.sleep(max(0.0, begin + period * number - time.monotonic()))
        take.on_step(step)
        print(number + 1, flush=True)
"""


@pytest.mark.parametrize("pace", ["realtime", "headless"])
def test_a_kill_loses_at_most_half_a_second(tmp_path: Path, pace: str) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", ENDLESS, str(tmp_path), pace], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    told = 0
    while told < 120:
        told = int(process.stdout.readline())
    (live,) = recover_all(tmp_path)
    assert live.state == "live"  # its writer is at work
    process.send_signal(signal.SIGKILL)
    told = [told, *map(int, process.stdout)][-1]
    process.wait()
    process.stdout.close()
    (recovery,) = recover_all(tmp_path)
    assert recovery.state == "recovered"
    assert recovery.episode is not None
    kept = digests(recovery.episode)
    assert kept == [step.digest for step in made_up_steps(1000, made_up_header())][: len(kept)]
    assert told - len(kept) <= 51  # ticks of 10 ms; the last may have been told and not yet recorded
    with open_episode(recovery.episode) as episode:
        assert len(episode.image_times("front")) == 1 + (len(kept) - 1) // 5


def test_two_takes_may_run_at_once_in_one_folder(tmp_path: Path, steps: list[Step]) -> None:
    recorder = Recorder(tmp_path)
    with recorder.start(header()) as one, recorder.start(header()) as other:
        for step in steps[:20]:
            one.on_step(step)
            other.on_step(step)
    assert one.path != other.path
    assert digests(one.path) == digests(other.path) == [step.digest for step in steps[:20]]


def test_no_thread_is_left(tmp_path: Path) -> None:
    with Recorder(tmp_path).start(header()) as take:
        pass
    assert take._thread not in threading.enumerate()
    assert take.finish(DONE) == take.path


def test_episode_ids_sort_by_time_and_are_unique() -> None:
    ids = [new_episode_id("wiping") for _ in range(200)]
    assert len(set(ids)) == 200
    assert [name[:22] for name in ids] == sorted(name[:22] for name in ids)
    assert all("-wiping-" in name for name in ids)
    assert dataclasses.replace(header(), episode_id=ids[0]).episode_id == ids[0]


def test_versions_name_what_decides_the_bits() -> None:
    assert versions().keys() == {"studio", "mujoco", "numpy", "pin", "python", "machine", "cpu"}
    assert all(versions().values())


def test_the_benchmark_measures() -> None:
    measured = bench.measure(seconds=1.0, recorded=0.3)
    assert all(value > 0 for value in measured.values())
    assert measured["frame_ms"] <= measured["frame_ms_worst"]
