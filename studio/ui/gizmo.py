"""One gizmo per arm, at the servo's target: dragging it sends targets at once, a still one keeps its target.

While nobody drags, it goes where the session's target goes: after a reset, a nudge or a limit. It never sends
anything by itself, so that showing it never moves an arm.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal, assert_never

import numpy as np
import viser

from controller.types import Pose, multiply_quaternions
from studio.messages import ArmFrame, Command, Frame, MoveTo
from studio.tasks import ArmSetup

SCALE = 0.16  # [m] length of its arrows
SETTLED = 0.25  # [s] for which the target must rest after a drag before the gizmo follows it again
STILL = 1e-4  # [m] and in a quaternion's components: less than a person sees

Hold = Literal["free", "held", "settling"]


class Gizmo:
    """The handle of one arm in the scene."""

    def __init__(
        self,
        scene: viser.SceneApi,
        arm: int,
        setup: ArmSetup,
        post: Callable[[Command], None],
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._arm, self._base, self._post, self._now = arm, setup.base_position, post, now
        # Its arrows are the world's where the tool is turned as at home: up is up, also for a tool that
        # points down.
        self._home = setup.world_from_home.wxyz
        self._hold: Hold = "free"
        self._client: int | None = None  # who drags
        self._rested_since = 0.0  # [s] monotonic
        self._shown = np.zeros(7)  # pose that the browsers have
        self._target = np.zeros(7)
        self._handle = scene.add_transform_controls(
            f"/live/gizmo/{setup.name}", scale=SCALE, line_width=4.0, depth_test=False, visible=False
        )

        @self._handle.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            self._on_drag(event.phase, event.client_id)

    def show(self, frame: Frame, visible: bool) -> None:
        """Follow the session's target, unless somebody drags."""
        target = self._from_target(frame.arms[self._arm])
        if np.abs(target - self._target).max() > STILL:
            self._target, self._rested_since = target, self._now()
        if self._hold == "settling" and self._now() - self._rested_since > SETTLED:
            self._hold = "free"
        if self._hold == "free" and np.abs(self._target - self._shown).max() > STILL:
            self._shown = self._target
            self._handle.position = self._target[:3]
            self._handle.wxyz = self._target[3:]
        if not visible:
            self.hide()
        elif not self._handle.visible:
            self._handle.visible = True

    def hide(self) -> None:
        if self._handle.visible:
            self._handle.visible = False
            self._hold, self._client = "free", None

    def remove(self) -> None:
        self._handle.remove()

    def _on_drag(self, phase: Literal["start", "update", "end"], client_id: int | None) -> None:
        """Runs on viser's loop. One hand at a time: who comes second drags in vain."""
        if self._client not in (None, client_id):
            self._shown = np.full(7, np.inf)  # the browsers show where the second one went
            return
        match phase:
            case "start":
                self._hold, self._client = "held", client_id
            case "update":
                self._hold, self._client = "held", client_id
                self._send()
            case "end":
                self._release()
            case _:
                assert_never(phase)

    def _release(self) -> None:
        self._hold, self._client, self._rested_since = "settling", None, self._now()

    def _send(self) -> None:
        position, wxyz = self._handle.position, self._handle.wxyz
        self._shown = np.concatenate((position, wxyz))
        x, y, z = (position - self._base).tolist()
        turned = multiply_quaternions(wxyz, self._home)
        w, i, j, k = (turned / np.linalg.norm(turned)).tolist()
        self._post(MoveTo(arm=self._arm, position=(x, y, z), wxyz=(w, i, j, k)))

    def _from_target(self, arm: ArmFrame) -> np.ndarray:
        """(7,) pose of the gizmo in the world for the session's target."""
        target = Pose.from_vector(np.array(arm.base_from_target))
        inverse = self._home * np.array([1.0, -1.0, -1.0, -1.0])
        return np.concatenate((target.position + self._base, multiply_quaternions(target.wxyz, inverse)))
