"""Takes as Rerun recordings: the robot in 3-D, forces, stiffness and cameras, laid out by a blueprint.

    OUT/<episode id>.rrd     as recorded, within the trim; times are those of the take [s]
        takes.json

Rerun reads only the files of its own and the version before (https://rerun.io): look at them, archive takes.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from controller.types import Array, Pose
from studio import meshes, tasks
from studio.cursor import ArmTrack, Cursor
from studio.episode import Episode, open_episode
from studio.export.folder import Progress
from studio.export.source import Take, cameras_of
from studio.schema import ARROW_LENGTH
from studio.twin import build_model

if TYPE_CHECKING:
    from studio.export import Options

APPLICATION = "compact-studio"
TIMELINE = "time"
POSE_RATE = 30.0  # [Hz] of the bodies in 3-D
FIRST_VIEW = np.array([0.7, -0.9, 0.6])  # [m] from the tools to the eye at first

RED, GREEN, BLUE = (226, 60, 60), (70, 170, 80), (70, 120, 230)
FORCE_COLOR, TARGET_COLOR, PATH_COLOR = (230, 90, 40), (250, 190, 60), (130, 160, 200)

log = logging.getLogger(__name__)

_scenes: dict[str, _Scene] = {}  # by task; building one takes a second


def write(takes: Sequence[Take], folder: Path, options: Options, progress: Progress) -> None:
    """One `.rrd` for each take. Of the options only the cameras matter."""
    for take in takes:
        progress.advance(0.0, take.episode_id)
        with open_episode(take.path) as episode:
            data = _recorded(take, episode, cameras_of(take.header, options.cameras))
        (folder / f"{take.episode_id}.rrd").write_bytes(data)
        progress.advance(take.span[1] - take.span[0], take.episode_id)


class _Scene:
    """Meshes of a task's bodies, each in the frame of one that moves."""

    def __init__(self, task: str) -> None:
        self.task = task
        self.model = build_model(tasks.load(task))
        at_rest = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, at_rest)

        world_from = [
            Pose(position.copy(), wxyz.copy())
            for position, wxyz in zip(at_rest.xpos, at_rest.xquat, strict=True)
        ]
        self.glbs: dict[int, bytes] = {}  # by body that moves; 0 is the world
        for group in np.unique(self.model.body_weldid).tolist():
            members = np.flatnonzero(self.model.body_weldid == group).tolist()
            geoms = meshes.visible_geoms(self.model, members)
            group_from = {body: world_from[group].inverse() @ world_from[body] for body in members}
            if geoms:
                self.glbs[group] = meshes.glb_of(self.model, geoms, group_from.__getitem__)

    def path(self, body: int) -> str:
        return f"world/scene/{self.model.body(body).name}"


def _recorded(take: Take, episode: Episode, cameras: Sequence[str]) -> bytes:
    """A take's `.rrd`, in memory: where Rerun writes files itself, a full disk goes unnoticed."""
    recording = rr.RecordingStream(APPLICATION, recording_id=take.episode_id, send_properties=False)
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    stream = recording.binary_stream()
    recording.send_recording_name(f"{take.header.task} {take.episode_id}")
    scene, cursor = _read(episode)
    recording.send_blueprint(_blueprint(cursor.arms, cameras))
    start, end = take.span
    recording.log("notes", rr.TextDocument(_notes(take), media_type="text/markdown"), static=True)
    if scene is not None:
        _send_bodies(recording, scene, cursor, start, end)
    for arm in cursor.arms:
        _send_arm(recording, arm, start, end)
    for mark in cursor.marks:
        if start <= mark.start <= end:
            level = "WARN" if mark.kind in ("limited", "refused") else "INFO"
            recording.set_time(TIMELINE, duration=mark.start)
            text = mark.text if mark.arm is None else f"{mark.arm}: {mark.text}"
            recording.log("events", rr.TextLog(text, level=level))
    for camera in cameras:
        _send_images(recording, episode, camera, start, end)
    return bytes(stream.read() or b"")


