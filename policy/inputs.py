"""What a policy is shown: the newest images, the arms at the moment that these show, and recent forces."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from controller.types import Array, Image, Observation
from policy.checkpoint import PolicySpec

REMEMBERED = 1.0  # [s] of arm states that images may lag behind
NANOSECOND = 1e-9  # [s] to which recorded times are told


@dataclass(frozen=True, slots=True)
class Inputs:
    """What a policy sees: the newest images and the arms at the moment that they show."""

    time: float  # [s] of the state that the images show
    base_from_tcp: Array  # (arms, 7) position [m], wxyz
    q: Array  # (arms, 6) [rad]
    gripper: Array  # (arms,) measured, 0 closed .. 1 open
    wrench: Array  # (samples, arms, 6) [N, N·m] in base axes, the oldest first, the last at `time`
    images: Mapping[str, Array]  # camera -> (h, w, 3) uint8, RGB


class History:
    """Remembers the arms, to pair late images with the state they show and to tell past forces."""

    def __init__(self, spec: PolicySpec) -> None:
        self._spec = spec
        self._states: deque[tuple[float, Array]] = deque()  # time [s], (arms, 7 + 6 + 1 + 6)

    def reset(self) -> None:
        self._states.clear()

    def add(self, observation: Observation) -> None:
        """Call each tick."""
        rows = [
            np.concatenate((arm.base_from_tcp.vector, arm.q, [arm.gripper], arm.wrench.vector))
            for arm in observation.arms
        ]
        self._states.append((observation.time, np.stack(rows)))
        span = REMEMBERED + self._spec.wrench_history / self._spec.wrench_rate
        while self._states[0][0] < observation.time - span:
            self._states.popleft()

    def inputs(self, observation: Observation) -> Inputs | None:
        """For the policy, once `observation` was added.

        None while a camera has no image yet, or its newest shows a moment whose state is not remembered: one
        before the first `add`, or too long ago.
        """
        if missing := [name for name in self._spec.cameras if name not in observation.images]:
            if len(observation.images):
                have = sorted(observation.images)
                raise KeyError(f"{self._spec.run} needs the cameras {missing}; there are {have}.")
            return None
        images = {name: observation.images[name] for name in self._spec.cameras}
        time = min((image.time for image in images.values()), default=observation.time)
        times = np.array([at for at, _ in self._states])
        if time < times[0] - NANOSECOND * 10:
            return None
        back = np.arange(max(self._spec.wrench_history, 1) - 1, -1, -1) / self._spec.wrench_rate
        # Forces of before the first state: it stands for all.
        chosen = np.searchsorted(times, time - back + NANOSECOND * 10, side="right") - 1
        rows = np.stack([self._states[max(int(n), 0)][1] for n in chosen])  # (samples, arms, 20)
        pose, q, gripper, _ = np.split(rows[-1], [7, 13, 14], axis=1)
        return Inputs(
            time=time,
            base_from_tcp=pose,
            q=q,
            gripper=gripper[:, 0],
            wrench=rows[: self._spec.wrench_history, :, 14:],
            images={
                name: reduced(_pixels(image), self._spec.cameras[name]) for name, image in images.items()
            },
        )


def reduced(pixels: Array, size: tuple[int, int]) -> Array:
    """The image (h, w, 3) uint8 at (height, width) `size`; larger ones only, by averaging areas."""
    height, width = size
    if pixels.shape[:2] == (height, width):
        return pixels
    if pixels.shape[0] < height or pixels.shape[1] < width:
        raise ValueError(
            f"An image of {pixels.shape[:2]} is smaller than {size}, at which the policy learned."
        )
    return np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA))


def _pixels(image: Image) -> Array:
    """(h, w, 3) uint8, RGB."""
    if image.pixels is not None:
        return image.pixels
    decoded = cv2.imdecode(np.frombuffer(image.jpeg or b"", np.uint8), cv2.IMREAD_COLOR)
    if decoded is None:
        raise ValueError(f"The image of {image.time:.2f} s is no JPEG.")
    return np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB))
