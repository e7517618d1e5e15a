"""Training: it learns, stops when told, goes on to the same numbers, alone or in company."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from synthetic import Synthetic, dataset_of

from controller.types import ArmState, CartesianTarget, Image, Observation, Pose, Wrench
from policy import checkpoint
from policy.agent import ChunkExecutor, History, Inputs, load_policy, read_spec
from policy.config import TrainConfig
from policy.dataset import Dataset
from policy.learner import METRICS, Learner
from policy.machine import machine
from policy.train import Diverged, train

TINY = TrainConfig(
    width=32,
    feedforward=64,
    heads=2,
    encoder_layers=1,
    decoder_layers=1,
    chunk_seconds=0.5,
    max_height=48,
    max_width=48,
    steps=8,
    batch=4,
    warm_up=2,
    validate_every=4,
    save_every=4,
    validation=0.3,
    device="cpu",
    threads=1,  # two that wait for each other take minutes on a busy machine
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Of three takes, whose arm goes to where the square is."""
    takes = [Synthetic(f"take{n}", goal=goal) for n, goal in enumerate((-0.8, 0.8, 0.1))]
    return dataset_of(tmp_path_factory.mktemp("cache") / "synthetic", *takes)


def weights(run: Path, file: str = checkpoint.TRAINING) -> dict[str, torch.Tensor]:
    return load_file(checkpoint.find(run) / file)


def metrics(run: Path) -> list[dict[str, float]]:
    """Without what differs from time to time."""
    lines = [json.loads(line) for line in (run / METRICS).read_text().splitlines()]
    return [{name: value for name, value in line.items() if name != "seconds"} for line in lines]


def inputs_of(dataset: Dataset, sample: int) -> Inputs:
    index = np.array([sample])
    seen = dataset.seen(index)
    return Inputs(
        time=1.0,
        base_from_tcp=seen.base_from_tcp[0],
        q=seen.q[0],
        gripper=seen.gripper[0],
        wrench=dataset.wrench(index, 16)[0],
        images=dict(zip(dataset.cameras, dataset.images(index)[0], strict=True)),
    )


def test_two_takes_are_learned_by_heart(tmp_path: Path) -> None:
    cameras = {"front": (32, 32)}
    takes = [Synthetic(str(goal), goal=goal, cameras=cameras) for goal in (-0.8, 0.8)]
    two = dataset_of(tmp_path / "cache", *takes)
    quick = {"steps": 200, "dropout": 0.0, "brightness": 0.0, "lr": 1e-3, "ema": 0.9}
    config = dataclasses.replace(TINY, **quick, validation=0.0, warm_up=10, clip=1.0, save_every=1000)
    result = train(config, two, tmp_path / "run")
    assert result.is_finished
    policy = load_policy(tmp_path / "run")
    blind = load_policy(tmp_path / "run", hide_images=True)
    # At the start both arms stand alike: only images tell the two takes apart, by 144 mm at the chunk's end.
    errors, blind_errors = [], []
    for sample in (0, 20):
        targets, _ = two.targets(np.array([sample]), config.chunk, config.rate)
        wanted = targets.base_from_target[0, :, 0, :3]
        for asked, kept in ((policy, errors), (blind, blind_errors)):
            (arm,) = asked.predict(inputs_of(two, sample)).arms
            kept.append(np.abs(arm.position - wanted).max())
    assert max(errors) < 0.025
    assert max(blind_errors) > 0.05
    (arm,) = policy.predict(inputs_of(two, 10)).arms
    np.testing.assert_allclose(arm.translational[-1], np.eye(3) * 250.0, atol=25.0)


def test_a_run_that_goes_on_in_the_middle_of_a_round_ends_in_the_same_numbers(
    tmp_path: Path, dataset: Dataset
) -> None:
    config = dataclasses.replace(TINY, cvae=True, shift=2)  # all that draws random numbers
    train(config, dataset, tmp_path / "whole")

    def stop(told: object) -> None:
        if told["step"] == 4:
            os.kill(os.getpid(), signal.SIGTERM)

    first = train(config, dataset, tmp_path / "parts", tell=stop)
    assert (first.step, first.is_finished) == (5, False)
    assert read_spec(tmp_path / "parts").step == 5
    second = train(config, dataset, tmp_path / "parts", resume=True)
    assert (second.step, second.is_finished) == (8, True)
    for file in (checkpoint.MODEL, checkpoint.TRAINING):
        whole, parts = weights(tmp_path / "whole", file), weights(tmp_path / "parts", file)
        assert whole.keys() == parts.keys()
        assert all(torch.equal(whole[name], parts[name]) for name in whole)
    assert metrics(tmp_path / "whole") == metrics(tmp_path / "parts")
    best = [checkpoint.find(tmp_path / run / "checkpoints" / "best").name for run in ("whole", "parts")]
    assert best[0] == best[1]


