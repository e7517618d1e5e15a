"""Native SteamVR, as in the paper: Vive wands through PyOpenVR at 90 Hz, clutch and buttons as with WebXR.

`studio steamvr` is a client of the session's socket on the same machine, beside the page; whoever may start
it may drive. SteamVR learns from an action manifest which action each button of a wand means, so that its own
settings can bind them otherwise (https://github.com/ValveSoftware/openvr/wiki/Action-manifest).
"""

from __future__ import annotations

import json
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from controller.types import Pose
from studio.channels import Latest, Mailbox
from studio.inputs.controllers import SIDES, Button, Controller, Controllers, Moment, Settings, Side
from studio.inputs.haptics import PULSE, STALE
from studio.inputs.xr import pose_of_matrix
from studio.link import connect
from studio.messages import Command, Frame, Notice, Report, Status
from studio.session import Clock

RATE = 90.0  # [Hz], as in the paper
FREQUENCY = 160.0  # [Hz] of a vibration; wands know only how strong it is
INSTALL = "Install Steam and SteamVR, switch the controllers on, then start it again."

# Our names of buttons, and where they are on a Vive wand.
DIGITAL: dict[Button, str] = {"menu": "application_menu", "squeeze": "grip", "pad": "trackpad"}
ANALOG: dict[Button, str] = {"trigger": "trigger"}
SET = "/actions/drive"


class SteamVrMissing(RuntimeError):
    """There is no SteamVR to talk to; the message says what to install."""


class Wands:
    """The two controllers of a running SteamVR. Use it in a `with`."""

    def __init__(self, openvr: Any) -> None:
        """`openvr` is the module of that name. Raises `SteamVrMissing`."""
        self._vr = openvr
        if not openvr.isRuntimeInstalled():
            raise SteamVrMissing(f"SteamVR is not installed on this machine. {INSTALL}")
        try:
            self._system = openvr.init(openvr.VRApplication_Other)
        except openvr.OpenVRError as error:
            name = type(error).__name__  # its text is empty
            raise SteamVrMissing(f"SteamVR does not start ({name}). {INSTALL}") from error
        self._folder = tempfile.TemporaryDirectory(prefix="compact-studio-")
        self._input = openvr.VRInput()
        self._input.setActionManifestPath(str(write_manifest(Path(self._folder.name))))
        self._sets = (openvr.VRActiveActionSet_t * 1)()
        self._sets[0].ulActionSet = self._input.getActionSetHandle(SET)
        self._hands = {side: self._input.getInputSourceHandle(f"/user/hand/{side}") for side in SIDES}
        self._pose, self._vibration = (
            self._input.getActionHandle(f"{SET}/{name}") for name in ("in/hand", "out/vibration")
        )
        self._actions = {
            button: self._input.getActionHandle(f"{SET}/in/{button}") for button in DIGITAL | ANALOG
        }
        self._heads = (openvr.TrackedDevicePose_t * 1)()  # SteamVR counts the head as device 0
        self._event = openvr.VREvent_t()

    def __enter__(self) -> Wands:
        return self

    def __exit__(self, *_: object) -> None:
        self._vr.shutdown()
        self._folder.cleanup()

    def look(self) -> tuple[dict[Side, Controller], Pose | None]:
        """The controllers that are tracked now, and the head."""
        self._input.updateActionState(self._sets)
        hands = {side: hand for side in SIDES if (hand := self._hand(self._hands[side])) is not None}
        self._system.getDeviceToAbsoluteTrackingPose(self._vr.TrackingUniverseStanding, 0.0, self._heads)
        head = self._heads[0]
        return hands, _pose_of(head) if head.bPoseIsValid else None

    def pulse(self, side: Side, amplitude: float, seconds: float) -> None:
        self._input.triggerHapticVibrationAction(
            self._vibration, 0.0, seconds, FREQUENCY, amplitude, self._hands[side]
        )

    def events(self) -> list[str]:
        """What has happened since the last call: "quit", "dashboard", "reset"."""
        names = {
            self._vr.VREvent_Quit: "quit",
            self._vr.VREvent_DashboardActivated: "dashboard",
            self._vr.VREvent_StandingZeroPoseReset: "reset",
        }
        found = []
        while self._system.pollNextEvent(self._event):
            if (name := names.get(self._event.eventType)) is not None:
                found.append(name)
        return found

    def _hand(self, device: int) -> Controller | None:
        vr = self._vr
        data = self._input.getPoseActionDataRelativeToNow(
            self._pose, vr.TrackingUniverseStanding, 0.0, device
        )
        # Anything but OK is dead reckoning, calibration or out of range.
        is_tracked = data.pose.bPoseIsValid and data.pose.eTrackingResult == vr.TrackingResult_Running_OK
        if not (data.bActive and is_tracked):
            return None
        buttons: dict[Button, float] = {}
        for button in DIGITAL:
            buttons[button] = float(self._input.getDigitalActionData(self._actions[button], device).bState)
        for button in ANALOG:
            value = float(self._input.getAnalogActionData(self._actions[button], device).x)
            buttons[button] = min(max(value, 0.0), 1.0)
        return Controller(_pose_of(data.pose), buttons)


