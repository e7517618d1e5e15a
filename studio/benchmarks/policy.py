"""How long a policy takes to learn from a batch and to answer, and how much of that goes into reading data.

Measured by training for a few steps on made-up takes, through the same cache, loop and checkpoint as always,
each network in a process of its own. The published CompACT takes 7.0 s for a step of `paper` at 240x320 and
batch 8 on two idle cores, six of its seven decoder layers dead; LeRobot's ACT, with one layer, 3.9 s.
"""

from __future__ import annotations

import dataclasses
import os
import resource
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from controller.stiffness import StiffnessTable
from controller.types import Array
from policy.agent import Inputs, load_policy
from policy.cache import Size, build
from policy.config import PRESETS, TrainConfig
from policy.dataset import Dataset, fit
from policy.recording import ArmTrack, Recording

SECONDS = 4.0  # of each of two takes
CAMERAS = ("front", "right_wrist")
SIZE = (240, 320)  # [px] at which cameras record

SMALL_STEPS, PAPER_STEPS = 40, 4
ANSWERS = 50


def measure() -> dict[str, float]:
    """Medians: a training step, the share of it that reads data, an answer; and the peak of memory.

    `paper` is measured as it is, and `shallow` with one decoder layer. Seconds of the processor stand beside
    those of the clock: on a busy machine they say more.
    """
    paper = dataclasses.replace(PRESETS["paper"], max_height=SIZE[0], max_width=SIZE[1])
    shallow = dataclasses.replace(paper, decoder_layers=1)
    return {
        **{f"small_{name}": value for name, value in _apart(PRESETS["small"], SMALL_STEPS).items()},
        **{f"paper_{name}": value for name, value in _apart(paper, PAPER_STEPS).items()},
        **{f"shallow_{name}": value for name, value in _apart(shallow, PAPER_STEPS).items()},
    }


def step_seconds(
    config: TrainConfig, arms: tuple[str, ...], cameras: tuple[str, ...], threads: int, steps: int = 3
) -> float:
    """[s] of the clock for a training step of a task with these arms and cameras, here and now.

    Learns for a few steps in a process that gives way to others, as a job does; takes seconds.
    """
    config = dataclasses.replace(config, threads=threads)
    with ProcessPoolExecutor(1, get_context("spawn"), os.nice, (10,)) as pool:
        return pool.submit(_step_seconds, config, arms, cameras, steps).result()


def _step_seconds(config: TrainConfig, arms: tuple[str, ...], cameras: tuple[str, ...], steps: int) -> float:
    from policy.train import train

    changes: dict[str, Any] = {"validation": 0.0, "backbone_weights": "", "tensorboard": False}
    config = dataclasses.replace(config, **changes)
    with tempfile.TemporaryDirectory() as folder:
        size = (config.max_height, config.max_width) if config.images else None
        build(Path(folder) / "cache", [partial(_made_up, 0, arms, cameras)], max_size=size)
        ends = [time.perf_counter()]

        def note(metrics: Mapping[str, float]) -> None:
            ends.append(time.perf_counter())
            if metrics["step"] > steps:
                raise _Enough

        with suppress(_Enough):
            train(config, Dataset(Path(folder) / "cache"), Path(folder) / "measured", tell=note)
    return float(np.median(np.diff(ends)[1:]))  # the first one warms up


