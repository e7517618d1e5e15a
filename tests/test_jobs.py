"""Jobs: what becomes of them when they are cancelled, killed, edited, or nobody watches; real commands."""

from __future__ import annotations

import dataclasses
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import psutil
import pytest
from test_training import QUICK, run_studio
from visitor import wait_for

from studio import runs
from studio.api import DemoReport, Studio
from studio.jobs import plans
from studio.jobs.job import JOB, STATE, Standing, write_json
from studio.jobs.plans import Request, Where
from studio.jobs.queue import JobBusyError, JobNow, Jobs

ANN = Where(author="ann", threads=1)
LONG = 60.0  # [s] for a command to load its libraries on a busy machine


@pytest.fixture
def studio(tmp_path: Path, recorded: tuple[Path, DemoReport]) -> Iterator[Studio]:
    """On a copy of the folder with two takes. Whatever still runs at the end is killed."""
    with Studio(shutil.copytree(recorded[0], tmp_path / "data")) as studio:
        yield studio
        studio.jobs.slots = 0
        for now in studio.jobs.all():
            for pid in (now.standing.pid, now.standing.command_pid):
                if not now.standing.is_over and pid is not None and psutil.pid_exists(pid):
                    os.kill(pid, signal.SIGKILL)


def export(studio: Studio, name: str = "out") -> Request:
    return plans.export(studio.catalog, ANN, name, "act-hdf5", filters={"task": "wiping"})


def demo(studio: Studio, episodes: int = 50) -> Request:
    """Long enough to be caught at work."""
    return plans.demo(studio.catalog, ANN, "wiping", episodes=episodes, cameras=False)


def training(studio: Studio, **changes: object) -> Request:
    config = dataclasses.replace(QUICK, **changes)  # type: ignore[arg-type]
    return plans.train(studio.catalog, ANN, "wiping", config, name="learner")


def over(studio: Studio, job_id: str) -> JobNow:
    return wait_for(lambda: (now := studio.jobs.get(job_id)).standing.is_over and now, LONG)


def at_work(studio: Studio, job_id: str, done: float = 0.0) -> JobNow:
    """As soon as the command tells how far it is."""

    def found() -> JobNow | None:
        now = studio.jobs.get(job_id)
        assert not now.standing.is_over, now
        return now if now.progress is not None and now.progress.done >= done else None

    return wait_for(found, LONG)


def test_jobs_run_one_after_the_other_and_tell_what_came_of_them(studio: Studio) -> None:
    first = studio.submit(export(studio, "first"))
    second = studio.submit(export(studio, "second"))
    assert (first.standing.state, second.standing.state) == ("running", "queued")
    # The one that ends starts the next: nobody else looks after the queue meanwhile.
    ended = [over(studio, now.job.job_id) for now in (first, second)]
    assert [now.standing.state for now in ended] == ["done", "done"]
    assert ended[1].standing.started >= ended[0].standing.ended  # type: ignore[operator]
    result = ended[0].progress.result  # type: ignore[union-attr]
    assert result is not None
    assert Path(result["folder"]) == studio.data_dir / "exports" / "first"
    assert (studio.data_dir / "exports" / "first" / "takes.json").exists()
    assert "2 takes" in studio.jobs.log(first.job.job_id)[0]


def test_a_cancelled_export_leaves_nothing_behind(studio: Studio) -> None:
    now = studio.submit(demo(studio))
    waiting = studio.submit(export(studio))
    assert studio.jobs.cancel(waiting.job.job_id).standing.state == "cancelled"
    at_work(studio, now.job.job_id)
    studio.jobs.cancel(now.job.job_id)
    ended = over(studio, now.job.job_id)
    assert ended.standing.state == "cancelled"
    assert not psutil.pid_exists(ended.standing.command_pid or 0)
    assert not (studio.data_dir / "exports").exists()
    with pytest.raises(JobBusyError, match="cancelled already"):
        studio.jobs.cancel(now.job.job_id)


