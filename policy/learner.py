"""What learns in a run: network, averaged network, optimiser, step; and how they lie on the disk."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import platform
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from controller.types import Array
from policy import checkpoint
from policy import dataset as datasets
from policy.act import Act, Batch
from policy.batches import Batches
from policy.checkpoint import Checkpoint, PolicySpec
from policy.config import TrainConfig
from policy.dataset import Dataset
from policy.features import Features
from policy.machine import Machine, is_finite
from policy.vision import ResNet18

VALIDATED = 128  # samples at most, evenly over the takes kept aside
METRICS = "metrics.jsonl"
MOMENTS = ("exp_avg", "exp_avg_sq")  # of AdamW


class Diverged(RuntimeError):
    """A loss, a gradient or weights that are not finite; the checkpoints before it are good."""


class Learner:
    """Network, averaged network, optimiser and step of a run, and how they lie on the disk."""

    def __init__(
        self, config: TrainConfig, dataset: Dataset, run: Path, here: Machine, features: Features
    ) -> None:
        self.config, self.dataset, self.run, self.machine = config, dataset, run, here
        self.features = features
        self.step = 0
        self.best: float | None = None
        self.is_best = False  # whether the last validation was the best
        self._validation: float | None = None
        training, aside = dataset.split(config.validation, config.seed)
        self.batches = Batches(dataset, features, config, training, here.rank, here.world)
        self._aside = aside[:: max(1, math.ceil(len(aside) / VALIDATED))]
        torch.manual_seed(config.seed)
        cameras = dataset.cameras if config.images else {}
        self.model = Act.of(config, features.encoding, cameras)
        if config.backbone_weights and isinstance(self.model.vision, ResNet18):
            self.model.vision.read_weights(Path(config.backbone_weights))
        self.model.to(here.device)
        self.averaged = self.model  # what is validated and saved to run
        if config.ema:
            self.averaged = copy.deepcopy(self.model).requires_grad_(False)
        self.objective: nn.Module = Objective(self.model)
        if here.world > 1:
            self.objective = DistributedDataParallel(self.objective)
        self.optimizer = torch.optim.AdamW(
            self._parameter_groups(), weight_decay=config.weight_decay, fused=True
        )

    @staticmethod
    def begin(config: TrainConfig, dataset: Dataset, run: Path, here: Machine, *, resume: bool) -> Learner:
        """A new run in the folder `run`, or the one that lies there."""
        if resume:
            folder = checkpoint.find(run)
            told = checkpoint.read(folder)
            _check_same(told, config, dataset)
            learner = Learner(config, dataset, run, here, told.features)
            learner._restore(told, folder)
            return learner
        if (run / checkpoint.CHECKPOINTS).exists():
            raise FileExistsError(f"{run} is a run already; resume it, or give another name.")
        training, _ = dataset.split(config.validation, config.seed)
        features = datasets.fit(dataset, config, training)
        here.wait()
        if here.leads:
            run.mkdir(parents=True, exist_ok=True)
            names = [take.name for take in dataset.takes]
            fields: dict[str, Any] = {"task": dataset.task, "data": dataset.folder.name, "takes": names}
            fields |= {"config": dataclasses.asdict(config), "versions": versions()}
            (run / checkpoint.CONFIG).write_text(json.dumps(fields, indent=1))
        return Learner(config, dataset, run, here, features)

    # A step

    @property
    def lr(self) -> float:
        """Of the step to come: warm-up, then half a cosine to zero."""
        return self.config.lr * self._schedule()

    def prepare(self) -> None:
        """Before a step: its random numbers and its learning rate."""
        words = np.random.SeedSequence([self.config.seed, self.step, self.machine.rank]).generate_state(2)
        torch.manual_seed(int(words[0]) << 32 | int(words[1]))
        self.optimizer.zero_grad()
        for group in self.optimizer.param_groups:
            group["lr"] = group["full_lr"] * self._schedule()

    def average(self) -> None:
        """After a step: move the averaged weights; at first fast, or they would keep to the start."""
        decay = min(self.config.ema, (1 + self.step) / (10 + self.step))
        if self.averaged is not self.model:
            with torch.no_grad():
                for mean, weight in zip(self.averaged.parameters(), self.model.parameters(), strict=True):
                    mean.lerp_(weight, 1.0 - decay)

    def is_due(self, every: int) -> bool:
        """At the end of a run, too."""
        return self.step % every == 0 or self.step == self.config.steps

    def check_finite(self, loss: Tensor, norm: Tensor, samples: Array) -> None:
        """Raise `Diverged` where a step's loss or gradient norm is not, before it changes any weight."""
        if is_finite(loss, norm):
            return
        raise Diverged(
            f"Step {self.step + 1} has loss {loss.item():g} and a gradient of {norm.item():g}: not finite. "
            f"Its batch: {self.dataset.describe(samples)}. The last checkpoint is good; try a smaller --lr."
        )

    def _schedule(self) -> float:
        warm, steps = self.config.warm_up, self.config.steps
        rising = min(1.0, (self.step + 1) / max(1, warm))
        return rising * 0.5 * (1 + math.cos(math.pi * max(0, self.step - warm) / max(1, steps - warm)))

    def _parameter_groups(self) -> list[dict[str, Any]]:
        lrs = {True: self.config.backbone_lr or self.config.lr, False: self.config.lr}
        groups: dict[bool, list[Tensor]] = {True: [], False: []}
        for name, parameter in self.model.named_parameters():
            groups[name.startswith("vision.")].append(parameter)
        return [{"params": groups[seen], "full_lr": lr} for seen, lr in lrs.items() if groups[seen]]

    # Validation

    def validate(self) -> dict[str, float]:
        """The averaged network on the takes kept aside, as it will run: loss, and errors in known units."""
        if not len(self._aside):
            return {}
        self.averaged.eval()
        sums: dict[str, float] = defaultdict(float)  # of the loss, and of its groups
        errors = []
        for indices in np.array_split(self._aside, math.ceil(len(self._aside) / self.config.batch)):
            batch = self.batches.of(indices).to(self.machine.device)
            with torch.no_grad(), self.machine.autocast():
                values = self.averaged(batch)
                told = self.averaged.errors(values, batch)
            for name, value in told.items():
                sums[name] += value.item() * len(indices)
            errors.append(self._errors(values.double().cpu().numpy(), indices))
        self.model.train()
        losses = {name: total / len(self._aside) for name, total in sums.items()}
        self._validation = losses.pop("loss")
        self.is_best = self.best is None or self._validation < self.best
        self.best = self._validation if self.is_best else self.best
        means = {name: float(np.mean([e[name] for e in errors])) for name in errors[0]}
        groups = {f"validation_{name}": value for name, value in losses.items()}
        return {"validation": self._validation, **groups, **means}

    def _errors(self, values: Array, indices: Array) -> dict[str, float]:
        """Mean errors of predictions (n, chunk, width) over the steps that lie in the takes."""
        seen = self.dataset.seen(indices)
        wanted, valid = self.dataset.targets(indices, self.config.chunk, self.config.rate)
        told = self.features.decode_action(values, seen)
        if told.q is not None and wanted.q is not None:
            return {"joints_deg": float(np.degrees(np.abs(told.q - wanted.q)[valid].mean()))}
        assert told.base_from_target is not None
        assert wanted.base_from_target is not None
        assert told.stiffness is not None
        assert wanted.stiffness is not None
        off = told.base_from_target - wanted.base_from_target
        same = np.abs((told.base_from_target[..., 3:] * wanted.base_from_target[..., 3:]).sum(-1)).clip(0, 1)
        return {
            "position_mm": float(1e3 * np.linalg.norm(off[..., :3], axis=-1)[valid].mean()),
            "rotation_deg": float(np.degrees(2 * np.arccos(same))[valid].mean()),
            "stiffness_N_per_m": float(
                np.abs(told.stiffness - wanted.stiffness)[valid][:, :, 0].max((-1, -2)).mean()
            ),
        }

    # On the disk

    @contextmanager
    def metrics(self) -> Iterator[Callable[[Mapping[str, float]], None]]:
        """Append to the run's metrics, behind those of the steps that it has done; and to TensorBoard."""
        if not self.machine.leads:
            yield lambda metrics: None
            return
        path = self.run / METRICS
        told = path.read_text().splitlines() if path.exists() else []
        kept = [line for line in told if _step_of(line) <= self.step]
        path.write_text("".join(f"{line}\n" for line in kept))
        board = _tensorboard(self.run) if self.config.tensorboard else None
        with path.open("a", buffering=1) as file:

            def note(metrics: Mapping[str, float]) -> None:
                file.write(json.dumps(metrics) + "\n")
                if board is not None:
                    for name, value in metrics.items():
                        board.add_scalar(name, value, metrics["step"])

            yield note
        if board:
            board.close()

    def save(self) -> Path:
        """A checkpoint of this step; the last, and the best where the last validation was.

        Raises FileNotFoundError where somebody removed the run meanwhile, `Diverged` where weights or moments
        are not finite any more: then the checkpoint before stays the last.
        """
        if not (self.run / checkpoint.CONFIG).exists():
            raise FileNotFoundError(f"Somebody removed {self.run / checkpoint.CONFIG} while the run learned.")
        state = self._training_state()
        if not is_finite(*state.values()):
            raise Diverged(f"After step {self.step} the weights are not finite; try a smaller --lr.")
        config, encoding = self.config, self.features.encoding
        spec = PolicySpec(
            run=self.run.name,
            task=self.dataset.task,
            arms=self.dataset.arms,
            cameras=self.dataset.cameras if config.images else {},
            control=encoding.control,
            rate=config.rate,
            chunk=config.chunk,
            wrench_history=config.wrench_history if config.wrench else 0,
            wrench_rate=1.0 / datasets.GRID,
            step=self.step,
            stiffness_table=self.dataset.stiffness_table,
        )
        told = Checkpoint(
            spec=spec,
            config=config,
            features=self.features,
            recorded=self.dataset.recorded,
            data=self.dataset.folder.name,
            validation=self._validation,
            best=self.best,
            versions=versions(),
        )
        files = {
            checkpoint.MODEL: save(_on_cpu(self.averaged.state_dict())),
            checkpoint.TRAINING: save(_on_cpu(state)),
        }
        is_best, self.is_best = self.is_best, False
        return checkpoint.write(self.run, told, files, is_best=is_best)

    def _training_state(self) -> dict[str, Tensor]:
        state = {f"weight/{name}": value for name, value in self.model.state_dict().items()}
        for name, parameter in self.model.named_parameters():
            for moment in MOMENTS:
                state[f"{moment}/{name}"] = self.optimizer.state[parameter][moment]
        return state

    def _restore(self, told: Checkpoint, folder: Path) -> None:
        self.step, self.best, self._validation = told.spec.step, told.best, told.validation
        averaged, state = (
            checkpoint.read_tensors(folder, f) for f in (checkpoint.MODEL, checkpoint.TRAINING)
        )
        weights = {name: value for name, value in state.items() if name.startswith("weight/")}
        try:
            self.averaged.load_state_dict(averaged)  # the raw weights come after
            self.model.load_state_dict({name.removeprefix("weight/"): w for name, w in weights.items()})
        except RuntimeError as error:
            raise ValueError(f"{folder} does not fit this version: {error}") from error
        for name, parameter in self.model.named_parameters():
            kept: dict[str, Tensor] = {"step": torch.tensor(float(self.step), device=parameter.device)}
            for moment in MOMENTS:  # in the memory layout of the weight, which the fused step relies on
                kept[moment] = torch.empty_like(parameter).copy_(state[f"{moment}/{name}"])
            self.optimizer.state[parameter] = kept