def _apart(config: TrainConfig, steps: int) -> dict[str, float]:
    """In a process that has no other memory and settings."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(_measure, config, steps).result()


class _Enough(Exception):
    """So many steps are measured; nothing is saved."""


def _measure(config: TrainConfig, steps: int) -> dict[str, float]:
    from policy.batches import Batches
    from policy.train import train

    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder) / "cache"
        size = (config.max_height, config.max_width)
        build(cache, [partial(_made_up, seed) for seed in (0, 1)], max_size=size)
        dataset = Dataset(cache)
        if config.backbone == "resnet18":
            config = dataclasses.replace(config, backbone_weights=str(_weights(Path(folder))))
        config = dataclasses.replace(config, validation=0.0, device="cpu")
        ends = [(time.perf_counter(), time.process_time())]

        def note(metrics: Mapping[str, float]) -> None:
            ends.append((time.perf_counter(), time.process_time()))
            if metrics["step"] == steps:
                raise _Enough

        with suppress(_Enough):
            train(config, dataset, Path(folder) / "measured", tell=note)
        step, cpu = np.median(np.diff(ends, axis=0)[max(1, steps // 10) :], axis=0).tolist()
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        found = {"step_s": step, "step_cpu_s": cpu, "peak_GB": peak}
        everything = np.arange(len(dataset))
        batches = Batches(dataset, fit(dataset, config, everything), config, everything)
        found["data_share"] = median(_seconds(batches.at, n) for n in range(10)) / step
        if config.preset == "small":
            train(dataclasses.replace(config, steps=1), dataset, Path(folder) / "run")
            policy = load_policy(Path(folder) / "run")
            inputs = [_inputs(dataset, config, sample) for sample in range(ANSWERS)]
            found["answer_ms"] = 1e3 * median(_seconds(policy.predict, given) for given in inputs)
        return found


def _seconds(call: Callable[[Any], object], argument: Any) -> float:
    start = time.perf_counter()
    call(argument)
    return time.perf_counter() - start


def _inputs(dataset: Dataset, config: TrainConfig, sample: int) -> Inputs:
    index = np.array([sample])
    seen = dataset.seen(index)
    wrench = dataset.wrench(index, config.wrench_history)[0]
    images = dict(zip(dataset.cameras, dataset.images(index)[0], strict=True))
    return Inputs(0.0, seen.base_from_tcp[0], seen.q[0], seen.gripper[0], wrench, images)


def _weights(folder: Path) -> Path:
    """A file as torchvision's, with which ResNet-18 normalises as it does in the published code."""
    from safetensors.torch import save_file

    from policy.vision import ResNet18

    path = folder / "resnet18.safetensors"
    save_file(ResNet18(frozen=True).state_dict(), path)
    return path


def _made_up(
    seed: int, arms: tuple[str, ...] = ("right",), cameras: tuple[str, ...] = CAMERAS
) -> AbstractContextManager[Recording]:
    return nullcontext(_MadeUp(seed, arms, cameras))


class _MadeUp:
    """A take of arms that wander, seen by cameras that show noise; implements `Recording`."""

    task = "made-up"
    stiffness_table: StiffnessTable = "tuned"

    def __init__(self, seed: int, arms: tuple[str, ...], cameras: tuple[str, ...]) -> None:
        self.name, self.arms = f"take {seed}", arms
        self.cameras: Mapping[str, Size] = dict.fromkeys(cameras, SIZE)
        self.span = (0.0, SECONDS)
        self._rng = np.random.default_rng(seed)

    def track(self, arm: str) -> ArmTrack:
        states, actions = np.arange(0.0, SECONDS, 0.002), np.arange(0.0, SECONDS, 0.01)
        return ArmTrack(
            state_time=states,
            base_from_tcp=self._poses(len(states)),
            q=self._wander(len(states), 6),
            q_command=self._wander(len(states), 6),
            wrench=self._wander(len(states), 6),
            gripper=np.zeros(len(states)),
            action_time=actions,
            base_from_target=self._poses(len(actions)),
            stiffness=np.tile([500.0, 0, 0, 500, 0, 500, 35, 0, 0, 35, 0, 35], (len(actions), 1)),
            gripper_command=np.zeros(len(actions)),
        )

    def image_times(self, camera: str) -> Array:
        return np.arange(0.0, SECONDS, 0.05)

    def image(self, camera: str, index: int) -> Array:
        return self._rng.integers(0, 256, (*SIZE, 3), np.uint8)

    def _wander(self, n: int, width: int) -> Array:
        return np.asarray(self._rng.normal(0.0, 0.01, (n, width)).cumsum(0))

    def _poses(self, n: int) -> Array:
        return np.concatenate((self._wander(n, 3), np.tile([0.0, 1.0, 0.0, 0.0], (n, 1))), axis=1)