def test_training_goes_on_after_everything_was_killed(studio: Studio) -> None:
    now = studio.submit(training(studio, steps=3000, save_every=1, validate_every=3000))
    folder = studio.data_dir / "runs" / "learner"
    assert len(json.loads((folder / "takes.json").read_text())) == 2  # as they were when it was asked for
    origin = json.loads((folder / "origin.json").read_text())
    assert (origin["author"], origin["task"]) == ("ann", "wiping")
    with pytest.raises(ValueError, match="There is a run learner already"):
        training(studio)
    at_work(studio, now.job.job_id, done=5)
    with pytest.raises(ValueError, match="is learning"):
        runs.delete(studio.data_dir, "learner")
    with pytest.raises(RuntimeError, match="Another process lets learner learn already"):
        studio.train(studio.run("learner"))  # as somebody may by hand
    told = studio.jobs.get(now.job.job_id).standing
    for pid in (told.pid, told.command_pid):
        os.kill(pid or 0, signal.SIGKILL)
    # Whoever opens the folder next finds it, as no keeper could say how it ended.
    wait_for(lambda: not psutil.pid_exists(told.command_pid or 0))
    other = Jobs(studio.data_dir)
    other.advance()
    assert other.get(now.job.job_id).standing.state == "interrupted"
    step = runs.load(studio.data_dir, "learner").step
    assert step >= 4
    studio.jobs.resume(now.job.job_id)
    at_work(studio, now.job.job_id, done=step + 3)
    studio.jobs.cancel(now.job.job_id)
    ended = over(studio, now.job.job_id)
    assert ended.standing.state == "cancelled"
    assert ended.progress is not None
    assert ended.progress.first >= step
    saved = runs.load(studio.data_dir, "learner")
    assert saved.step == ended.progress.done  # SIGTERM lets it save where it is
    assert not saved.is_learning


def test_a_killed_keeper_takes_its_command_along(studio: Studio) -> None:
    now = at_work(studio, studio.submit(demo(studio)).job.job_id)
    waiting = studio.submit(export(studio))
    os.kill(now.standing.pid or 0, signal.SIGKILL)
    wait_for(lambda: not psutil.pid_exists(now.standing.command_pid or 0))
    studio.jobs.advance()
    assert studio.jobs.get(now.job.job_id).standing.state == "interrupted"
    assert studio.jobs.get(waiting.job.job_id).standing.state == "running"


def test_a_killed_command_is_told_with_its_last_lines(studio: Studio) -> None:
    now = at_work(studio, studio.submit(demo(studio)).job.job_id)
    os.kill(now.standing.command_pid or 0, signal.SIGKILL)
    told = over(studio, now.job.job_id)
    assert told.standing.state == "interrupted"
    assert told.standing.why == "SIGKILL ended it; perhaps the memory was not enough."


def test_a_command_that_does_not_end_is_killed(studio: Studio) -> None:
    request = demo(studio)
    hasty = dataclasses.replace(request, job=dataclasses.replace(request.job, grace=0.5))
    now = at_work(studio, studio.submit(hasty).job.job_id)
    os.kill(now.standing.command_pid or 0, signal.SIGSTOP)  # it hears no SIGTERM
    studio.jobs.cancel(now.job.job_id)
    assert over(studio, now.job.job_id).standing.state == "cancelled"


def test_a_job_that_fails_says_why(studio: Studio) -> None:
    request = export(studio)
    studio.delete(studio.episodes()[0].episode_id)  # between asking and doing
    now = over(studio, studio.submit(request).job.job_id)
    assert (now.standing.state, now.standing.exit_code) == ("failed", 2)
    assert "is in the trash" in now.standing.why
    assert any("is in the trash" in line for line in now.last_lines)
    assert not (studio.data_dir / "exports" / "out").exists()


def test_what_cannot_work_is_refused_before_it_waits(studio: Studio) -> None:
    with pytest.raises(ValueError, match="none has outcome success, min_quality 5"):
        plans.train(studio.catalog, ANN, "wiping", QUICK, filters={"min_quality": 5})
    with pytest.raises(ValueError, match="No demonstration of 'drawing'"):
        plans.train(studio.catalog, ANN, "drawing", QUICK)
    with pytest.raises(KeyError, match="No run 'nobody'"):
        plans.evaluate(studio.catalog, ANN, "nobody")
    with pytest.raises(ValueError, match="No take is chosen"):
        plans.export(studio.catalog, ANN, "out", filters={"task": "drawing"})
    with pytest.raises(ValueError, match="cannot name an export"):
        plans.export(studio.catalog, ANN, "../out", filters={"task": "wiping"})
    with pytest.raises(KeyError, match="No task"):
        plans.demo(studio.catalog, ANN, "juggling")
    studio.jobs.slots = 0
    studio.submit(export(studio))
    with pytest.raises(JobBusyError, match="is queued already"):
        studio.submit(export(studio))
    with pytest.raises(KeyError, match="No job 'x'"):
        studio.jobs.get("x")
    with pytest.raises(KeyError, match="No job"):
        studio.jobs.get("../runs")