class Objective(nn.Module):
    """The loss as a module's call, which is what DDP watches."""

    def __init__(self, model: Act) -> None:
        super().__init__()
        self.model = model

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        return self.model.loss(batch)


def versions() -> dict[str, str]:
    return {"python": platform.python_version(), "torch": torch.__version__, "numpy": np.__version__}


def _check_same(told: Checkpoint, config: TrainConfig, dataset: Dataset) -> None:
    """That a run to go on with is this one. Where it computes may differ."""
    free = {"device": config.device, "threads": config.threads, "tensorboard": config.tensorboard}
    before = dataclasses.asdict(dataclasses.replace(told.config, **free))  # type: ignore[arg-type]
    now = dataclasses.asdict(config)
    if changed := [
        f"{name} {before[name]!r}, not {now[name]!r}" for name in now if now[name] != before[name]
    ]:
        raise ValueError(f"The run {told.spec.run} was begun with {'; '.join(changed)}.")
    if told.data != dataset.folder.name:
        raise ValueError(f"The run {told.spec.run} learned from other takes; begin a new run.")


def _on_cpu(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().cpu().contiguous() for name, value in tensors.items()}


def _step_of(line: str) -> float:
    try:
        return float(json.loads(line)["step"])
    except (json.JSONDecodeError, KeyError):
        return math.inf  # torn by a crash


def _tensorboard(run: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ModuleNotFoundError as error:
        raise RuntimeError("--tensorboard needs the package: pip install tensorboard") from error
    return SummaryWriter(run / "tensorboard")
