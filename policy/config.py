"""Settings of a training run, and the two presets. Free of torch, so that `--help` answers at once."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

Preset = Literal["small", "paper"]
PolicyKind = Literal["comp-act", "act"]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """Everything that decides a run, besides the takes. The defaults are those of `small`."""

    preset: Preset = "small"
    """small: a CPU learns it over a coffee. paper: the network and the numbers of the paper, for a GPU."""
    policy: PolicyKind = "comp-act"
    """comp-act: pose and stiffness, driven compliantly. act: joint positions in and out, driven stiffly."""

    # What goes in and out
    wrench: bool = True
    """Forces and torques go in."""
    images: bool = True
    """Camera images go in."""
    frame: Literal["relative", "absolute"] = "relative"
    """Targets less the measured pose (axes of the base), or in the base."""
    rotation: Literal["6d", "axis-angle"] = "6d"
    stiffness: Literal["log-diagonal", "cholesky", "mode"] = "log-diagonal"
    """Cholesky, the paper's 12 numbers, also learns blocks that are not diagonal."""
    between: bool = True
    """The state also tells how the second tool stands to the first, where there are two."""
    rate: float = 20.0
    """[Hz] of the steps of a chunk."""
    chunk_seconds: float = 2.0
    """[s] that a chunk covers."""
    wrench_history: int = 16
    """Samples at 100 Hz, the newest of the state that the images show."""
    max_height: int = 96
    """[px] larger images are reduced."""
    max_width: int = 96
    """[px] likewise."""
    past_end: Literal["repeat", "mask"] = "repeat"
    """What a chunk holds past the end of its take: the last action, or nothing that counts."""

    # Network
    backbone: Literal["keypoints", "cnn", "resnet18"] = "keypoints"
    """What reads the images: a small network that tells where things are, one that gives a grid of tokens, or
    ResNet-18."""
    backbone_weights: str = ""
    """File with torchvision's ResNet-18 weights (.pth or .safetensors); without, it learns from nothing."""
    width: int = 128
    feedforward: int = 256
    heads: int = 4
    encoder_layers: int = 2
    decoder_layers: int = 2
    pre_norm: bool = True
    dropout: float = 0.1
    state_dropout: float = 0.5
    """Share of the samples that are learned without where each arm is: images, if any, have to tell."""
    cvae: bool = False
    """Learn a latent for what the observation does not tell; zero when the policy runs."""
    cvae_layers: int = 2
    latent: int = 32

    # Loss: L1, averaged within each group
    position_weight: float = 1.0
    rotation_weight: float = 0.3
    gripper_weight: float = 0.3
    stiffness_weight: float = 0.3
    joint_weight: float = 1.0
    kl_weight: float = 10.0

    # Optimisation
    steps: int = 4500
    batch: int = 16
    """Per process."""
    lr: float = 5e-4
    backbone_lr: float | None = None
    """Of what reads the images; --lr if not given."""
    weight_decay: float = 1e-4
    warm_up: int = 200
    """[steps] of rising learning rate, before the cosine."""
    clip: float = 5.0
    """Largest norm of the gradient."""
    ema: float = 0.999
    """Decay of the averaged weights, which are validated and run; 0 takes the weights as they are."""
    brightness: float = 0.1
    """Largest random change of brightness and of contrast."""
    shift: int = 0
    """[px] largest random shift; for a camera that stands still it is noise on what it shows."""
    seed: int = 0
    validation: float = 0.1
    """Share of the takes that only validates."""
    validate_every: int = 500
    """[steps] between two looks at the takes kept aside."""
    save_every: int = 500
    """[steps] between two checkpoints, of which the last and the best stay."""

    # Machine
    device: str = "auto"
    """cpu, cuda, or auto: cuda where there is one."""
    threads: int = 0
    """Of the CPU; 0 takes the cores that this process may use."""
    tensorboard: bool = False

    def __post_init__(self) -> None:
        for name in ("rate", "chunk_seconds", "lr", "backbone_lr", "clip"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{_flag(name)} must be above 0, not {value}.")
        for name in _COUNTS:
            if getattr(self, name) < 1:
                raise ValueError(f"{_flag(name)} must be at least 1, not {getattr(self, name)}.")
        if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", self.device):
            raise ValueError(f"--device is auto, cpu, cuda or cuda:N, not {self.device!r}.")
        for name in ("seed", "warm_up", "shift", "threads", "weight_decay", "kl_weight", *_WEIGHTS):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{_flag(name)} must not be negative, but is {getattr(self, name)}.")
        for name in ("dropout", "state_dropout", "ema", "validation", "brightness"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{_flag(name)} must be at least 0 and below 1, not {getattr(self, name)}.")
        if self.width % self.heads or self.width % 4:
            raise ValueError(f"--width {self.width} must be a multiple of 4 and of --heads {self.heads}.")
        if self.rate > 100:
            raise ValueError(f"--rate {self.rate:g} is above the 100 Hz at which takes are recorded.")
        if self.backbone_weights and self.backbone != "resnet18":
            raise ValueError("--backbone-weights needs --backbone resnet18.")

    @property
    def chunk(self) -> int:
        """Steps of a chunk."""
        return max(1, round(self.chunk_seconds * self.rate))

    @staticmethod
    def from_json(fields: Mapping[str, Any]) -> TrainConfig:
        """Refuses settings that this version does not have."""
        known = {field.name for field in dataclasses.fields(TrainConfig)}
        if unknown := sorted(fields.keys() - known):
            raise ValueError(f"The run has settings that this version does not know: {', '.join(unknown)}.")
        return TrainConfig(**fields)


_WEIGHTS = ("position_weight", "rotation_weight", "gripper_weight", "stiffness_weight", "joint_weight")
_COUNTS = (
    *("wrench_history", "max_height", "max_width", "width", "feedforward", "heads", "encoder_layers"),
    *("decoder_layers", "cvae_layers", "latent", "steps", "batch", "validate_every", "save_every"),
)


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


# The paper's network and numbers, where its code is right (Kamijo et al. 2024; Zhao et al. 2023). All seven
# decoder layers learn here; in the published code only the first does. Its KL weight is that of the code.
PRESETS: dict[Preset, TrainConfig] = {
    "small": TrainConfig(),
    "paper": TrainConfig(
        preset="paper",
        frame="absolute",
        rotation="axis-angle",
        between=False,
        stiffness="cholesky",
        rate=40.0,
        chunk_seconds=2.5,
        max_height=480,
        max_width=640,
        past_end="mask",
        backbone="resnet18",
        width=512,
        feedforward=3200,
        heads=8,
        encoder_layers=4,
        decoder_layers=7,
        pre_norm=False,
        state_dropout=0.0,
        cvae=True,
        cvae_layers=4,
        rotation_weight=1.0,
        gripper_weight=1.0,
        stiffness_weight=1.0,
        kl_weight=100.0,
        steps=20_000,
        batch=8,
        lr=1e-5,
        warm_up=1000,
        clip=10.0,
        ema=0.0,
        brightness=0.0,
        validate_every=1000,
        save_every=1000,
    ),
}
