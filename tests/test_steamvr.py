"""SteamVR's wands at a real session, by a small module that implements the calls of PyOpenVR that we use."""

from __future__ import annotations

import ctypes
import json
import math
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from staged import Site
from visitor import wait_for

from studio.inputs.controllers import PAPER, Settings, Side
from studio.inputs.steamvr import SteamVrMissing, Wands, drive, write_manifest


class Matrix(ctypes.Structure):
    _fields_ = [("m", (ctypes.c_float * 4) * 3)]


class TrackedPose(ctypes.Structure):
    _fields_ = [
        ("mDeviceToAbsoluteTracking", Matrix),
        ("eTrackingResult", ctypes.c_int),
        ("bPoseIsValid", ctypes.c_bool),
    ]


class ActionSet(ctypes.Structure):
    _fields_ = [("ulActionSet", ctypes.c_uint64)]


class Event(ctypes.Structure):
    _fields_ = [("eventType", ctypes.c_uint32)]


class Data:
    """Of an action."""

    def __init__(self, **fields: Any) -> None:
        self.__dict__.update(fields)


class OpenVr:
    """The module `openvr`, with two wands and a head that a test moves."""

    VRApplication_Other, TrackingUniverseStanding, TrackingResult_Running_OK = 0, 1, 200
    VREvent_Quit, VREvent_DashboardActivated, VREvent_StandingZeroPoseReset = 700, 502, 808
    VRActiveActionSet_t, TrackedDevicePose_t, VREvent_t = ActionSet, TrackedPose, Event

    class OpenVRError(Exception):
        pass

    class InitError_Init_PathRegistryNotFound(OpenVRError):
        pass

    def __init__(self, *, is_installed: bool = True, starts: bool = True) -> None:
        self.is_installed, self.starts = is_installed, starts
        self.places: dict[Side, list[float]] = {"left": [-0.2, 1.1, -0.3], "right": [0.2, 1.1, -0.3]}
        self.pressed: dict[str, dict[str, float]] = {"left": {}, "right": {}}
        self.pulses: list[tuple[str, float, float]] = []  # side, amplitude, seconds
        self.pending: list[int] = []
        self._handles: list[str] = [""]  # a handle is the index of a name
        self.manifest: dict[str, Any] = {}

    def isRuntimeInstalled(self) -> bool:
        return self.is_installed

    def init(self, application: int) -> OpenVr:
        assert application == self.VRApplication_Other
        if not self.starts:
            raise self.InitError_Init_PathRegistryNotFound
        return self

    def shutdown(self) -> None:
        self.places.clear()

    def VRInput(self) -> OpenVr:
        return self

    def pollNextEvent(self, event: Event) -> bool:
        if self.pending:
            event.eventType = self.pending.pop(0)
            return True
        return False

    def getDeviceToAbsoluteTrackingPose(self, universe: int, ahead: float, poses: Any) -> None:
        poses[0] = self._tracked([0.0, 1.6, 0.0])

    def setActionManifestPath(self, path: str) -> None:
        self.manifest = json.loads(Path(path).read_text())
        for binding in self.manifest["default_bindings"]:
            json.loads((Path(path).parent / binding["binding_url"]).read_text())

    def getActionHandle(self, name: str) -> int:
        known = {action["name"] for action in self.manifest["actions"]}
        assert name in known, f"{name} is none of {known}"
        return self._handle(name)

    def getActionSetHandle(self, name: str) -> int:
        assert name in {group["name"] for group in self.manifest["action_sets"]}
        return self._handle(name)

    def getInputSourceHandle(self, path: str) -> int:
        return self._handle(path)

    def updateActionState(self, sets: Any) -> None:
        assert self._handles[sets[0].ulActionSet] == "/actions/drive"

    def getPoseActionDataRelativeToNow(self, action: int, universe: int, ahead: float, device: int) -> Data:
        place = self.places.get(self._side(device))
        return Data(bActive=place is not None, pose=self._tracked(place or [0.0, 0.0, 0.0]))

    def getDigitalActionData(self, action: int, device: int) -> Data:
        return Data(bState=self._value(action, device) > 0.5)

    def getAnalogActionData(self, action: int, device: int) -> Data:
        return Data(x=self._value(action, device))

    def triggerHapticVibrationAction(
        self, action: int, start: float, seconds: float, frequency: float, amplitude: float, device: int
    ) -> None:
        assert self._handles[action].endswith("vibration")
        self.pulses.append((self._side(device), amplitude, seconds))

    def press(self, side: Side, button: str) -> None:
        for value in (1.0, 0.0):
            self.pressed[side][button] = value
            threading.Event().wait(0.05)

    def move(self, side: Side, *way: float) -> None:
        for _ in range(20):
            self.places[side] = [a + b / 20 for a, b in zip(self.places[side], way, strict=True)]
            threading.Event().wait(0.012)

    def _handle(self, name: str) -> int:
        if name not in self._handles:
            self._handles.append(name)
        return self._handles.index(name)

    def _side(self, device: int) -> Side:
        return "left" if self._handles[device].endswith("left") else "right"

    def _value(self, action: int, device: int) -> float:
        return self.pressed[self._side(device)].get(self._handles[action].rpartition("/")[2], 0.0)

    def _tracked(self, place: list[float]) -> TrackedPose:
        pose = TrackedPose(eTrackingResult=200, bPoseIsValid=True)
        for row in range(3):
            for column in range(3):
                pose.mDeviceToAbsoluteTracking.m[row][column] = float(row == column)
            pose.mDeviceToAbsoluteTracking.m[row][3] = place[row]
        return pose


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    site = Site(tmp_path_factory.mktemp("steamvr"))
    yield site
    site.close()