def test_deleting_a_job_and_its_run_can_be_undone(studio: Studio) -> None:
    studio.jobs.slots = 0
    now = studio.submit(training(studio))
    run = studio.data_dir / "runs" / "learner"
    kept = sorted(path.name for path in run.iterdir())
    studio.jobs.delete(now.job.job_id)
    assert (studio.jobs.all(), studio.jobs.trash()) == ([], [now.job])
    assert not run.exists()
    studio.jobs.restore(now.job.job_id)
    assert studio.jobs.all() == [now]
    assert sorted(path.name for path in run.iterdir()) == kept
    with pytest.raises(KeyError, match="in the trash"):
        studio.jobs.restore(now.job.job_id)
    # Another may have that name meanwhile, and be deleted, too.
    studio.jobs.delete(now.job.job_id)
    other = studio.submit(training(studio))
    with pytest.raises(ValueError, match="There is a learner by now"):
        studio.jobs.restore(now.job.job_id)
    studio.jobs.delete(other.job.job_id)
    studio.jobs.restore(now.job.job_id)
    assert json.loads((run / "origin.json").read_text())["created"] < other.job.created


def test_folders_that_somebody_edited_are_told_apart(studio: Studio) -> None:
    studio.jobs.slots = 0
    kept = studio.submit(export(studio, "a"))
    damaged, removed = (studio.submit(export(studio, name)).job.job_id for name in "bc")
    (studio.jobs.folder(damaged) / STATE).write_text("{half")
    shutil.rmtree(studio.jobs.folder(removed))
    (studio.data_dir / "jobs" / "mine").mkdir()
    (studio.data_dir / "jobs" / "mine" / "job.json").write_text("{}")
    studio.jobs.advance()
    states = {now.job.job_id: now.standing for now in studio.jobs.all()}
    assert states.keys() == {kept.job.job_id, damaged}
    assert states[damaged].state == "interrupted"
    assert "missing or damaged" in states[damaged].why
    studio.jobs.resume(damaged)
    assert studio.jobs.get(damaged).standing.state == "queued"


def test_a_job_on_a_cluster_that_is_gone_can_be_given_up(studio: Studio) -> None:
    studio.jobs.slots = 0
    job = studio.submit(export(studio)).job
    folder = studio.jobs.folder(job.job_id)
    nobody = "http://127.0.0.1:9"
    write_json(folder / JOB, dataclasses.replace(job, runner=nobody, grace=0.0))
    write_json(folder / STATE, Standing("running", queued=1.0, started=2.0, handle="somewhere"))
    studio.jobs.advance()
    told = studio.jobs.get(job.job_id).standing
    assert (told.state, told.why) == ("lost", f"{nobody} does not answer.")
    with pytest.raises(JobBusyError, match="is lost; cancel it first"):
        studio.jobs.delete(job.job_id)
    studio.jobs.cancel(job.job_id)
    time.sleep(0.01)
    studio.jobs.advance()
    assert studio.jobs.get(job.job_id).standing.state == "cancelled"
    studio.jobs.delete(job.job_id)


def test_a_cluster_that_is_silent_keeps_nobody_waiting(studio: Studio) -> None:
    studio.jobs.slots = 0
    here, *there = (studio.submit(export(studio, name)).job for name in "abcd")
    with socket.create_server(("127.0.0.1", 0)) as head:  # takes every call, and answers none
        for job in there:
            folder = studio.jobs.folder(job.job_id)
            address = f"http://127.0.0.1:{head.getsockname()[1]}"
            write_json(folder / JOB, dataclasses.replace(job, runner=address))
            write_json(folder / STATE, Standing("running", queued=1.0, started=2.0, handle=job.job_id))
        looking = threading.Thread(target=studio.jobs.advance)
        looking.start()
        asked, _ = head.accept()
        Jobs(studio.data_dir).cancel(here.job_id)
        assert looking.is_alive()
        looking.join()
        asked.close()
        head.setblocking(False)
        with pytest.raises(BlockingIOError):  # one that is silent is asked once, not for each of its jobs
            head.accept()
    states = {now.job.job_id: now.standing.state for now in studio.jobs.all()}
    assert states == {here.job_id: "cancelled", **{job.job_id: "lost" for job in there}}


