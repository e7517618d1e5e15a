"""Evaluations: the same scenes for everybody, honest counts, forces that agree with the recordings."""

from __future__ import annotations

import dataclasses
import json
import math
import multiprocessing
from pathlib import Path

import numpy as np
import pytest
from blank import untrained
from policies import SPEC, Riser
from scipy.stats import binomtest

from controller.model import ur5e
from controller.types import Action, CartesianTarget, JointTarget, Observation
from policy.agent import History, Inputs, Policy, load_policy
from studio import references, tasks
from studio.__main__ import main
from studio.api import Studio
from studio.evaluate import Plan
from studio.evaluation import Evaluation, Rollout, compare, load, mcnemar, wilson
from studio.policy_link import TOKEN, PolicyServer, start
from studio.references import REFERENCES, demonstrated, smooth_errors
from studio.tasks import wiping
from studio.twin import Twin

KEYS = {
    "run",
    "task",
    "episodes",
    "successes",
    "wilson_95",
    "force_mean_N",
    "force_max_N",
    "seconds_per_episode",
}


class Faulty:
    """An agent that fails after a while, in some scenes."""

    def __init__(self, twin: Twin) -> None:
        self._agent = REFERENCES["nothing"](twin)
        self._is_faulty = twin.seed % 2 == 1

    def reset(self, observation: Observation) -> None:
        self._agent.reset(observation)

    def act(self, observation: Observation) -> Action | None:
        if observation.time > 0.1:
            if self._is_faulty:
                raise RuntimeError("the network is on fire")
            return None
        return self._agent.act(observation)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("evaluated")


@pytest.fixture(scope="module")
def demonstrator(data: Path) -> Evaluation:
    with Studio(data) as studio:
        return studio.evaluate(Plan(agent="demonstrator", task="wiping", seeds=(1000, 1001)))


@pytest.fixture(scope="module")
def joint(data: Path) -> Evaluation:
    with Studio(data) as studio:
        return studio.evaluate(Plan(agent="off-joint", task="wiping", seeds=(1000, 1001)))


def actions_of(twin: Twin, reference: str, seed: int) -> list[Action]:
    twin.reset(seed)
    agent, observation = REFERENCES[reference](twin), twin.observe()
    agent.reset(observation)
    actions = []
    while (action := agent.act(observation)) is not None:
        actions.append(action)
    return actions


@pytest.mark.parametrize(("successes", "n"), [(0, 20), (1, 20), (18, 20), (20, 20), (7, 10), (0, 1)])
def test_the_interval_is_wilsons(successes: int, n: int) -> None:
    expected = binomtest(successes, n).proportion_ci(method="wilson")
    np.testing.assert_allclose(wilson(successes, n), (expected.low, expected.high), atol=1e-12)


@pytest.mark.parametrize(("one", "other"), [(0, 0), (8, 0), (5, 3), (1, 1), (2, 30)])
def test_mcnemar_is_exact(one: int, other: int) -> None:
    expected = binomtest(one, one + other).pvalue if one + other else 1.0
    assert mcnemar(one, other) == pytest.approx(expected)


def test_forces_agree_with_the_recordings(data: Path, demonstrator: Evaluation) -> None:
    with Studio(data) as studio:
        for rollout in demonstrator.rollouts:
            row = studio.catalog.get(rollout.episode_id)
            assert row.outcome == ("success" if rollout.success else "failure")
            assert row.seed == rollout.seed
            assert row.peak_force == pytest.approx(rollout.force_max_N)
            # The catalogue averages at 500 Hz, the evaluation at 100 Hz.
            assert row.mean_force == pytest.approx(rollout.force_mean_N, rel=0.02)
            with studio.open(rollout.episode_id) as episode:
                told = episode.header.provenance
                assert told == {
                    "evaluation": demonstrator.evaluation_id,
                    "run": "demonstrator",
                    "stiffness_table": "tuned",
                }
                assert episode.duration == pytest.approx(rollout.seconds, abs=0.01)


def test_a_summary_pools_the_time_in_contact(data: Path, demonstrator: Evaluation) -> None:
    summary, forces = demonstrator.summary(), []
    with Studio(data) as studio:
        for episode_id in summary["ids"]:
            with studio.open(episode_id) as episode:
                wrench = episode.columns("right/state")["right/state/wrench"][::5]
                forces.append(np.linalg.norm(wrench[:, :3], axis=1))
    felt = np.concatenate(forces)
    contact = felt[felt > 1.0]
    assert summary.keys() >= KEYS
    assert summary["episodes"] == 2
    assert summary["force_mean_N"] == pytest.approx(contact.mean(), rel=0.02)
    assert summary["force_sd_N"] == pytest.approx(contact.std(), rel=0.02)
    assert summary["impulse_mean_Ns"] == pytest.approx(contact.sum() * 0.01 / 2, rel=0.02)
    json.dumps(summary, allow_nan=False)


