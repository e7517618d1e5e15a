"""A trained network that answers: the torch half of `policy.agent`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from controller.types import Array
from policy import checkpoint
from policy.act import Act, Batch
from policy.checkpoint import Checkpoint
from policy.chunks import ActionChunk, ArmChunk
from policy.features import ArmStates, Targets
from policy.inputs import Inputs, reduced


class ActPolicy:
    """Implements `policy.agent.Policy`."""

    def __init__(self, told: Checkpoint, model: Act, device: str) -> None:
        self.spec = told.spec
        self.hide_images = False
        self.hide_wrench = False
        self._features = told.features
        self._model = model
        self._device = device

    def reset(self, seed: int) -> None:
        torch.manual_seed(seed)

    def predict(self, inputs: Inputs) -> ActionChunk:
        seen = ArmStates(inputs.base_from_tcp[None], inputs.q[None], inputs.gripper[None])
        images = [reduced(inputs.images[name], size) for name, size in self.spec.cameras.items()]
        batch = Batch(
            state=self._tensor(self._features.encode_state(seen)),
            wrench=self._tensor(self._features.encode_wrench(inputs.wrench[None])),
            images=torch.from_numpy(np.stack(images) if images else np.empty((0, 1, 1, 3)))[None].to(
                self._device
            ),
        )
        with torch.inference_mode():
            values = self._model(batch, hide_images=self.hide_images, hide_wrench=self.hide_wrench)
        targets = self._features.decode_action(values.double().cpu().numpy(), seen)
        return chunk_of(targets, inputs.time, 1.0 / self.spec.rate)

    def _tensor(self, values: Array) -> torch.Tensor:
        return torch.from_numpy(values.astype(np.float32)).to(self._device)


def load(
    run_or_checkpoint: Path, device: str, *, hide_images: bool, hide_wrench: bool, threads: int
) -> ActPolicy:
    """See `policy.agent.load_policy`."""
    folder = checkpoint.find(run_or_checkpoint)
    told = checkpoint.read(folder)
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise RuntimeError(f"No GPU for device {device!r}: torch finds none here; use cpu.")
    torch.set_num_threads(threads)
    tensors = checkpoint.read_tensors(folder, checkpoint.MODEL)
    model = Act.of(told.config, told.features.encoding, told.spec.cameras)
    try:
        model.load_state_dict(tensors)
    except RuntimeError as error:
        raise ValueError(f"{folder} does not fit this version: {error}") from error
    policy = ActPolicy(told, model.to(device).eval(), device)
    policy.hide_images, policy.hide_wrench = hide_images, hide_wrench
    return policy


def chunk_of(targets: Targets, time: float, period: float) -> ActionChunk:
    """From decoded targets (1, steps, arms)."""
    arms = []
    for n in range(targets.gripper.shape[2]):
        gripper = targets.gripper[0, :, n]
        if targets.q is not None:
            arms.append(ArmChunk(gripper, q=targets.q[0, :, n]))
            continue
        assert targets.base_from_target is not None
        assert targets.stiffness is not None
        pose, stiffness = targets.base_from_target[0, :, n], targets.stiffness[0, :, n]
        arms.append(ArmChunk(gripper, pose[:, :3], pose[:, 3:], stiffness[:, 0], stiffness[:, 1]))
    return ActionChunk(time, period, tuple(arms))
