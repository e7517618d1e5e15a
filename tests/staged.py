"""A session process with a front server for headsets, without viser: quick to start, all that they need."""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
from visitor import wait_for

from controller.types import Array
from studio.door import person_of
from studio.headset import add_xr
from studio.lease import Lease
from studio.link import socket_path
from studio.messages import ArmFrame, Drive, HandStatus, Reset, Status
from studio.models import ARM_JOINTS
from studio.server import FrontServer, make_app
from studio.ui.remote import Remote
from studio.ui.scene import SceneModel

NOBODY = 9  # the discard port: the page of viser is not needed here


class Site:
    """A session process on its folder, and a front server with the headset's routes."""

    def __init__(self, data: Path) -> None:
        self.data, self.remote, self.model = data, Remote(), cache(SceneModel)
        self.socket = socket_path(data)
        command = [sys.executable, "-m", "studio.live", "--data", str(data), "--no-cameras"]
        self.process = subprocess.Popen([*command, "--task", "peg-cylinder"], stderr=subprocess.DEVNULL)
        self.remote.connect(self.socket)
        self.lease = lease = Lease(self.remote.post)
        app = make_app(NOBODY)
        add_xr(app, self.remote, lambda socket: lease.sit(person_of(socket), "headset"), self.model)
        self.front = FrontServer(app, port=0)
        self.front.start()

    @property
    def status(self) -> Status:
        status, _ = self.remote.status.get()
        assert status is not None
        return status

    def arm(self, index: int = 1) -> ArmFrame:
        frame, _ = self.remote.frame.get()
        assert frame is not None
        return frame.arms[index]

    def hand(self, index: int = 1) -> HandStatus:
        hand = self.status.arms[index].hand
        assert hand is not None
        return hand

    def target(self, index: int = 1) -> Array:
        return np.array(self.arm(index).base_from_target)

    def is_engaged(self, index: int = 1) -> bool:
        hand = self.status.arms[index].hand
        return hand is not None and hand.engaged

    def close(self) -> None:
        self.front.stop()
        self.remote.close()
        self.process.kill()
        self.process.wait()

    def joints(self, index: int = 1) -> Array:
        """(6,) [rad]"""
        frame, _ = self.remote.frame.get()
        assert frame is not None
        arm = self.status.arms[index].name
        model = self.model(self.status.task).mujoco
        addresses = [model.joint(f"{arm}_{joint}").qposadr[0] for joint in ARM_JOINTS]
        return np.frombuffer(frame.qpos)[addresses]

    def begin(self, task: str | None = None) -> None:
        """A fresh scene, nobody driving."""
        wait_for(lambda: not self.lease.holder)  # whoever drove before has left
        self.remote.post(Drive(driver="nobody"))
        resets = self.status.resets
        self.remote.post(Reset(seed=3, task=task))
        wait_for(lambda: self.status.resets > resets and self.status.driver == "nobody")
        wait_for(lambda: self.remote.frame.get()[0].resets == self.status.resets)  # type: ignore[union-attr]
