"""Training. The loop stands in `_learn`; each step is a function of the run's seed and its number alone.

Random numbers are drawn from (seed, step, process), batches likewise, so that weights and the optimiser's
moments are all that a run needs to go on to the same numbers, from any step.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from torch import nn

from policy.config import TrainConfig
from policy.dataset import Dataset
from policy.learner import Diverged, Learner
from policy.machine import StopRequest, machine

__all__ = ["Diverged", "TrainResult", "train"]

Tell = Callable[[Mapping[str, float]], None]


@dataclass(frozen=True, slots=True)
class TrainResult:
    """How a run ended."""

    run: Path
    step: int
    is_finished: bool  # False: it was asked to stop, and can go on
    loss: float  # of the last step
    validation: float | None  # the least loss on the takes kept aside
    seconds: float


def train(
    config: TrainConfig,
    dataset: Dataset,
    run: Path,
    *,
    resume: bool = False,
    tell: Tell = lambda metrics: None,
) -> TrainResult:
    """Learn from a dataset, or go on from the last checkpoint in `run`. One call per process of the run.

    `tell` is told the metrics of each step. SIGTERM makes it save at once and return. Raises `Diverged`;
    ValueError where the run to go on with had other settings or other takes.
    """
    with machine(config.device, config.threads) as here, StopRequest() as stop:
        return _learn(Learner.begin(config, dataset, run, here, resume=resume), stop, tell)


def _learn(learner: Learner, stop: StopRequest, tell: Tell) -> TrainResult:
    config, here, began = learner.config, learner.machine, time.monotonic()
    loss = math.nan
    with learner.metrics() as note:
        for batch, samples in learner.batches.stream(learner.step, config.steps):
            learner.prepare()
            with here.autocast():
                told = learner.objective(batch.to(here.device))
            told["loss"].backward()
            norm = nn.utils.clip_grad_norm_(learner.model.parameters(), config.clip)
            learner.check_finite(told["loss"], norm, samples)
            learner.optimizer.step()
            learner.average()
            learner.step += 1
            metrics = {name: value.item() for name, value in told.items()}
            loss = metrics["loss"]
            stopping = here.any(stop.asked)
            if here.leads:
                metrics |= {"lr": learner.lr, "gradient": norm.item(), "seconds": time.monotonic() - began}
                metrics |= learner.validate() if learner.is_due(config.validate_every) else {}
                note({"step": learner.step, **metrics})
                tell({"step": learner.step, **metrics})
                if stopping or learner.is_best or learner.is_due(config.save_every):
                    learner.save()
            if stopping:
                break
        here.wait()
    seconds = time.monotonic() - began
    return TrainResult(learner.run, learner.step, learner.step >= config.steps, loss, learner.best, seconds)