def test_curves_run_as_long_as_the_longest_trial(demonstrator: Evaluation) -> None:
    curves = demonstrator.curves["right"]
    assert curves.time_s[-1] == pytest.approx(max(r.seconds for r in demonstrator.rollouts), abs=0.06)
    assert set(curves.trials) == {1, 2}
    assert {round(k) for k in curves.stiffness_mean_N_m if k is not None} >= {250, 500}


def test_an_evaluation_reads_back_and_is_found(
    data: Path, demonstrator: Evaluation, joint: Evaluation
) -> None:
    path = data / "evaluations" / f"{demonstrator.evaluation_id}.json"
    assert load(path) == demonstrator
    with Studio(data) as studio:
        for name in (str(path), demonstrator.evaluation_id, "demonstrator"):
            assert studio.evaluation(name) == demonstrator
        assert studio.evaluation("off-joint", "wiping").evaluation_id == joint.evaluation_id
        with pytest.raises(KeyError, match="demonstrator on wiping"):
            studio.evaluation("demonstrator", "drawing")
    path = data / "evaluations" / "torn.txt"
    path.write_text("{")
    with pytest.raises(ValueError, match="no evaluation"):
        load(path)


def test_joint_control_turns_an_error_into_force(demonstrator: Evaluation, joint: Evaluation) -> None:
    paired = compare(joint, demonstrator)
    assert paired.pairs == 2
    assert paired.force_difference_N > 5.0
    assert joint.curves["right"].stiffness_mean_N_m[-1] is None


def test_only_the_same_scenes_are_compared(demonstrator: Evaluation) -> None:
    for other in (
        dataclasses.replace(demonstrator, task="drawing"),
        dataclasses.replace(demonstrator, spread=2.0),
        dataclasses.replace(demonstrator, rollouts=()),
    ):
        with pytest.raises(ValueError, match=r"other scenes|no seed in common"):
            compare(demonstrator, other)


def test_a_comparison_that_cannot_be_is_refused_before_anything_runs(
    data: Path, demonstrator: Evaluation, capfd: pytest.CaptureFixture[str]
) -> None:
    asked = ("evaluate", "nothing", "--task", "wiping", "--compare", demonstrator.evaluation_id)
    for others, why in ((("--seeds", "5"), "no seed in common"), (("--spread", "2"), "other scenes")):
        with pytest.raises(SystemExit) as ended:
            main([*asked, *others, "--data", str(data)])
        assert ended.value.code == 2
        assert why in capfd.readouterr().err
    with Studio(data) as studio:
        assert "nothing" not in {found.run for found in studio.evaluations()}


def test_errors_are_not_failures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(REFERENCES, "faulty", Faulty)
    with Studio(tmp_path) as studio:
        found = studio.evaluate(Plan(agent="faulty", task="wiping", seeds=(0, 1, 2, 3)))
        summary = found.summary()
        assert summary["episodes"] == 2
        assert summary["failed_seeds"] == [0, 2]
        assert summary["errors"] == dict.fromkeys(("1", "3"), "RuntimeError: the network is on fire")
        assert len(studio.episodes()) == 4  # what led to an error is kept, too
        assert len(studio.episodes(outcome="unmarked")) == 2


def test_workers_find_the_same_also_where_one_of_them_dies(tmp_path: Path, demonstrator: Evaluation) -> None:
    def kill_one(rollout: Rollout) -> None:
        for worker in multiprocessing.active_children()[:1]:
            worker.kill()

    seeds = tuple(rollout.seed for rollout in demonstrator.rollouts)
    with Studio(tmp_path) as studio:
        plan = Plan(agent="demonstrator", task="wiping", seeds=seeds)
        found = studio.evaluate(plan, workers=2, on_rollout=kill_one)
    same = {"episode_id": "", "wall_seconds": 0.0}
    for one, other in zip(found.rollouts, demonstrator.rollouts, strict=True):
        assert dataclasses.replace(one, **same) == dataclasses.replace(other, **same)
    assert found.curves == demonstrator.curves


