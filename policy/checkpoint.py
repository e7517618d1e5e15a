"""A checkpoint: a folder with tensors as safetensors and the rest as JSON; nothing in it is ever executed.

RUN/checkpoints/000500/model.safetensors      averaged weights, those that run
                       training.safetensors   raw weights and the moments of the optimiser, to go on
                       checkpoint.json        what it is, see `Checkpoint`
RUN/checkpoints/last, best                    links to the newest, and to the one of the least validation loss
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from controller.stiffness import StiffnessTable
from policy.config import TrainConfig
from policy.features import Control, Features

if TYPE_CHECKING:
    from torch import Tensor

FORMAT = 1
CHECKPOINTS, CONFIG = "checkpoints", "config.json"  # in the folder of a run
MODEL, TRAINING, DESCRIPTION = "model.safetensors", "training.safetensors", "checkpoint.json"


@dataclass(frozen=True, slots=True)
class PolicySpec:
    """What a policy needs to see, and what it commands."""

    run: str  # name of the run
    task: str
    arms: tuple[str, ...]
    cameras: Mapping[str, tuple[int, int]]  # (height, width) [px] that it sees; larger images are reduced
    control: Control  # "cartesian" with stiffness, or "joint"
    rate: float  # [Hz] of the steps of a chunk
    chunk: int  # steps of a chunk
    wrench_history: int  # samples of force and torque, 0 for none
    wrench_rate: float  # [Hz] of these samples
    step: int  # of the training
    stiffness_table: StiffnessTable = "tuned"  # what the controller must be set up for

    def check_replan(self, every: int | None) -> None:
        """Raise ValueError where chunks have fewer steps than shall be played of each."""
        if every is not None and every > self.chunk:
            raise ValueError(f"{self.run} tells {self.chunk} steps; it cannot be asked less often.")

    def check(
        self, task: str, arms: Iterable[str], cameras: Iterable[str], table: StiffnessTable | None = None
    ) -> None:
        """Raise ValueError where the policy cannot drive this task with these arms and cameras.

        Neither can it through a controller set up for another `table` than the one it learned with.
        """
        arms, cameras = tuple(arms), tuple(cameras)
        if task != self.task:
            raise ValueError(f"{self.run} learned {self.task!r}, not {task!r}.")
        if arms != self.arms:
            raise ValueError(f"{self.run} drives the arms {self.arms}, not {arms}.")
        if missing := [name for name in self.cameras if name not in cameras]:
            raise ValueError(f"{self.run} needs the cameras {missing}; there are {sorted(cameras)}.")
        if table not in (None, self.stiffness_table):
            raise ValueError(
                f"{self.run} learned with --stiffness-table {self.stiffness_table}; the controller is set up "
                f"for {table}, whose rotational gain is another."
            )


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """Everything but the tensors."""

    spec: PolicySpec
    config: TrainConfig
    features: Features
    recorded: Mapping[str, tuple[int, int]]  # (height, width) [px] of the recorded images
    data: str  # key of the training cache
    validation: float | None = None  # loss on the takes kept aside, None before the first
    best: float | None = None  # the least of these so far
    versions: Mapping[str, str] = field(default_factory=dict)

    def to_json(self) -> str:
        fields = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "features"}
        for name in ("spec", "config"):
            fields[name] = dataclasses.asdict(fields[name])
        return json.dumps({"format": FORMAT, **fields, "features": self.features.to_json()}, indent=1)

    @staticmethod
    def from_json(text: str) -> Checkpoint:
        fields = json.loads(text)
        version = fields.pop("format", None)
        if version != FORMAT:
            raise ValueError(f"The checkpoint has format {version}; this version reads {FORMAT}.")
        spec = fields["spec"]
        spec["arms"] = tuple(spec["arms"])
        spec["cameras"] = _sizes(spec["cameras"])
        return Checkpoint(
            **{
                **fields,
                "spec": PolicySpec(**spec),
                "config": TrainConfig.from_json(fields["config"]),
                "features": Features.from_json(fields["features"]),
                "recorded": _sizes(fields["recorded"]),
            }
        )


def find(run_or_checkpoint: Path) -> Path:
    """The folder of a checkpoint; of a run, its last."""
    path = Path(run_or_checkpoint)
    for folder in (path, path / CHECKPOINTS / "last"):
        if (folder / DESCRIPTION).exists():
            return folder.resolve()
    if path.exists():
        raise FileNotFoundError(f"{path} has no checkpoint yet.")
    near = sorted(other.name for other in path.parent.glob("*/")) if path.parent.exists() else []
    raise FileNotFoundError(f"No run or checkpoint at {path}; beside it are {near or 'none'}.")


def read(folder: Path) -> Checkpoint:
    """What a checkpoint folder says. Raise ValueError where it cannot be read."""
    try:
        return Checkpoint.from_json((folder / DESCRIPTION).read_text())
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{folder / DESCRIPTION} cannot be read: {error!r}.") from error


def read_spec(run_or_checkpoint: Path) -> PolicySpec:
    """What a policy needs and commands, without loading it."""
    return read(find(run_or_checkpoint)).spec


def read_tensors(folder: Path, file: str) -> dict[str, Tensor]:
    """Of `MODEL` or `TRAINING` of a checkpoint. Raise ValueError where it cannot be read. Loads torch."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        return load_file(folder / file)
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{folder / file} cannot be read: {error}.") from error


def write(run: Path, checkpoint: Checkpoint, files: Mapping[str, bytes], *, is_best: bool) -> Path:
    """Put a checkpoint beside the others of a run, then point to it: a crash leaves the one before.

    Only those that `last` and `best` point to stay.
    """
    above = run / CHECKPOINTS
    above.mkdir(parents=True, exist_ok=True)
    folder, part = above / f"{checkpoint.spec.step:06d}", above / f".{checkpoint.spec.step:06d}.part"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    for name, content in {**files, DESCRIPTION: checkpoint.to_json().encode()}.items():
        with (part / name).open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
    shutil.rmtree(folder, ignore_errors=True)  # where a resumed run comes by the same step again
    part.rename(folder)
    for link in ("last", "best") if is_best else ("last",):
        fresh = above / f".{link}"
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(folder.name)
        fresh.replace(above / link)
    kept = {(above / link).resolve() for link in ("last", "best")}
    for other in above.glob("[0-9]*"):
        if other.resolve() not in kept:
            shutil.rmtree(other, ignore_errors=True)
    return folder


def _sizes(fields: Mapping[str, Any]) -> dict[str, tuple[int, int]]:
    return {name: (height, width) for name, (height, width) in fields.items()}