def test_metrics_behind_the_checkpoint_are_told_again(tmp_path: Path, dataset: Dataset) -> None:
    run = tmp_path / "run"
    crash = RuntimeError("the machine dies after the checkpoint of step 4")

    def die(told: object) -> None:
        if told["step"] == 7:
            raise crash

    with pytest.raises(RuntimeError, match="the machine dies"):
        train(TINY, dataset, run, tell=die)
    with (run / METRICS).open("a") as file:
        file.write('{"step": 8, "lo')  # torn
    train(TINY, dataset, run, resume=True)
    assert [line["step"] for line in metrics(run)] == list(range(1, 9))


def test_a_checkpoint_gives_the_same_actions_as_before(tmp_path: Path, dataset: Dataset) -> None:
    train(TINY, dataset, tmp_path / "run")
    first, again = (load_policy(tmp_path / "run").predict(inputs_of(dataset, 7)) for _ in range(2))
    for arm, other in zip(first.arms, again.arms, strict=True):
        for name in ("position", "wxyz", "translational", "rotational", "gripper"):
            assert np.array_equal(getattr(arm, name), getattr(other, name))
    assert first.time == 1.0
    assert first.period == 0.05
    spec = read_spec(tmp_path / "run")
    assert (spec.task, spec.arms, spec.control, spec.step) == ("wiping", ("right",), "cartesian", 8)
    assert spec.cameras == {"front": (48, 48), "wrist": (48, 48)}


def test_what_was_saved_says_what_the_network_said(tmp_path: Path, dataset: Dataset) -> None:
    with machine("cpu", 1) as here:
        learner = Learner.begin(TINY, dataset, tmp_path / "run", here, resume=False)
        batch, _ = learner.batches.at(0)
        learner.prepare()
        learner.model.loss(batch)["loss"].backward()
        learner.optimizer.step()
        learner.average()
        learner.step = 1
        learner.save()
    sample = np.array([7])
    values = learner.averaged.eval()(learner.batches.of(sample)).detach().double().numpy()
    said = learner.features.decode_action(values, dataset.seen(sample))
    (arm,) = load_policy(tmp_path / "run").predict(inputs_of(dataset, 7)).arms
    np.testing.assert_allclose(arm.position, said.base_from_target[0, :, 0, :3], atol=1e-6)
    np.testing.assert_allclose(arm.translational, said.stiffness[0, :, 0, 0], rtol=1e-5)


def test_last_and_best_point_to_checkpoints_and_others_go(tmp_path: Path, dataset: Dataset) -> None:
    train(TINY, dataset, tmp_path / "run")
    kept = {path.name for path in (tmp_path / "run" / "checkpoints").glob("[0-9]*")}
    assert checkpoint.find(tmp_path / "run").name == "000008"
    best = checkpoint.find(tmp_path / "run" / "checkpoints" / "best")
    assert kept == {"000008", best.name}
    validated = {
        line["step"]: line["validation"] for line in metrics(tmp_path / "run") if "validation" in line
    }
    assert validated.keys() == {4, 8}
    assert int(best.name) == min(validated, key=validated.get)
    assert {"position_mm", "rotation_deg", "stiffness_N_per_m"} <= metrics(tmp_path / "run")[-1].keys()


PROCESS = """
import sys, dataclasses
from pathlib import Path
sys.path[:0] = [{tests!r}, {repository!r}]
import torch
torch.set_num_threads(1)
from policy.dataset import Dataset
from policy.train import train
from test_policy_train import shared_config
train(shared_config(2), Dataset(Path({cache!r})), Path({run!r}))
"""


def shared_config(batch: int) -> TrainConfig:
    # Chance that is drawn per process (dropout, latent) is switched off; augmentation is drawn per sample.
    return dataclasses.replace(
        TINY, batch=batch, dropout=0.0, state_dropout=0.0, past_end="mask", steps=4, threads=1
    )


