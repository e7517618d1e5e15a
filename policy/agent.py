"""Running a policy: observations in, chunks of targets out. torch is loaded only by `load_policy`.

Two halves, so that the session never imports torch and the network may run in another process:

    session's side (numpy)                              the policy's side (torch)

    spec = read_spec(run)                               policy = load_policy(run)
    history, executor = History(spec), ChunkExecutor("replan", n_arms=len(spec.arms))
    each tick:
      history.add(observation)
      if executor.wants(time):
          inputs = history.inputs(observation)   --->   chunk = policy.predict(inputs)
      executor.add(chunk)                        <---
      action = executor.action(time)

`Inputs` pair images with the arm state that they show: a chunk begins at that time, and a late answer is
joined in its middle. `Inputs` and `ActionChunk` hold only numbers, strings and arrays. The network gives
the same for the same inputs (the CVAE's latent is zero); `reset` is there for those that draw.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from policy.checkpoint import PolicySpec, read_spec
from policy.chunks import ActionChunk, ArmChunk, ChunkExecutor, ExecutionMode
from policy.inputs import History, Inputs

__all__ = [
    "ActionChunk",
    "ArmChunk",
    "ChunkExecutor",
    "ExecutionMode",
    "History",
    "Inputs",
    "Policy",
    "PolicySpec",
    "load_policy",
    "read_spec",
]


class Policy(Protocol):
    """A trained network with its features. Not for two threads at once."""

    spec: PolicySpec

    def reset(self, seed: int) -> None:
        """Before a run; what the policy does depends on nothing else than the inputs after it."""

    def predict(self, inputs: Inputs) -> ActionChunk:
        """Targets from `inputs.time` on, `spec.chunk` steps at `spec.rate`."""


def load_policy(
    run_or_checkpoint: Path,
    *,
    device: str = "cpu",
    hide_images: bool = False,
    hide_wrench: bool = False,
    threads: int = 1,
) -> Policy:
    """The policy of a checkpoint, or of a run's last one. Imports torch.

    `hide_images` shows one grey, `hide_wrench` the mean force: a control of whether the policy uses them.
    `threads` of torch, for the whole process; with more, nothing is answered sooner (`studio bench`).
    """
    from policy.inference import load

    return load(run_or_checkpoint, device, hide_images=hide_images, hide_wrench=hide_wrench, threads=threads)