def write_manifest(folder: Path) -> Path:
    """The action manifest and the binding of Vive wands, as SteamVR wants them: as files."""
    actions: list[dict[str, str]] = [
        {"name": f"{SET}/in/hand", "type": "pose"},
        {"name": f"{SET}/out/vibration", "type": "vibration"},
        *({"name": f"{SET}/in/{button}", "type": "boolean"} for button in DIGITAL),
        *({"name": f"{SET}/in/{button}", "type": "vector1"} for button in ANALOG),
    ]
    manifest = {
        "default_bindings": [{"controller_type": "vive_controller", "binding_url": "vive_controller.json"}],
        "actions": actions,
        "action_sets": [{"name": SET, "usage": "leftright"}],
        "localization": [{"language_tag": "en_us", SET: "Drive robot arms"}],
    }
    hands = [f"/user/hand/{side}" for side in SIDES]
    sources = [
        {
            "path": f"{hand}/input/{path}",
            "mode": "trackpad" if button == "pad" else "button",
            "inputs": {"click": {"output": f"{SET}/in/{button}"}},
        }
        for hand in hands
        for button, path in DIGITAL.items()
    ]
    sources += [
        {
            "path": f"{hand}/input/{path}",
            "mode": "trigger",
            "inputs": {"pull": {"output": f"{SET}/in/{button}"}},
        }
        for hand in hands
        for button, path in ANALOG.items()
    ]
    binding = {
        "controller_type": "vive_controller",
        "name": "Comp-ACT Studio",
        "bindings": {
            SET: {
                "poses": [{"output": f"{SET}/in/hand", "path": f"{hand}/pose/raw"} for hand in hands],
                "haptics": [
                    {"output": f"{SET}/out/vibration", "path": f"{hand}/output/haptic"} for hand in hands
                ],
                "sources": sources,
            }
        },
    }
    (folder / "vive_controller.json").write_text(json.dumps(binding, indent=1))
    path = folder / "actions.json"
    path.write_text(json.dumps(manifest, indent=1))
    return path


def drive(
    socket: Path,
    settings: Settings,
    *,
    openvr: Any = None,
    ended: threading.Event | None = None,
    tell: Callable[[str], None] = print,
) -> None:
    """Let the wands drive the session at `socket` until `ended` is set, SteamVR quits or the session does.

    Raises `SteamVrMissing`, or TimeoutError where no session answers.
    """
    ended = ended or threading.Event()
    with Wands(openvr or import_openvr()) as wands:
        session = _Session(socket)
        controllers = Controllers(session.send, settings)
        tell("SteamVR drives. The menu button takes hold of an arm, and lets go. Ctrl-C ends.")
        clock = Clock(1.0 / RATE)
        try:
            while session.is_open and not ended.is_set():
                events = wands.events()
                if "quit" in events:
                    break
                _lose(controllers, events)
                sampled = time.monotonic()
                hands, head = wands.look()
                controllers.update(hands, head, Moment(sampled), session.status)
                for side, amplitude in session.new_amplitudes(settings):
                    wands.pulse(side, amplitude, PULSE)
                for notice in session.notices.drain():
                    tell(notice.text)
                clock.wait()
        finally:
            controllers.lose("SteamVR was left.")
            session.close()


def _lose(controllers: Controllers, events: list[str]) -> None:
    if "reset" in events:
        controllers.lose("The room was recentred.")
        controllers.forget_facing()
    elif "dashboard" in events:
        controllers.lose("SteamVR's dashboard is open.")


class _Session:
    """What the loop knows of the session, newest first."""

    def __init__(self, socket: Path) -> None:
        self.notices: Mailbox[Notice] = Mailbox()
        self._status: Latest[Status] = Latest()
        self._frame: Latest[tuple[Frame, float]] = Latest()  # and when it came [s]
        self._felt = 0  # frames that had come when one was last felt
        self._link = connect(socket, self._hear, timeout=5.0)

    @property
    def status(self) -> Status | None:
        return self._status.get()[0]

    @property
    def is_open(self) -> bool:
        return self._link.is_open

    def send(self, command: Command) -> None:
        self._link.send(command)

    def close(self) -> None:
        self._link.close()

    def new_amplitudes(self, settings: Settings) -> Iterator[tuple[Side, float]]:
        """How strongly each hand is to vibrate, once for each frame that is still fresh."""
        newest, count = self._frame.get()
        if self.status is None or newest is None or count == self._felt:
            return
        self._felt = count
        frame, came = newest
        if time.monotonic() > came + STALE:
            return
        names = [arm.name for arm in self.status.arms]
        for name, arm in zip(names, frame.arms, strict=False):
            amplitude = settings.haptics.amplitude(arm.wrench[:3])
            for side in SIDES:
                if amplitude > 0.0 and side == (settings.one_arm if len(names) == 1 else name):
                    yield side, amplitude

    def _hear(self, report: Report) -> None:
        match report:
            case Status():
                self._status.set(report)
            case Frame():
                self._frame.set((report, time.monotonic()))
            case Notice():
                self.notices.post(report)


def import_openvr() -> Any:
    """The module, or `SteamVrMissing`."""
    try:
        import openvr
    except ImportError as error:
        raise SteamVrMissing(
            f"PyOpenVR is missing: pip install 'compact-studio[steamvr]'. {INSTALL}"
        ) from error
    return openvr


def _pose_of(tracked: Any) -> Pose:
    return pose_of_matrix(np.array([list(row) for row in tracked.mDeviceToAbsoluteTracking.m]))