class Head(BaseHTTPRequestHandler):
    """Takes every job as Ray's head does, and says of each that it waited too long for free cores."""

    asked: ClassVar[list[dict[str, Any]]] = []

    def do_POST(self) -> None:
        self.asked.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
        self._answer({"submission_id": self.asked[-1]["submission_id"]})

    def do_GET(self) -> None:
        told = {"ray_version": "2"} if self.path == "/api/version" else {"status": "FAILED"}
        self._answer({**told, "error_type": "JOB_SUPERVISOR_ACTOR_START_TIMEOUT"})

    def _answer(self, told: dict[str, str]) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(json.dumps(told).encode())

    def log_message(self, *_: object) -> None:
        pass


def test_a_job_for_which_a_cluster_had_no_room_is_sent_again(studio: Studio) -> None:
    with ThreadingHTTPServer(("127.0.0.1", 0), Head) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        there = dataclasses.replace(ANN, runner=f"http://127.0.0.1:{server.server_port}", processes=2)
        config = dataclasses.replace(QUICK, device="cuda")
        job = studio.submit(plans.train(studio.catalog, there, "wiping", config, name="learner")).job
        studio.jobs.advance()
        told = studio.jobs.get(job.job_id).standing
        server.shutdown()
    assert told.state == "queued"
    first, second = Head.asked
    assert first["submission_id"] != second["submission_id"] == told.handle
    assert first["entrypoint"].startswith(
        f"{sys.executable} -m studio.jobs.keeper {studio.jobs.folder(job.job_id)}"
    )
    assert (first["entrypoint_num_cpus"], first["entrypoint_num_gpus"]) == (2, 2)


def test_a_job_whose_folder_is_removed_ends(studio: Studio) -> None:
    now = at_work(studio, studio.submit(demo(studio)).job.job_id)
    shutil.rmtree(studio.jobs.folder(now.job.job_id))
    wait_for(lambda: not psutil.pid_exists(now.standing.command_pid or 0))
    assert studio.jobs.all() == []


def test_a_sweep_makes_a_run_for_each_combination(studio: Studio) -> None:
    def make(swept: Mapping[str, Any], where: Where) -> Request:
        name = "-".join(map(str, swept.values()))
        return plans.train(studio.catalog, where, "wiping", dataclasses.replace(QUICK, **swept), name=name)

    studio.jobs.slots = 0
    found = [studio.submit(r).job for r in plans.sweep(make, ANN, {"lr": [1e-3, 1e-4], "seed": [0, 1, 2]})]
    assert [job.swept for job in found][1] == {"lr": 1e-3, "seed": 1}
    assert len({job.sweep for job in found}) == 1
    assert len({job.subject for job in found}) == 6
    config = runs.load(studio.data_dir, found[5].subject).config
    assert (config["lr"], config["seed"]) == (1e-4, 2)
    with pytest.raises(ValueError, match="1 to 64 jobs, not 0"):
        plans.sweep(make, ANN, {"lr": []})


def test_curves_follow_a_run_that_is_resumed_and_damaged(tmp_path: Path) -> None:
    reader, path = runs.MetricsReader(), tmp_path / "metrics.jsonl"
    assert reader.read(tmp_path).curves == {}

    def told(steps: Iterable[int]) -> str:
        return "".join(json.dumps({"step": n, "loss": 1 / n, "lr": 0.1}) + "\n" for n in steps)

    path.write_text(told(range(1, 101)) + '{"step": 101, "lo')
    assert reader.read(tmp_path).step == 100  # the torn line may still become whole
    path.write_text(told(range(1, 101)) + '{"step": 101, "lo\n' + told([102]))
    found = reader.read(tmp_path, points=10)
    assert (found.step, found.damaged, len(found.curves["loss"].step)) == (102, 1, 10)
    assert found.curves["loss"].value[0] == pytest.approx(sum(1 / n for n in range(1, 11)) / 10, rel=1e-5)
    assert found.last == {"loss": pytest.approx(1 / 102), "lr": 0.1}
    assert reader.read(tmp_path, since=100).curves["lr"].step == [102]
    path.write_text(told(range(1, 51)))  # resumed from step 50
    assert reader.read(tmp_path).step == 50
    with path.open("a") as file:
        file.write(told(range(51, 60)))
    assert reader.read(tmp_path).curves["loss"].step[-1] == 59