def test_bad_plans_are_refused(tmp_path: Path) -> None:
    with pytest.raises(KeyError, match="demonstrator"):
        Plan.of("demonstrater", "wiping", (0,), tmp_path)
    with pytest.raises(KeyError, match="wiping"):
        Plan.of("demonstrator", "whiping", (0,), tmp_path)
    with pytest.raises(ValueError, match="Tell the task"):
        Plan.of("demonstrator", None, (0,), tmp_path)
    with pytest.raises(ValueError, match="no policy"):
        Plan.of("demonstrator", "wiping", (0,), tmp_path, hide=("images",))
    for seeds in ((), (1, 1), (-1,)):
        with pytest.raises(ValueError, match="seeds"):
            Plan.of("demonstrator", "wiping", seeds, tmp_path)
    spec = dataclasses.replace(SPEC, cameras={"left_wrist": (96, 96)})
    for settings, words in (
        ({"task": "drawing"}, "learned 'wiping'"),
        ({"spec": spec}, "left_wrist"),
        ({"replan_every": 21}, "20 steps"),
        ({"agent": "ws://localhost:1", "hide": ("wrench",)}, "where the policy runs"),
    ):
        with pytest.raises(ValueError, match=words):
            Plan(**{"agent": "riser", "task": "wiping", "seeds": (0,), "spec": SPEC, **settings})


# Policies


def test_a_policy_of_another_process_is_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(TOKEN, "open sesame")
    monkeypatch.setattr(wiping.Task, "time_limit", 3.0)
    with PolicyServer(Riser(), "open sesame") as server, Studio(tmp_path) as studio:
        plan = Plan.of(server.address, None, (4,), tmp_path, latency=0.05, replan_every=18)
        found = studio.evaluate(plan)
        summary = found.summary()
        assert (summary["run"], summary["task"], summary["step"]) == ("riser", "wiping", 7)
        assert (summary["successes"], summary["episodes"]) == (0, 1)
        assert summary["late_ticks"] == 0  # a chunk of .95 s, asked for every .9 s, answered after .05 s
        assert summary["seconds_per_episode"] == 3.0
        with studio.open(summary["ids"][0]) as episode:
            assert episode.header.agent == "riser"
            assert episode.header.provenance == {
                "evaluation": found.evaluation_id,
                "run": "riser",
                "step": 7,
                "execution": "replan",
                "replan_every": 18,
                "hidden": [],
                "latency_s": 0.05,
                "stiffness_table": "tuned",
            }


def test_a_policy_meets_the_controller_that_it_learned_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(TOKEN, "open sesame")
    monkeypatch.setattr(wiping.Task, "time_limit", 0.1)
    literal = dataclasses.replace(SPEC, stiffness_table="literal")
    with PolicyServer(Riser(literal), "open sesame") as server, Studio(tmp_path) as studio:
        plans = [
            Plan.of(server.address, None, (4,), tmp_path),
            Plan.of("all-low", "wiping", (4,), tmp_path, stiffness_table="literal"),
            Plan.of("all-low", "wiping", (4,), tmp_path),
        ]
        for plan, gain, low in zip(plans, (0.035, 0.035, 0.5), (20.0, 250.0, 20.0), strict=True):
            found = studio.evaluate(plan)
            assert found.summary()["stiffness_table"] == plan.table
            assert ("literal stiffness" in found.label) == (plan.table == "literal")
            with studio.open(found.rollouts[0].episode_id) as episode:
                servo = episode.header.control["servo"]
                assert (servo["stiffness_table"], servo["fdcc"]["p_gains"][-1]) == (plan.table, gain)
                stiffness = episode.columns("right/requested")["right/requested/stiffness"]
                assert stiffness[-1, -1] == low  # what the policy says itself is its own affair
        with pytest.raises(ValueError, match="learned with --stiffness-table literal"):
            Plan.of(server.address, None, (4,), tmp_path, stiffness_table="tuned")


