"""From recorded takes to a policy that drives: choosing, caching, training, going on."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from pathlib import Path
from typing import Unpack

import numpy as np
import pytest
from agents import STAY, Listener, Script

from policy.agent import load_policy
from policy.config import TrainConfig
from studio import training
from studio.__main__ import main
from studio.api import DemoReport, Studio
from studio.benchmarks.episodes import made_up_header, made_up_steps
from studio.episode import Outcome
from studio.index import Filters
from studio.inputs.policy import Immediate, PolicyAgent
from studio.recorder import Recorder
from studio.session import Session
from studio.training import Chosen, recording_of
from studio.twin import Twin

QUICK = TrainConfig(
    images=False,
    width=16,
    feedforward=32,
    heads=2,
    encoder_layers=1,
    decoder_layers=1,
    steps=4,
    batch=4,
    validate_every=2,
    save_every=2,
    validation=0.5,
    device="cpu",
    threads=1,
)


@pytest.fixture
def data(tmp_path: Path, recorded: tuple[Path, DemoReport]) -> Path:
    """A copy of the data folder with two takes, without images, to write to."""
    return Path(shutil.copytree(recorded[0], tmp_path / "data"))


def run_studio(*arguments: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    return int(ended.value.code or 0)


def test_a_take_tells_training_what_was_measured_and_applied(data: Path) -> None:
    with Studio(data) as studio:
        row = studio.episodes()[0]
        with studio.open(row.episode_id) as episode, recording_of(row.path, (1.0, 2.0)) as recording:
            columns = episode.columns("right/state", "right/applied")
            track = recording.track("right")
            assert np.array_equal(track.base_from_target, columns["right/applied/base_from_target"])
            assert np.array_equal(track.wrench, columns["right/state/wrench"])
            assert recording.span == (1.0, 2.0)
            assert (recording.task, recording.arms) == ("wiping", ("right",))


def test_recorded_takes_train_a_policy_that_drives_the_twin(data: Path, twin: Twin) -> None:
    with Studio(data) as studio:
        heard: list[str] = []
        run = studio.begin_run("wiping", QUICK, "first")
        result = studio.train(run, on_take=heard.append)
        assert result.is_finished
        assert heard == [take.episode_id for take in run.takes]
    policy = load_policy(result.run)
    assert (policy.spec.run, policy.spec.task, policy.spec.cameras) == ("first", "wiping", {})
    twin.reset(7)
    steps = Listener()
    agent = PolicyAgent(Immediate(policy))
    Session(twin).run(agent, [steps], time_limit=1.0)
    assert agent.late == 0
    for step in steps.steps:
        assert not {"stiffness", "not_finite", "target_step"} & {limit.kind for limit in step.applied.limits}


def test_a_rollout_is_no_demonstration(data: Path) -> None:
    with Studio(data) as studio:
        rollout = studio.record(
            "wiping", lambda twin: Script([STAY] * 5), operator=training.EVALUATION, cameras=False
        )
        studio.annotate(rollout.episode_id, author="test", outcome="success")
        assert rollout.episode_id not in {t.episode_id for t in studio.begin_run("wiping", QUICK, "a").takes}
        asked: Filters = {"operator": training.EVALUATION}
        assert studio.begin_run("wiping", QUICK, "b", filters=asked).takes == (
            Chosen(rollout.episode_id, None, 1),
        )


def made_up_take(data: Path, agent: str, operator: str, driven_by: str = "", **provenance: str) -> None:
    """A take of 0.1 s, in the middle of which somebody else may begin to drive."""
    header = dataclasses.replace(made_up_header(), agent=agent, operator=operator, provenance=provenance)
    with Recorder(data).start(header, realtime=False) as take:
        for number, step in enumerate(made_up_steps(10, header)):
            take.on_step(step)
            if number == 5 and driven_by:
                take.add_event("driver", driven_by)
        take.finish(Outcome(None, "made up"))


def test_what_a_policy_drove_is_a_demonstration_only_where_it_is_asked_for(tmp_path: Path) -> None:
    made_up_take(tmp_path, "operator", "ana")
    made_up_take(tmp_path, "operator", "ana", driven_by="nobody")
    made_up_take(tmp_path, "operator", "bob", driven_by="policy learner")  # handed over in its middle
    made_up_take(tmp_path, "learner", "ana", run="learner")  # sat beside it
    made_up_take(tmp_path, "learner", "bob", driven_by="operator bob", run="learner")  # took over from it
    made_up_take(tmp_path, "learner", training.EVALUATION, run="learner", evaluation="e")
    made_up_take(tmp_path, "imported", "carl")
    with Studio(tmp_path) as studio:

        def who(**asked: Unpack[Filters]) -> list[tuple[str, str]]:
            filters: Filters = {"outcome": "unmarked", **asked}
            rows = training.choose(studio.catalog, "made-up", filters=filters)
            return sorted((row.agent, row.operator) for row in rows)

        ana = [("operator", "ana")] * 2
        learner = [("learner", name) for name in ("ana", "bob", "evaluation")]
        assert who() == [("imported", "carl"), *ana]
        assert who(operator="ana") == who(agent="operator") == ana
        with pytest.raises(ValueError, match="none has"):
            who(operator="bob")
        assert who(agent="learner") == learner
        assert who(operator=training.EVALUATION) == learner[2:]
        everything = [row.episode_id for row in studio.episodes()]
        studio.make_collection("all", episode_ids=everything)
        run = training.prepare(studio.catalog, "made-up", QUICK, name="a", collection="all")
        assert (len(run.takes), len(run.rollouts)) == (7, 4)  # of which whoever trains is told


def test_a_run_is_not_named_like_another_agent(data: Path) -> None:
    with Studio(data) as studio:
        for name in ("operator", "demonstrator", "replay"):
            with pytest.raises(ValueError, match="know another agent by it"):
                studio.begin_run("wiping", QUICK, name)


def test_only_what_is_asked_for_is_learned_from(data: Path) -> None:
    with Studio(data) as studio:
        first, second = (row.episode_id for row in studio.episodes()[::-1])
        studio.annotate(first, author="test", trim=(0.5, 2.0))
        assert studio.begin_run("wiping", QUICK, "a").takes == (
            Chosen(first, (0.5, 2.0), 1),
            Chosen(second, None, 0),
        )
        assert studio.begin_run("wiping", QUICK, "b", episodes=1).takes == (Chosen(first, (0.5, 2.0), 1),)
        studio.annotate(first, author="test", outcome="failure")
        assert studio.begin_run("wiping", QUICK, "c").takes == (Chosen(second, None, 0),)
        with pytest.raises(ValueError, match="1 takes match"):
            studio.begin_run("wiping", QUICK, "d", episodes=2)
        studio.annotate(second, author="test", outcome="unmarked")
        with pytest.raises(
            ValueError, match=r"2 demonstrations .*0 success, 1 failure, 1 unmarked.* none has"
        ):
            studio.begin_run("wiping", QUICK, "e")
        with pytest.raises(ValueError, match=r"No demonstration of 'drawing'.* there are takes of wiping"):
            studio.begin_run("drawing", QUICK, "f")
        with pytest.raises(KeyError, match="No task 'wipin'"):
            studio.begin_run("wipin", QUICK, "g")


def test_what_is_edited_meanwhile_does_not_change_a_run(data: Path) -> None:
    with Studio(data) as studio:
        run = studio.begin_run("wiping", QUICK, "run")
        studio.train(run)
        studio.annotate(run.takes[0].episode_id, author="test", outcome="failure", trim=(1.0, 2.0))
        again = studio.run("run")
        assert (again.takes, again.config, again.done) == (run.takes, run.config, 4)
        shutil.rmtree(data / "cache")
        assert studio.train(again).step == 4  # the cache is built again, of the takes as they were
        studio.delete(run.takes[1].episode_id)
        assert studio.train(studio.run("run")).step == 4  # the cache still knows it
        shutil.rmtree(data / "cache")
        with pytest.raises(KeyError, match="is in the trash"):
            studio.train(studio.run("run"))


def test_takes_without_images_need_to_be_told(data: Path) -> None:
    with Studio(data) as studio, pytest.raises(ValueError, match="has no images; --no-images"):
        studio.train(studio.begin_run("wiping", TrainConfig(device="cpu"), "run"))


def test_the_command_trains_and_goes_on(data: Path, capfd: pytest.CaptureFixture[str]) -> None:
    small = ("--no-images", "--width", "16", "--heads", "2", "--feedforward", "32", "--device", "cpu")
    told = ("--data", str(data), "--json")
    assert run_studio("train", "wiping", "--steps", "2", "--name", "one", *small, *told) == 0
    result = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert (result["step"], result["is_finished"]) == (2, True)
    lines = (data / "runs" / "one" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [1, 2]
    assert run_studio("train", "--resume", "one", *told) == 0
    assert json.loads(capfd.readouterr().out.splitlines()[-1])["step"] == 2
    for wrong, why in (
        (("wiping", "--resume", "one"), "Give a task to begin a run, or --resume"),
        ((), "Give a task"),
        (("--resume", "one", "--steps", "3"), "leave out all others"),
        (("--resume", "one", "--episodes", "1"), "leave out all others"),
        (("--resume", "two"), "No run 'two'; there are ['one']"),
        (("wiping", "--name", "one", *small), "There is a run one already"),
        (("wiping", "--name", "../x", *small), "cannot name a run"),
        (("wiping", "--dropout", "2"), "--dropout must be at least 0 and below 1"),
    ):
        assert run_studio("train", *wrong, *told) == 2
        assert why in re.sub(r"[\s│]+", " ", capfd.readouterr().err)


def test_help_shows_the_numbers_of_the_preset(capfd: pytest.CaptureFixture[str]) -> None:
    assert run_studio("train", "--preset", "paper", "--help") == 0
    paper = capfd.readouterr().out
    assert "20000" in paper
    assert run_studio("train", "--help") == 0
    small = capfd.readouterr().out
    assert "4500" in small
    assert "20000" not in small