SUBMIT = """
import sys, time
from studio import Studio
from studio.jobs import plans
studio = Studio(sys.argv[1])
ann = plans.Where(author="ann", threads=1)
studio.submit(plans.demo(studio.catalog, ann, "wiping", episodes=2, cameras=False))
studio.submit(plans.export(studio.catalog, ann, "out", "act-hdf5", filters={"task": "wiping"}))
with studio.jobs.kept_going():
    print("here", flush=True)
    time.sleep(100)
"""


def test_jobs_go_on_when_the_server_is_killed(studio: Studio) -> None:
    server = subprocess.Popen(
        [sys.executable, "-c", SUBMIT, str(studio.data_dir)], stdout=subprocess.PIPE, start_new_session=True
    )
    assert server.stdout is not None
    server.stdout.readline()
    os.killpg(server.pid, signal.SIGKILL)
    server.wait()
    server.stdout.close()
    second, first = studio.jobs.all()
    assert (first.standing.state, second.standing.state) == ("running", "queued")
    assert over(studio, first.job.job_id).standing.state == "done"
    assert over(studio, second.job.job_id).standing.state == "done"
    assert len(studio.episodes(task="wiping")) == 4


@pytest.mark.verify
def test_a_disk_that_is_full_fails_the_job_with_its_reason(studio: Studio) -> None:
    def small_files() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))  # a checkpoint is larger

    command = [
        sys.executable,
        "-m",
        "studio",
        "jobs",
        "submit",
        "--data",
        str(studio.data_dir),
        "--json",
        "--",
    ]
    settings = ["--no-images", "--width", "16", "--heads", "2", "--steps", "3", "--name", "learner"]
    told = subprocess.run(
        [*command, "train", "wiping", *settings], preexec_fn=small_files, stdout=subprocess.PIPE, check=True
    )
    job_id = json.loads(told.stdout)["job"]["job_id"]
    ended = over(studio, job_id)
    assert (ended.standing.state, ended.standing.exit_code) == ("failed", 1)
    assert "File too large" in ended.standing.why
    assert runs.load(studio.data_dir, "learner").checkpoints == ()  # nor half of one


def test_the_command_line_tells_what_there_is(studio: Studio, capsys: pytest.CaptureFixture[str]) -> None:
    data = ("--data", str(studio.data_dir))

    def told(*arguments: str, command: tuple[str, ...] = ()) -> Any:
        assert run_studio("jobs", *arguments, *data, "--json", *command) == 0
        return json.loads(capsys.readouterr().out)

    studio.jobs.slots = 0
    assert told("list") == []
    wiping = ("--", "evaluate", "nothing", "--task", "wiping")
    ranged = told("submit", command=(*wiping, "--seeds", "5:9"))["job"]
    literal = told("submit", command=("--", "demo", "wiping", "--stiffness-table", "literal"))["job"]
    assert {"seed": 5, "episodes": 4}.items() <= ranged["settings"].items()
    assert literal["command"][-2:] == ["--stiffness-table", "literal"]
    assert run_studio("jobs", "submit", *data, *wiping, "--seeds", "3,9") == 2
    for job in (ranged, literal):
        assert run_studio("jobs", "delete", job["job_id"], *data) == 0
    command = ("evaluate", "nothing", "--task", "wiping", "--episodes", "2", "--seed", "5")
    assert run_studio("jobs", "submit", *data, "--sweep", "seed=5,7", "--", *command[:-2]) == 0
    capsys.readouterr()
    found = told("list")
    assert [now["job"]["settings"]["seed"] for now in found] == [7, 5]
    job_id = found[0]["job"]["job_id"]
    assert told("show", job_id)["standing"]["state"] == "queued"
    assert told("cancel", job_id)["standing"]["state"] == "cancelled"
    assert told("resume", job_id)["standing"]["state"] == "queued"
    assert run_studio("jobs", "delete", job_id, *data) == 0
    capsys.readouterr()
    assert job_id in [job["job_id"] for job in told("list", "--trash")]
    assert told("restore", job_id)["job"]["job_id"] == job_id
    assert told("slots", "0") == {"slots": 0}
    for bad in (("submit", "--", "dance"), ("cancel", "x"), ("submit", "--", "train", "drawing")):
        assert run_studio("jobs", bad[0], *data, *bad[1:]) == 2