def _read(episode: Episode) -> tuple[_Scene | None, Cursor]:
    """With the scene where this version has the take's task as it was recorded."""
    task = episode.header.task
    if task in tasks.names():
        if task not in _scenes:
            _scenes[task] = _Scene(task)
        try:
            return _scenes[task], Cursor(episode, _scenes[task].model)
        except ValueError as error:
            log.warning("%s: without meshes: %s", episode.header.episode_id, error)
    return None, Cursor(episode)


def _send_bodies(
    recording: rr.RecordingStream, scene: _Scene, cursor: Cursor, start: float, end: float
) -> None:
    """Meshes once, poses in the world at 30 Hz."""
    for body, glb in scene.glbs.items():
        asset = rr.Asset3D(contents=glb, media_type=rr.MediaType.GLB)
        recording.log(scene.path(body), asset, static=True)
    moving = [body for body in scene.glbs if body != 0]
    times = np.arange(start, end + 1e-9, 1 / POSE_RATE)
    positions, turns = np.empty((len(moving), len(times), 3)), np.empty((len(moving), len(times), 4))
    data = mujoco.MjData(scene.model)
    for index, time in enumerate(times):
        qpos = cursor.at(float(time)).qpos
        assert qpos is not None
        data.qpos[:] = qpos
        mujoco.mj_kinematics(scene.model, data)
        positions[:, index], turns[:, index] = data.xpos[moving], data.xquat[moving]
    for body, position, wxyz in zip(moving, positions, turns, strict=True):
        columns = rr.Transform3D.columns(translation=position, quaternion=np.roll(wxyz, -1, axis=1))
        recording.send_columns(scene.path(body), [_times(times)], columns)


def _send_arm(recording: rr.RecordingStream, arm: ArmTrack, start: float, end: float) -> None:
    """Force, torque, gripper and joints at 500 Hz, stiffness and target at 100 Hz, arrows at 30 Hz."""
    seen = (arm.time >= start) & (arm.time <= end)
    told = (arm.action_time >= start) & (arm.action_time <= end)
    known, issued = arm.time[seen], arm.action_time[told]
    measured = {
        "force": arm.wrench[seen, :3],
        "torque": arm.wrench[seen, 3:],
        "gripper": arm.gripper[seen, None],
        "joints": arm.q[seen],
    }
    for name, values in measured.items():
        _send_curves(recording, f"{arm.name}/{name}", known, values)
    _send_curves(recording, f"{arm.name}/stiffness", issued, arm.stiffness[told, None])
    _send_curves(recording, f"{arm.name}/tracking_error", issued, 1e3 * _lag(arm)[told, None])
    path = arm.path()[seen]
    every = max(1, round(len(known) / max((end - start) * POSE_RATE, 1.0)))
    tool = f"world/{arm.name}"
    recording.log(
        f"{tool}/path", rr.LineStrips3D([path[::every]], colors=PATH_COLOR, radii=0.001), static=True
    )
    vectors = arm.wrench[seen, :3][::every] @ arm.world_from_base.rotation.T * ARROW_LENGTH
    arrows = rr.Arrows3D.columns(vectors=np.nan_to_num(vectors), origins=path[::every])
    recording.log(f"{tool}/force", rr.Arrows3D.from_fields(colors=FORCE_COLOR, radii=0.005), static=True)
    recording.send_columns(f"{tool}/force", [_times(known[::every])], arrows)
    target = arm.world_from_base.apply(arm.base_from_target[told, :3])
    there = np.isfinite(target[:, 0])
    recording.log(f"{tool}/target", rr.Points3D.from_fields(colors=TARGET_COLOR, radii=0.007), static=True)
    recording.send_columns(
        f"{tool}/target", [_times(issued[there])], rr.Points3D.columns(positions=target[there])
    )


def _lag(arm: ArmTrack) -> Array:
    """(m,) [m] from the tool to its target when each action was told."""
    seen = np.maximum(np.searchsorted(arm.time, arm.action_time + 1e-9, side="right") - 1, 0)
    return np.asarray(np.linalg.norm(arm.base_from_target[:, :3] - arm.base_from_tcp[seen, :3], axis=1))