def test_a_run_is_evaluated_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also that what is hidden is hidden, and that a process of its own answers the same."""
    monkeypatch.setattr(wiping.Task, "time_limit", 1.0)
    run = untrained(tmp_path / "runs" / "blank", "wiping")
    with Studio(tmp_path) as studio:
        plan = Plan.of("blank", None, (4,), tmp_path)
        found = studio.evaluate(dataclasses.replace(plan, hide=("wrench",)))
        assert found.summary()["errors"] == {}
        assert found.summary()["hidden"] == ["wrench"]
    twin = Twin(tasks.load("wiping"))
    twin.reset(3)
    history = History(plan.spec)
    history.add(observation := twin.observe())
    inputs = history.inputs(observation)
    assert inputs is not None
    pressed = dataclasses.replace(inputs, wrench=inputs.wrench + 10.0)

    def height(policy: Policy, seen: Inputs) -> float:
        return float(policy.predict(seen).arms[0].position[-1, 2])

    seeing, blind = load_policy(run), load_policy(run, hide_wrench=True)
    assert height(seeing, inputs) != height(seeing, pressed)
    assert height(blind, inputs) == height(blind, pressed)
    with pytest.raises(RuntimeError, match="No GPU for device 'cuda'"), Studio(tmp_path) as studio:
        studio.evaluate(dataclasses.replace(plan, device="cuda", seeds=(4, 5)))
    assert (
        len(list((tmp_path / "evaluations").iterdir())) == 1
    )  # nothing is said about a policy that did not run
    remote = start(run)
    assert remote.spec == seeing.spec
    assert height(remote, pressed) == height(seeing, pressed)
    remote.close()
    with pytest.raises(RuntimeError, match="no checkpoint"):
        start(tmp_path)


# References


def test_the_blind_see_nothing_of_the_scene(twin: Twin, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(references, "AVERAGED", range(2))
    references._average_of.cache_clear()
    lead = round(references.LEAD_IN / 0.01)
    one, other = (actions_of(twin, "average", seed)[lead:] for seed in (5, 6))
    references._average_of.cache_clear()
    assert one == other
    lengths = [len(demonstrated(twin, seed, 1.0).actions) for seed in range(2)]
    assert min(lengths) <= len(one) <= max(lengths)
    foreign = demonstrated(twin, 5 + references.ANOTHER, 1.0).actions
    replayed = actions_of(twin, "replay", 5)[lead:]
    for a, b in zip(replayed, foreign, strict=True):
        assert a.arms[0].target.base_from_target is not None
        np.testing.assert_array_equal(
            a.arms[0].target.base_from_target.vector, b.arms[0].target.base_from_target.vector
        )


def test_the_scene_is_as_drawn_after_an_agent_has_tried_it_out(twin: Twin) -> None:
    twin.reset(5)
    drawn = twin.digest()
    for name in REFERENCES.keys() - {"average"}:
        twin.reset(5)
        REFERENCES[name](twin)
        assert twin.digest() == drawn, name


def test_stiffness_alone_changes_where_it_is_wrong(twin: Twin) -> None:
    for name, wrong in (("all-low", 250.0), ("all-high", 750.0)):
        for right, other in zip(actions_of(twin, "demonstrator", 5), actions_of(twin, name, 5), strict=True):
            a, b = right.arms[0].target, other.arms[0].target
            assert isinstance(a, CartesianTarget)
            assert isinstance(b, CartesianTarget)
            assert b.stiffness.diagonals[0] == wrong
            np.testing.assert_array_equal(a.base_from_target.vector, b.base_from_target.vector)


def test_the_smooth_error_is_two_millimetres_long_and_slow() -> None:
    errors = smooth_errors(3, 3000, 2)
    assert errors.shape == (3000, 2, 3)
    length = np.sqrt((errors**2).sum(axis=2).mean(axis=0))
    np.testing.assert_allclose(length, references.ERROR, rtol=0.05)  # a little less: it grows from zero
    assert np.abs(errors[0]).max() == 0.0
    speed = np.abs(np.diff(errors, axis=0)).max() / 0.01
    assert speed < 2 * math.pi / references.ERROR_PERIODS[0] * 3 * references.ERROR
    assert not np.allclose(errors[:, 0], errors[:, 1])


def test_joint_control_is_off_by_that_error_and_by_nothing_else(twin: Twin) -> None:
    actions = actions_of(twin, "off-joint", 5)
    shown = demonstrated(twin, 5, 1.0)
    model = ur5e(twin.task.arms[0].flange_from_tcp)
    errors = smooth_errors(5, len(actions), 1)
    for action, q, error in list(zip(actions, shown.q_commands, errors, strict=True))[::50]:
        target = action.arms[0].target
        assert isinstance(target, JointTarget)
        meant, off = model.forward_kinematics(q[0]), model.forward_kinematics(target.q)
        np.testing.assert_allclose(off.position - meant.position, error[0], atol=2e-5)
        np.testing.assert_allclose(off.rotation, meant.rotation, atol=2e-4)
