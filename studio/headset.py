"""The headset's page and its socket: controllers in, the state of the robot out, newest first.

    /xr                    the page: self-test, settings, the way into VR or AR
    /xr/scene/TASK         what the task looks like: names of moving bodies, their meshes at /xr/scene/TASK/N
    /xr/ws                 JSON in (`studio.inputs.xr`), JSON and binary out

Whoever holds the lease drives; everybody else may look. What is sent is in the world's axes, quaternions
wxyz; `State.stage` alone knows the headset's room. Binary messages begin with one byte: `POSES`, then float32
(n, 7) of the moving bodies; `IMAGE`, then the camera's number and a JPEG; or `INK`, then a PNG.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import cv2
import msgspec
import mujoco
import numpy as np
from fastapi import FastAPI, HTTPException
from starlette.requests import HTTPConnection
from starlette.responses import FileResponse, Response
from starlette.websockets import WebSocket, WebSocketDisconnect

from controller.types import Array, Pose, quaternion_from_rotation_vector
from studio import messages as m
from studio import tasks
from studio.inputs import xr
from studio.inputs.controllers import Controllers
from studio.inputs.haptics import PULSE, STALE
from studio.lease import NotDriving, Seat
from studio.server import WEB_ASSETS
from studio.ui.remote import Remote
from studio.ui.status import mode_words

if TYPE_CHECKING:
    from studio.ui.scene import SceneModel

PERIOD = 1 / 30  # [s] between states: haptics want 20 Hz
IMAGE_PERIOD = 0.1  # [s] between images of one camera
INK_PERIOD = 0.3  # [s] between pictures of what is painted
POSES, IMAGE, INK = b"\1", b"\2", b"\3"
POLICY_VIOLATION = 1008  # close code: a message that no page of ours sends
STAND_OFF = 0.75  # [m] from the operator's eyes to the middle of the workspace, ahead
BELOW_EYES = 0.5  # [m] of that middle
REACHES_VIEW = 3.0  # [s] that what went wrong stays in view

log = logging.getLogger(__name__)


def add_xr(
    app: FastAPI,
    remote: Remote,
    sit: Callable[[HTTPConnection], Seat],
    model: Callable[[str], SceneModel],
) -> None:
    """Mount the routes. `sit` gives a connection its seat at the lease; `model` may take seconds."""

    @app.get("/xr", include_in_schema=False)
    async def read_page() -> FileResponse:
        return FileResponse(WEB_ASSETS / "xr.html", headers={"Cache-Control": "no-cache"})

    @app.get("/xr/scene/{task}", include_in_schema=False)
    async def read_scene(task: str) -> dict[str, Any]:
        scene = await _scene(model, task)
        parts = [scene.fixed, *(node.glb for node in scene.nodes)]
        return {
            "parts": [f"/xr/scene/{task}/{number}" if glb else None for number, glb in enumerate(parts)],
            "picture": _picture(scene),
            "cameras": [view.name for view in scene.task.cameras],
        }

    @app.get("/xr/scene/{task}/{number}", include_in_schema=False)
    async def read_part(task: str, number: int) -> Response:
        scene = await _scene(model, task)
        parts = [scene.fixed, *(node.glb for node in scene.nodes)]
        if not 0 <= number < len(parts):
            raise HTTPException(404, f"No part {number}; there are {len(parts)}.")
        return Response(parts[number], media_type="model/gltf-binary")

    @app.websocket("/xr/ws")
    async def talk(socket: WebSocket) -> None:
        await _Headset(socket, remote, sit(socket), model).run()


async def _scene(model: Callable[[str], SceneModel], task: str) -> SceneModel:
    if task not in tasks.names():
        raise HTTPException(404, f"No task {task!r}; there are {tasks.names()}.")
    return await asyncio.to_thread(model, task)


def _picture(scene: SceneModel) -> dict[str, Any] | None:
    if scene.picture is None:
        return None
    face = scene.picture.world_from_face
    return {"pose": face.vector.tolist(), "width": scene.picture.width, "height": scene.picture.height}


class ArmView(msgspec.Struct):
    """One arm, as the headset shows it."""

    name: str
    tcp: list[float]  # (7,) world_from_tcp
    target: list[float]  # (7,) world_from_target
    force: tuple[float, ...]  # (3,) [N]
    newtons: float
    amplitude: float  # of vibration, 0 .. 1
    mode: str  # in words
    gripper: float
    engaged: bool  # its clutch
    why: str  # the clutch let go, or the target was limited


class State(msgspec.Struct, tag="state"):
    """Everything a headset shows and lets feel; sent `1 / PERIOD` times a second."""

    session: str  # open, closed or stuck
    holder: str  # who may drive; empty while nobody does
    is_mine: bool
    task: str
    resets: int
    phase: str
    countdown: float
    seconds: float  # of the running take
    kept: str  # how the last take ended
    stage: list[float] | None  # from the world to the headset's room, position and xyzw; None before a frame
    arms: list[ArmView]
    pulse: float  # [ms] of a vibration
    latency: float  # [ms] of your poses on their way here
    jitter: float  # [ms]
    said: str  # what did not work just now


class _Headset:
    """One open page. Everything runs on the server's loop."""

    def __init__(
        self, socket: WebSocket, remote: Remote, seat: Seat, model: Callable[[str], SceneModel]
    ) -> None:
        self._socket, self._remote, self._seat = socket, remote, seat
        self._controllers = Controllers(self._send)
        self._device = xr.WebXr(self._controllers)
        self._watch = xr.XrWatch()
        self._view = _View(model)
        self._hands: m.Hands | None = None  # newest that was sent
        self._said, self._said_at = "", -math.inf
        _, self._heard = remote.newest_notice.get()
        self._head: Pose | None = None  # where it was when the operator's facing was taken
        self._head_yaw: float | None = None
        self._pong: str | None = None  # to be sent back

    async def run(self) -> None:
        try:
            await self._socket.accept()
            async with asyncio.TaskGroup() as group:
                telling = group.create_task(self._tell())
                await self._listen()
                telling.cancel()
        except* (WebSocketDisconnect, RuntimeError):  # RuntimeError: sent to a socket that has closed
            pass
        finally:
            self._device.lose("left")
            self._seat.leave()

    async def _listen(self) -> None:
        while (event := await self._socket.receive())["type"] == "websocket.receive":
            try:
                self._hear(xr.decode(event.get("text") or event.get("bytes") or ""))
            except ValueError as error:
                log.warning("A headset's message was refused: %s", error)
                await self._socket.close(POLICY_VIOLATION, str(error)[:100])
                return
            if self._pong is not None:
                await self._socket.send_text(self._pong)
                self._pong = None

    def _hear(self, message: xr.XrMessage) -> None:
        match message:
            case xr.XrFrame():
                self._device.hear(message, time.monotonic(), self._remote.status.get()[0])
                if message.head and self._controllers.yaw != self._head_yaw:
                    self._head, self._head_yaw = xr.pose_of(message.head), self._controllers.yaw
            case xr.XrLost():
                self._device.lose(message.why)
            case xr.XrPing():
                self._pong = f'{{"type":"pong","t":{message.t}}}'
            case xr.XrWatch():
                self._watch = message
            case xr.XrSettings():
                self._take_settings(message)

    def _take_settings(self, message: xr.XrSettings) -> None:
        try:
            self._controllers.settings = message.checked()
        except ValueError as error:  # the last ones stay
            self._say(str(error))
        if message.operator:
            self._seat.rename(message.operator)

    def _send(self, command: m.Command) -> None:
        try:
            if isinstance(command, m.Hands):
                self._hands = command
            elif isinstance(command, m.Clutch) and command.engaged is not False:
                self._seat.admit()  # then its hands may come before it
                if self._hands:
                    self._seat.post(self._hands)
            self._seat.post(command)
        except NotDriving as error:
            if isinstance(command, m.Clutch):
                self._ask()
            elif not isinstance(command, m.Hands | m.LoseHand):
                self._say(str(error))

    def _ask(self) -> None:
        """Who closes the clutch wants to drive, and has no other button for saying so."""
        try:
            self._seat.ask()
        except NotDriving as error:
            self._say(str(error))
        else:
            self._say(f"{self._seat.standing.holder} has control; you asked for it.")

    def _say(self, text: str) -> None:
        self._said, self._said_at = text, time.monotonic()

    async def _tell(self) -> None:
        due = time.monotonic()
        while True:
            notice, heard = self._remote.newest_notice.get()
            if notice and heard != self._heard and notice.kind in ("error", "warning"):
                self._say(notice.text)
            self._heard = heard
            status, (frame, _) = self._remote.status.get()[0], self._remote.frame.get()
            if status and frame and frame.resets == status.resets:
                await self._socket.send_text(self._state(status, frame))
                if self._watch.twin:
                    await self._view.send_twin(self._socket, self._remote, status, frame)
                if self._watch.images:
                    await self._view.send_images(self._socket, self._remote, status)
            due = max(due + PERIOD, time.monotonic())
            await asyncio.sleep(due - time.monotonic())

    def _state(self, status: m.Status, frame: m.Frame) -> str:
        now = time.monotonic()
        is_fresh = self._remote.state == "open" and self._remote.silence < STALE
        standing, take = self._seat.standing, status.last_take
        haptics = self._controllers.settings.haptics
        setups = self._view.setups(status.task)
        arms = []
        for setup, arm, shown in zip(setups, status.arms, frame.arms, strict=True):
            base = Pose(setup.base_position, np.array([1.0, 0.0, 0.0, 0.0]))
            force = shown.wrench[:3]
            hand = arm.hand
            arms.append(
                ArmView(
                    name=arm.name,
                    tcp=(base @ Pose.from_vector(np.array(shown.base_from_tcp))).vector.tolist(),
                    target=(base @ Pose.from_vector(np.array(shown.base_from_target))).vector.tolist(),
                    force=force,
                    newtons=math.hypot(*force),
                    amplitude=haptics.amplitude(force) if is_fresh and standing.is_mine else 0.0,
                    mode=mode_words(arm.mode),
                    gripper=shown.gripper,
                    engaged=hand is not None and hand.engaged,
                    why=arm.why or (hand.why if hand else ""),
                )
            )
        state = State(
            session=self._remote.state,
            holder=standing.holder,
            is_mine=standing.is_mine,
            task=status.task,
            resets=status.resets,
            phase=status.phase,
            countdown=status.countdown,
            seconds=status.take_seconds,
            kept=("discarded" if take.discarded else take.outcome) if take else "",
            stage=self._stage(setups),
            arms=arms,
            pulse=PULSE * 1e3,
            latency=self._device.latency * 1e3,
            jitter=self._device.jitter * 1e3,
            said=self._said if now < self._said_at + REACHES_VIEW else "",
        )
        return msgspec.json.encode(state).decode()

    def _stage(self, setups: tuple[tasks.ArmSetup, ...]) -> list[float] | None:
        """room_from_world: the workspace before the operator's eyes, turned as the hands are."""
        yaw = self._controllers.yaw
        if self._head is None or yaw is None:
            return None
        low = np.min([setup.workspace[0] for setup in setups], axis=0)
        high = np.max([setup.workspace[1] for setup in setups], axis=0)
        turn = Pose(np.zeros(3), quaternion_from_rotation_vector(np.array([0.0, 0.0, yaw])))
        facing = yaw + self._controllers.view
        ahead = np.array([math.cos(facing), math.sin(facing), 0.0])
        middle = self._head.position + STAND_OFF * ahead - np.array([0.0, 0.0, BELOW_EYES])
        return xr.stage_of(Pose(middle - turn.apply((low + high) / 2), turn.wxyz))


