"""A run whose network has learned nothing, for tests of what is around it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import torch
from policies import SPEC
from safetensors.torch import save

from policy.act import Act
from policy.checkpoint import MODEL, Checkpoint, write
from policy.config import TrainConfig
from policy.features import Encoding, Features, Scale


def untrained(run: Path, task: str) -> Path:
    """It sees itself and forces, but no images."""
    torch.manual_seed(0)
    config = TrainConfig(width=16, feedforward=32, heads=2, images=False)
    encoding = Encoding(1, "cartesian", config.frame, config.rotation, config.stiffness)
    state, action = (
        Scale(np.zeros(n), np.full(n, scale))
        for n, scale in ((encoding.state_width, 1.0), (encoding.action_width, 0.01))
    )
    action.mean[encoding.columns("stiffness")] = np.log(300.0)
    action.mean[encoding.columns("rotation")] = np.eye(3)[:, :2].T.ravel()
    features = Features(encoding, state, action, Scale(np.zeros(6), np.ones(6)))
    spec = dataclasses.replace(
        SPEC, run=run.name, task=task, chunk=config.chunk, wrench_history=config.wrench_history
    )
    tensors = {
        name: tensor.contiguous() for name, tensor in Act.of(config, encoding, {}).state_dict().items()
    }
    write(run, Checkpoint(spec, config, features, {}, "none"), {MODEL: save(tensors)}, is_best=True)
    return run
