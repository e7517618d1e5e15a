"""Jobs, runs and evaluations over HTTP, through the typed client and a real server."""

from __future__ import annotations

import dataclasses
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from http_site import Site
from test_training import QUICK

from policy.config import PRESETS, TrainConfig
from studio.api import DemoReport
from studio.client import Client, Refused
from studio.evaluation import Curves, Evaluation, Rollout, paired_interval
from studio.jobs.form import train_form


@pytest.fixture
def site(tmp_path: Path, recorded: tuple[Path, DemoReport]) -> Iterator[Site]:
    """On a copy of the folder with two takes. Jobs wait until a test lets them go."""
    site = Site(shutil.copytree(recorded[0], tmp_path / "data"))
    site.studio.jobs.slots = 0
    yield site
    site.close()


def changes() -> dict[str, object]:
    """What tells QUICK from the preset."""
    small = PRESETS["small"]
    fields = {f.name: getattr(QUICK, f.name) for f in dataclasses.fields(TrainConfig)}
    return {name: value for name, value in fields.items() if value != getattr(small, name)}


def evaluation(run: str, successes: str) -> Evaluation:
    """Of as many seeds as there are letters: Y where it succeeds."""
    rollouts = tuple(
        Rollout(seed, letter == "Y", episode_id=f"{run}-{seed}", force_mean_N=5.0, contact_seconds=1.0)
        for seed, letter in enumerate(successes, 1000)
    )
    curves = {"right": Curves([0.0, 0.1], [2, 2], [1.0, 2.0], [0.1, 0.1], [500.0, None], [0.0, None])}
    return Evaluation(f"e-{run}", 1.0, run, "wiping", 1.0, {"run": run}, {}, rollouts, curves)


def test_a_run_is_asked_for_watched_and_found(site: Site, client: Client) -> None:
    asked = {"kind": "train", "task": "wiping", "name": "learner", "config": changes()}
    now = client.jobs.submit(**asked)
    assert (now.standing.state, now.job.author, now.job.subject) == ("queued", "ann", "learner")
    with pytest.raises(Refused, match="There is a run learner already"):
        client.jobs.submit(**asked)
    site.studio.jobs.slots = 1
    site.studio.jobs.advance()
    ended = client.jobs.wait(now.job.job_id, timeout=100)
    assert ended.standing.state == "done", ended
    assert [run.name for run in client.runs(task="wiping")] == ["learner"]
    assert client.runs(task="drawing") == []
    run = client.jobs.run("learner")
    assert (run.step, run.steps, run.is_learning, run.problem) == (4, 4, False, "")
    assert {take["episode_id"] for take in run.takes} == {r.episode_id for r in site.studio.episodes()}
    assert run.origin["author"] == "ann"
    assert {"studio", "mujoco"} <= run.origin["versions"].keys()
    metrics = client.jobs.metrics("learner")
    assert metrics.curves["loss"].step == [1, 2, 3, 4]
    assert metrics.curves["validation"].step == [2, 4]
    assert {"position", "stiffness", "lr", "gradient"} <= metrics.curves.keys()
    assert "on others" in client.jobs.log(now.job.job_id).text
    # By hand, somebody takes away what says how it was made.
    (site.studio.data_dir / "runs" / "learner" / "config.json").write_text("{")
    (site.studio.data_dir / "runs" / "learner" / "takes.json").unlink()
    run = client.jobs.run("learner")
    assert run.problem == "config.json is damaged. takes.json is missing."
    client.jobs.delete_run("learner")
    assert client.runs() == []
    assert client.jobs.restore_run("learner").name == "learner"


def test_a_list_that_did_not_change_is_not_sent_again(site: Site, client: Client) -> None:
    client.jobs.submit(kind="demo", task="wiping")
    address = f"{site.front.url}/api/v1/jobs"
    first = httpx.get(address)
    again = httpx.get(address, headers={"If-None-Match": first.headers["ETag"]})
    assert (again.status_code, again.content) == (304, b"")
    client.jobs.cancel(first.json()[0]["job"]["job_id"])
    later = httpx.get(address, headers={"If-None-Match": first.headers["ETag"]})
    assert later.json()[0]["standing"]["state"] == "cancelled"


def test_a_sweep_is_queued_whole_or_not_at_all(client: Client) -> None:
    train = {"kind": "train", "task": "wiping", "config": changes()}
    found = client.jobs.sweep({"lr": [1e-3, 1e-4]}, name="rates", **train)
    assert [now.job.swept for now in found] == [{"lr": 1e-3}, {"lr": 1e-4}]
    assert [now.job.job_id for now in client.jobs.all(sweep="rates")] == [n.job.job_id for n in found[::-1]]
    with pytest.raises(Refused, match="--lr must be above 0"):
        client.jobs.sweep({"lr": [1e-3, -1.0]}, name="others", **train)
    assert len(client.jobs.all()) == len(client.runs()) == 2