def test_two_processes_equal_one_with_the_double_batch(tmp_path: Path, dataset: Dataset) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    tests, run = Path(__file__).parent, str(tmp_path / "pair")
    program = PROCESS.format(
        tests=str(tests), repository=str(tests.parent), cache=str(dataset.folder), run=run
    )
    pair = [
        subprocess.Popen(
            [sys.executable, "-c", program],
            env={
                **os.environ,
                **{"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": "2"},
                **{"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port},
            },
        )
        for rank in (0, 1)
    ]
    train(shared_config(4), dataset, tmp_path / "one")
    assert [process.wait(120) for process in pair] == [0, 0]
    one, two = weights(tmp_path / "one"), weights(tmp_path / "pair")
    apart = {name: (two[name] - value).abs() for name, value in one.items()}
    for name, value in one.items():
        if name.startswith("exp_avg/"):  # what the gradients came to
            assert apart[name].norm() <= 0.02 * value.norm(), name
    # Adam makes up to a step's length, 5e-4, of the rounding of a gradient near zero; few differ so.
    weight = {name: value for name, value in apart.items() if name.startswith("weight/")}
    beyond = [(value > 1e-5 + 1e-4 * one[name].abs()).sum() for name, value in weight.items()]
    assert sum(beyond) <= 1e-3 * sum(value.numel() for value in weight.values())
    assert all(value.max() < 1e-4 for value in weight.values())
    losses = [[line["gradient"] for line in metrics(tmp_path / run)] for run in ("one", "pair")]
    np.testing.assert_allclose(losses[0], losses[1], rtol=1e-3)


def test_a_loss_that_is_not_finite_stops_the_run_and_names_its_batch(
    tmp_path: Path, dataset: Dataset
) -> None:
    wild = dataclasses.replace(TINY, lr=1e30, save_every=1, clip=1e30, steps=50)
    with pytest.raises(Diverged, match=r"Step \d+ has loss .* not finite\. Its batch: take\d at \d\.\d\d s"):
        train(wild, dataset, tmp_path / "run")
    good = weights(tmp_path / "run")
    assert all(torch.isfinite(value).all() for value in good.values())


def test_weights_that_are_not_finite_are_not_kept(tmp_path: Path, dataset: Dataset) -> None:
    """A step may overflow though its loss and its gradient are finite."""
    run = tmp_path / "run"
    train(dataclasses.replace(TINY, steps=4), dataset, run)
    kept = weights(run)
    checked = dataclasses.replace(TINY, steps=4)
    with machine("cpu", 1) as here:
        learner = Learner.begin(checked, dataset, run, here, resume=True)
        next(learner.model.parameters()).data[0] = np.inf
        with pytest.raises(Diverged, match=r"After step 4 the weights are not finite"):
            learner.save()
    again = weights(run)
    assert all(torch.equal(kept[name], again[name]) for name in kept)


def test_a_damaged_checkpoint_is_named(tmp_path: Path, dataset: Dataset) -> None:
    train(TINY, dataset, tmp_path / "run")
    folder = checkpoint.find(tmp_path / "run")
    for file in (checkpoint.TRAINING, checkpoint.MODEL):
        (folder / file).write_bytes((folder / file).read_bytes()[:100])
        with pytest.raises(ValueError, match=rf"{file} cannot be read"):
            train(TINY, dataset, tmp_path / "run", resume=True)
    (folder / checkpoint.MODEL).unlink()
    with pytest.raises(ValueError, match=r"model\.safetensors cannot be read: No such file"):
        load_policy(tmp_path / "run")


def test_other_settings_or_other_takes_do_not_go_on(tmp_path: Path, dataset: Dataset) -> None:
    train(TINY, dataset, tmp_path / "run")
    with pytest.raises(ValueError, match=r"was begun with lr 0\.0005, not 0\.1"):
        train(dataclasses.replace(TINY, lr=0.1), dataset, tmp_path / "run", resume=True)
    other = dataset_of(tmp_path / "other", *(Synthetic(str(n)) for n in range(3)))
    with pytest.raises(ValueError, match="learned from other takes"):
        train(TINY, other, tmp_path / "run", resume=True)
    with pytest.raises(FileExistsError, match="is a run already"):
        train(TINY, dataset, tmp_path / "run")
    with pytest.raises(FileNotFoundError, match="No run or checkpoint at"):
        train(TINY, dataset, tmp_path / "nowhere", resume=True)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_refused() -> None:
    with pytest.raises(RuntimeError, match="No GPU for --device cuda"), machine("cuda", 0):
        pass


def test_a_checkpoint_of_another_task_or_version_is_refused(tmp_path: Path, dataset: Dataset) -> None:
    train(TINY, dataset, tmp_path / "run")
    spec = read_spec(tmp_path / "run")
    spec.check("wiping", ["right"], ["front", "wrist", "more"])
    with pytest.raises(ValueError, match="learned 'wiping', not 'drawing'"):
        spec.check("drawing", ["right"], ["front", "wrist"])
    with pytest.raises(ValueError, match=r"needs the cameras \['wrist'\]"):
        spec.check("wiping", ["right"], ["front"])
    with pytest.raises(ValueError, match=r"learned with --stiffness-table tuned; .* set up for literal"):
        spec.check("wiping", ["right"], ["front", "wrist"], "literal")
    description = checkpoint.find(tmp_path / "run") / checkpoint.DESCRIPTION
    told = json.loads(description.read_text())
    older = {name: value for name, value in told["spec"].items() if name != "stiffness_table"}
    description.write_text(json.dumps({**told, "spec": older}))
    assert read_spec(tmp_path / "run") == spec  # checkpoints of before there was a choice
    description.write_text(json.dumps({**told, "format": 99}))
    with pytest.raises(ValueError, match="has format 99; this version reads 1"):
        load_policy(tmp_path / "run")
    description.write_text(json.dumps({**told, "config": {**told["config"], "magic": 1}}))
    with pytest.raises(ValueError, match="settings that this version does not know: magic"):
        load_policy(tmp_path / "run")


def test_joints_in_and_out(tmp_path: Path, dataset: Dataset) -> None:
    config = dataclasses.replace(TINY, policy="act", wrench=False, steps=2)
    train(config, dataset, tmp_path / "run")
    policy = load_policy(tmp_path / "run")
    assert policy.spec.control == "joint"
    assert policy.spec.wrench_history == 0
    (arm,) = policy.predict(inputs_of(dataset, 0)).arms
    assert arm.q.shape == (10, 6)
    assert arm.translational is None


def observation(time: float, image_time: float) -> Observation:
    """An arm that moves along x at 1 m/s and feels its own time as a force."""
    pose = Pose(np.array([time, 0.0, 0.2]), np.array([0.0, 1.0, 0.0, 0.0]))
    wrench = Wrench(np.array([time, 0.0, 0.0]), np.zeros(3))
    arm = ArmState(time, np.full(6, time), np.zeros(6), np.zeros(6), pose, wrench, 0.5)
    pixels = np.zeros((60, 80, 3), np.uint8)
    images = {name: Image(image_time, pixels) for name in ("front", "wrist")}
    return Observation(time, (arm,), images)


def test_a_policy_without_forces_drives_from_observations(tmp_path: Path, dataset: Dataset) -> None:
    train(dataclasses.replace(TINY, wrench=False), dataset, tmp_path / "run")
    policy = load_policy(tmp_path / "run")
    history = History(policy.spec)
    for tick in range(10):
        history.add(now := observation(tick * 0.01, tick * 0.01))
    inputs = history.inputs(now)
    assert inputs.wrench.shape == (0, 1, 6)
    assert policy.predict(inputs).arms[0].position.shape == (10, 3)


def test_a_policy_drives_from_observations(tmp_path: Path, dataset: Dataset) -> None:
    train(TINY, dataset, tmp_path / "run")
    policy = load_policy(tmp_path / "run")
    history, executor = History(policy.spec), ChunkExecutor(n_arms=1)
    for tick in range(100):
        now = observation(tick * 0.01, max(0, tick - 3) * 0.01)  # images are three ticks late
        history.add(now)
        if executor.wants(now.time):
            inputs = history.inputs(now)
            executor.add(policy.predict(inputs))
    assert inputs.time == pytest.approx(now.images["front"].time if executor.wants(now.time) else inputs.time)
    assert inputs.base_from_tcp[0, 0] == pytest.approx(inputs.time)  # not where the arm is by now
    expected = np.maximum(inputs.time - 0.01 * np.arange(15, -1, -1), 0.0)
    np.testing.assert_allclose(inputs.wrench[:, 0, 0], expected, atol=1e-9)
    assert inputs.images["front"].shape == (48, 48, 3)
    target = executor.action(1.0).arms[0].target
    assert isinstance(target, CartesianTarget)
    assert executor.late == 0
    # A moment that nobody remembers has no state: a camera that stands still, or of before the start.
    for tick in range(100, 300):
        history.add(stuck := observation(tick * 0.01, 0.97))
    assert history.inputs(stuck) is None
    history.reset()
    history.add(begun := observation(5.0, 4.95))
    assert history.inputs(begun) is None


def test_training_does_not_need_the_main_thread(tmp_path: Path, dataset: Dataset) -> None:
    results = []
    config = dataclasses.replace(TINY, steps=1)
    thread = threading.Thread(target=lambda: results.append(train(config, dataset, tmp_path / "run")))
    thread.start()
    thread.join()
    assert results[0].is_finished