@pytest.fixture
def vr(stage: Site) -> Iterator[OpenVr]:
    """A SteamVR whose wands drive."""
    stage.begin("peg-cylinder")
    yield from driving(stage)


def driving(stage: Site) -> Iterator[OpenVr]:
    vr, ended, said = OpenVr(), threading.Event(), list[str]()
    options = {"openvr": vr, "ended": ended, "tell": said.append}
    thread = threading.Thread(target=drive, args=(stage.socket, Settings()), kwargs=options)
    thread.start()
    wait_for(lambda: said and all(arm.hand and arm.hand.age for arm in stage.status.arms))
    yield vr
    ended.set()
    thread.join()


def test_a_wand_leads_its_arm_with_the_papers_buttons(stage: Site, vr: OpenVr) -> None:
    start, stiffness = stage.target(), stage.arm().stiffness
    vr.press("right", "menu")
    wait_for(stage.is_engaged)
    assert np.abs(stage.target() - start).max() < 1e-9
    vr.move("right", 0.01, 0.02, -0.03)
    wait_for(lambda: np.abs(stage.target()[:3] - start[:3] - [0.03, -0.01, 0.02]).max() < 1e-6)
    vr.press("right", "squeeze")
    wait_for(lambda: stage.arm().stiffness == stiffness / 2)
    vr.pressed["right"]["trigger"] = 1.0
    threading.Event().wait(0.05)
    vr.pressed["right"]["trigger"] = 0.25
    wait_for(lambda: stage.status.arms[1].opening == 0.75)
    vr.press("right", "menu")
    wait_for(lambda: not stage.is_engaged())


def test_a_wand_out_of_sight_and_the_dashboard_let_go(stage: Site, vr: OpenVr) -> None:
    for side in ("left", "right"):
        vr.press(side, "menu")  # type: ignore[arg-type]
    wait_for(lambda: stage.is_engaged(0) and stage.is_engaged(1))
    vr.places.pop("left")
    wait_for(lambda: not stage.is_engaged(0) and "not tracked" in stage.hand(0).why)
    assert stage.is_engaged(1)
    vr.pending.append(vr.VREvent_DashboardActivated)
    wait_for(lambda: not stage.is_engaged(1) and "dashboard" in stage.hand(1).why)


def test_contact_vibrates(stage: Site) -> None:
    stage.begin("wiping")
    for vr in driving(stage):
        vr.press("right", "menu")
        wait_for(lambda: stage.is_engaged(0))
        for _ in range(60):
            if np.linalg.norm(stage.arm(0).wrench[:3]) > 15.0:
                break
            vr.move("right", 0.0, -0.008, 0.0)
        vr.pulses.clear()
        threading.Event().wait(0.5)
        felt = list(vr.pulses)
        assert len(felt) >= 10  # 20 Hz at least
        assert {side for side, _, _ in felt} == {"right"}
        force = float(np.linalg.norm(stage.arm(0).wrench[:3]))
        assert felt[-1][1] == pytest.approx((force - 3.0) / 47.0, abs=0.1)
        assert all(seconds <= 0.2 for _, _, seconds in felt)


@pytest.mark.parametrize(
    ("vr", "words"),
    [(OpenVr(is_installed=False), "not installed"), (OpenVr(starts=False), "PathRegistryNotFound")],
)
def test_without_steamvr_one_sentence_says_what_to_install(vr: OpenVr, words: str) -> None:
    with pytest.raises(SteamVrMissing, match=words) as told:
        Wands(vr)
    assert "Install Steam and SteamVR" in str(told.value)


def test_a_turned_wand_is_turned_in_our_axes() -> None:
    with Wands(OpenVr()) as wands:
        hands, head = wands.look()
    assert hands["right"].pose.position == pytest.approx([0.3, -0.2, 1.1])
    assert head is not None
    assert head.position == pytest.approx([0.0, 0.0, 1.6])
    assert math.isclose(abs(float(hands["right"].pose.wxyz[0])), 1.0)


def test_every_button_of_the_paper_is_bound_on_both_wands(tmp_path: Path) -> None:
    manifest = json.loads(write_manifest(tmp_path).read_text())
    binding = json.loads((tmp_path / "vive_controller.json").read_text())["bindings"]["/actions/drive"]
    actions = {action["name"] for action in manifest["actions"]}
    bound = [source["inputs"] for source in binding["sources"]]
    outputs = [way["output"] for inputs in bound for way in inputs.values()]
    for button in (PAPER.clutch, PAPER.gripper, PAPER.stiffness):
        assert outputs.count(f"/actions/drive/in/{button}") == 2
    assert set(outputs) <= actions
    assert {way["path"] for way in binding["haptics"]} == {
        "/user/hand/left/output/haptic",
        "/user/hand/right/output/haptic",
    }