CURVES: dict[str, tuple[tuple[str, tuple[int, int, int]], ...]] = {
    "force": (("fx [N]", RED), ("fy [N]", GREEN), ("fz [N]", BLUE)),
    "torque": (("tx [N·m]", RED), ("ty [N·m]", GREEN), ("tz [N·m]", BLUE)),
    "stiffness": (("stiffness [N/m]", TARGET_COLOR),),
    "gripper": (("opening", PATH_COLOR),),
    "tracking_error": (("target to tool [mm]", FORCE_COLOR),),
}


def _send_curves(recording: rr.RecordingStream, path: str, times: Array, values: Array) -> None:
    """(n, k) `values` as k curves."""
    curves = CURVES.get(path.split("/")[-1])
    if curves:
        names, colors = zip(*curves, strict=True)
        recording.log(path, rr.SeriesLines(names=names, colors=colors), static=True)
    n, width = values.shape
    scalars = rr.Scalars.columns(scalars=values.ravel()).partition([width] * n)
    recording.send_columns(path, [_times(times)], scalars)


def _send_images(
    recording: rr.RecordingStream, episode: Episode, camera: str, start: float, end: float
) -> None:
    """JPEGs as recorded."""
    times = episode.image_times(camera)
    numbers = np.flatnonzero((times >= start - 1e-9) & (times <= end + 1e-9)).tolist()
    jpegs = [episode.jpeg(camera, number) for number in numbers]
    if jpegs:
        columns = rr.EncodedImage.columns(blob=jpegs, media_type=["image/jpeg"] * len(jpegs))
        recording.send_columns(f"camera/{camera}", [_times(times[numbers])], columns)


def _times(times: Array) -> rr.TimeColumn:
    return rr.TimeColumn(TIMELINE, duration=times)


def _notes(take: Take) -> str:
    header = take.header
    lines = {
        "task": header.task,
        "instruction": header.instruction,
        "outcome": take.outcome,
        "operator": header.operator,
        "agent": header.agent,
        "wrench": f"{header.wrench_sign}, {header.wrench_frame}",
        "edits": str(take.edit_version),
    }
    return f"# {take.episode_id}\n\n" + "\n".join(f"- {name}: {value}" for name, value in lines.items())


def _blueprint(arms: Sequence[ArmTrack], cameras: Sequence[str]) -> rrb.Blueprint:
    """The robot beside its cameras, and under them one column of plots for each arm."""
    views = [rrb.Spatial2DView(origin=f"camera/{name}", name=name) for name in cameras]
    seen = [rrb.Vertical(*views)] if views else []
    plots = [
        rrb.TimeSeriesView(origin=f"{arm.name}/{name}", name=f"{arm.name} {name.replace('_', ' ')}")
        for name in ("force", "torque", "stiffness")
        for arm in arms
    ]
    more = [
        rrb.TimeSeriesView(origin=f"{arm.name}/{name}", name=f"{arm.name} {name.replace('_', ' ')}")
        for name in ("tracking_error", "gripper")
        for arm in arms
    ]
    work = np.nanmean([arm.path()[0] for arm in arms], axis=0)
    eye = rrb.EyeControls3D(position=work + FIRST_VIEW, look_target=work, eye_up=(0.0, 0.0, 1.0))
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial3DView(origin="world", name="robot", eye_controls=eye),
                *seen,
                column_shares=[3, 1][: 1 + len(seen)],
            ),
            rrb.Tabs(
                rrb.Grid(*plots, grid_columns=len(arms), name="force and stiffness"),
                rrb.Grid(*more, grid_columns=len(arms), name="tracking"),
                rrb.TextLogView(origin="events", name="events"),
                rrb.TextDocumentView(origin="notes", name="notes"),
            ),
            row_shares=[3, 2],
        ),
        rrb.TimePanel(state="collapsed"),
        collapse_panels=True,
    )