class _View:
    """What one headset is shown of the scene, as often as it is of use."""

    def __init__(self, model: Callable[[str], SceneModel]) -> None:
        self._make = model
        self._model: SceneModel | None = None
        self._data: mujoco.MjData | None = None
        self._setups: tuple[str, tuple[tasks.ArmSetup, ...]] = ("", ())
        self._sent: dict[object, tuple[float, object]] = {}  # what was sent last: when [s], and it

    def setups(self, task: str) -> tuple[tasks.ArmSetup, ...]:
        """The arms of a task."""
        if self._setups[0] != task:
            self._setups = (task, tasks.load(task).arms)
        return self._setups[1]

    async def send_twin(self, socket: WebSocket, remote: Remote, status: m.Status, frame: m.Frame) -> None:
        if self._model is None or self._model.task.name != status.task:
            self._model = await asyncio.to_thread(self._make, status.task)
            self._data = mujoco.MjData(self._model.mujoco)
            self._sent.clear()
            return  # by now the frame is old
        await socket.send_bytes(POSES + self._poses(self._model, frame).tobytes())
        painted, _ = remote.task_state.get()
        if painted is not None and painted.resets == status.resets and self._is_due(INK, painted, INK_PERIOD):
            picture = await asyncio.to_thread(self._model.ink, painted.unpack())
            if picture is not None:
                await socket.send_bytes(INK + await asyncio.to_thread(_png, picture))

    async def send_images(self, socket: WebSocket, remote: Remote, status: m.Status) -> None:
        for number, name in enumerate(sorted(remote.images)):
            image = remote.images[name]
            if image.resets == status.resets and self._is_due(name, image, IMAGE_PERIOD):
                await socket.send_bytes(IMAGE + bytes([number]) + image.jpeg)

    def _poses(self, model: SceneModel, frame: m.Frame) -> Array:
        """(n, 7) float32: world_from_body of the model's nodes."""
        assert self._data is not None
        self._data.qpos[:] = np.frombuffer(frame.qpos)
        mujoco.mj_kinematics(model.mujoco, self._data)
        bodies = [node.body for node in model.nodes]
        return np.hstack((self._data.xpos[bodies], self._data.xquat[bodies])).astype("<f4")

    def _is_due(self, key: object, value: object, period: float) -> bool:
        """Whether another value was sent last, and long enough ago; then this one counts as sent."""
        when, sent = self._sent.get(key, (-math.inf, None))
        now = time.monotonic()
        if sent is value or now < when + period:
            return False
        self._sent[key] = (now, value)
        return True


def _png(picture: Array) -> bytes:
    done, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    if not done:
        raise ValueError(f"OpenCV could not encode a picture of {picture.shape}.")
    return bytes(data)