def test_what_is_refused_says_why_and_queues_nothing(site: Site, client: Client) -> None:
    cases = [
        ({"kind": "train", "task": "drawing"}, 422, "No demonstration of 'drawing'"),
        ({"kind": "train", "task": "juggling"}, 404, "juggling"),
        ({"kind": "train", "task": "wiping", "config": {"depth": 3}}, 422, "There is no setting depth"),
        ({"kind": "train", "task": "wiping", "config": {"steps": "many"}}, 422, "Expected `int`"),
        ({"kind": "train", "task": "wiping", "config": {"steps": 0}}, 422, "--steps must be at least 1"),
        ({"kind": "train", "task": "wiping", "name": "../x"}, 422, "cannot name a run"),
        ({"kind": "train", "task": "wiping", "collection": "x"}, 404, "No collection 'x'"),
        ({"kind": "evaluate", "agent": "/etc"}, 404, "No run or reference '/etc'"),
        ({"kind": "evaluate", "agent": "ws://elsewhere:1"}, 404, "No run or reference"),
        ({"kind": "evaluate", "agent": "nothing"}, 422, "Tell the task"),
        ({"kind": "export", "name": "x"}, 422, "Say which takes"),
        ({"kind": "export", "name": "x", "episode_ids": ["y"]}, 404, "No episode 'y'"),
        ({"kind": "dance"}, 422, "dance"),
        ({"kind": "demo", "task": "wiping", "runner": "head:8265"}, 422, "told like http://head:8265"),
        ({"kind": "demo", "task": "wiping", "runner": "http://127.0.0.1:9"}, 422, "does not answer"),
        ({"kind": "demo", "task": "wiping", "runner": site.front.url}, 422, "knows no version"),
    ]
    for asked, status, why in cases:
        with pytest.raises(Refused) as refused:
            client.jobs.submit(**asked)
        assert refused.value.status == status, (asked, refused.value)
        assert why in str(refused.value)
    for act in (client.jobs.get, client.jobs.cancel, client.jobs.resume, client.jobs.delete, client.jobs.log):
        with pytest.raises(Refused, match="No job 'x'"):
            act("x")
    assert client.jobs.all() == []
    assert not (site.studio.data_dir / "runs").exists()


def test_evaluations_are_compared_scene_by_scene(site: Site, client: Client) -> None:
    for run, successes in {"a": "YYYYYYYY", "b": "YYNNNNYY"}.items():
        evaluation(run, successes).save(site.studio.data_dir)
    (site.studio.data_dir / "evaluations" / "damaged.json").write_text("{")
    assert {told["run"] for told in client.evaluations()} == {"a", "b"}
    assert len(client.jobs.evaluation("e-a").evaluation.rollouts) == 8
    paired = client.jobs.compare("e-a", "e-b")
    assert (paired.comparison.difference, paired.comparison.pairs) == (0.5, 8)
    low, high = paired.comparison.difference_95
    assert 0 < low < 0.5 < high <= 1
    assert [scene["other"]["success"] for scene in paired.scenes].count(False) == 4
    assert {"demonstrator", "nothing"} <= set(client.jobs.references())
    with pytest.raises(Refused, match="No evaluation 'x'"):
        client.jobs.evaluation("x")
    address = f"{site.front.url}/api/v1/evaluations/e-a/figures/force"
    assert httpx.get(address, params={"against": "e-b"}).content.startswith(b"\x89PNG")


def test_the_interval_of_a_paired_difference() -> None:
    assert paired_interval(0, 0, 0) == (-1.0, 1.0)
    low, high = paired_interval(3, 3, 20)
    assert low == pytest.approx(-high)
    assert paired_interval(5, 2, 20) == pytest.approx(tuple(-x for x in paired_interval(2, 5, 20)[::-1]))
    wide, narrow = paired_interval(2, 1, 10), paired_interval(200, 100, 1000)
    assert wide[1] - wide[0] > narrow[1] - narrow[0]


def test_the_form_says_what_the_command_line_says() -> None:
    told = subprocess.run(
        [sys.executable, "-m", "studio", "train", "--help"], capture_output=True, text=True, check=True
    ).stdout
    words = " ".join(told.replace("│", " ").split())
    properties = train_form()["schema"]["properties"]
    assert properties.keys() == {field.name for field in dataclasses.fields(TrainConfig)}
    for name, field in properties.items():
        assert field["flag"] in words or f"--no-{field['flag'][2:]}" in words
        assert " ".join(field["description"].lower().split()) in words.lower()
        assert field["default"] == getattr(PRESETS["small"], name)
    assert (properties["lr"]["group"], properties["lr"]["title"]) == ("Optimisation", "Learning rate")
    assert (properties["chunk_seconds"]["unit"], properties["chunk_seconds"]["flag"]) == (
        "s",
        "--chunk-seconds",
    )
    assert json.loads(json.dumps(train_form()))["presets"]["paper"]["backbone"] == "resnet18"


@pytest.mark.verify
def test_the_time_of_a_run_is_measured(client: Client) -> None:
    told = client.jobs.estimate("wiping", config={**changes(), "steps": 1000}, threads=1)
    assert told.step_seconds > 0
    assert told.seconds == pytest.approx(1000 * told.step_seconds)
