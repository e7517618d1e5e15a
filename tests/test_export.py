"""Exports: all or nothing, alike or refused, and telling what they hold."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest
from exported import names, record

from controller.types import JointTarget, Stiffness, quaternion_from_rotation_vector, rotation_of
from studio.__main__ import main
from studio.api import DemoReport, Studio
from studio.export import FORMATS, Cancelled, Format, Options, choose
from studio.session import CONTROL_PERIOD


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two takes of two arms and two cameras, of 1.0 and 0.6 s. Tests only read it."""
    folder = tmp_path_factory.mktemp("made-up")
    for seconds in (1.0, 0.6):
        record(folder, seconds, arms=("left", "right"))
    return folder


@pytest.fixture(scope="module")
def studio(data: Path) -> Iterator[Studio]:
    with Studio(data) as studio:
        yield studio


def ids_of(studio: Studio) -> list[str]:
    """The longest first."""
    return [row.episode_id for row in sorted(studio.episodes(), key=lambda row: -row.duration)]


# What every format has


@pytest.mark.parametrize("form", FORMATS)
def test_an_export_tells_its_takes_and_the_version_of_their_edits(tmp_path: Path, form: Format) -> None:
    first = record(tmp_path, 0.5)
    with Studio(tmp_path) as studio:
        studio.annotate(first, author="ann", outcome="failure", trim=(0.1, 0.4))
        exported = studio.export([first], tmp_path / "out", form)
    told = json.loads((tmp_path / "out" / "takes.json").read_text())
    assert (told["format"], exported.episode_ids) == (form, (first,))
    (take,) = told["takes"]
    assert (take["episode_id"], take["edit_version"], take["outcome"]) == (first, 1, "failure")
    assert take["trim"] == [0.1, 0.4]
    assert take["header"]["robot"] == "made-up"
    assert exported.seconds == pytest.approx(0.3)
    assert exported.size == sum(
        path.stat().st_size for path in (tmp_path / "out").rglob("*.*") if path.is_file()
    )


@pytest.mark.parametrize("form", FORMATS)
def test_a_cancelled_export_leaves_nothing_behind(studio: Studio, tmp_path: Path, form: Format) -> None:
    (tmp_path / "mine.txt").write_text("kept")
    cancel = threading.Event()

    def tell(share: float, what: str) -> None:
        cancel.set()

    with pytest.raises(Cancelled, match="Cancelled at"):
        studio.export(ids_of(studio), tmp_path / "out", form, on_progress=tell, cancel=cancel)
    assert names(tmp_path) == ["mine.txt"]
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@contextmanager
def full_disk_after(size: int) -> Iterator[None]:
    """No file may grow beyond `size` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("form", FORMATS)
def test_a_full_disk_removes_only_the_half_written_folder(
    studio: Studio, tmp_path: Path, form: Format
) -> None:
    (tmp_path / "mine.txt").write_text("kept")
    with full_disk_after(20_000), pytest.raises((OSError, RuntimeError)):
        studio.export(ids_of(studio), tmp_path / "out", form)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_an_export_goes_to_a_new_or_empty_folder_only(studio: Studio, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("kept")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileExistsError, match="not empty"):
        studio.export(ids_of(studio), tmp_path / "full", "rrd")
    with pytest.raises(NotADirectoryError, match="is a file"):
        studio.export(ids_of(studio), tmp_path / "full" / "mine.txt", "rrd")
    assert names(tmp_path) == ["full/mine.txt"]
    studio.export(ids_of(studio)[:1], tmp_path / "empty", "rrd")
    assert "takes.json" in names(tmp_path / "empty")


def test_takes_that_differ_are_refused_with_what_differs(tmp_path: Path) -> None:
    plain = record(tmp_path, 0.1)
    other_task = record(tmp_path, 0.1, task="other")
    other_cameras = record(tmp_path, 0.1, cameras=("front",))
    other_arms = record(tmp_path, 0.1, arms=("left",))
    with Studio(tmp_path) as studio:
        for other, told in (
            (other_task, f"their task differ: made-up: {plain}; other: {other_task}"),
            (other_cameras, "their cameras differ: front 320x240, wrist 320x240"),
            (other_arms, "their arms differ: right"),
        ):
            with pytest.raises(ValueError, match=told):
                studio.export([plain, other], tmp_path / "out", "act-hdf5")
            assert not (tmp_path / "out").exists()
        studio.export([plain, other_cameras], tmp_path / "out", "act-hdf5", Options(cameras=("front",)))
        with pytest.raises(KeyError, match="No camera 'top'; the takes have"):
            studio.export([plain], tmp_path / "two", "act-hdf5", Options(cameras=("top",)))


def test_nonsense_is_refused(studio: Studio, tmp_path: Path) -> None:
    first = ids_of(studio)[0]
    with pytest.raises(ValueError, match="exported twice"):
        studio.export([first, first], tmp_path / "out", "rrd")
    with pytest.raises(ValueError, match="No take is chosen"):
        studio.export([], tmp_path / "out", "rrd")
    with pytest.raises(KeyError, match="No episode 'nobody'"):
        studio.export(["nobody"], tmp_path / "out", "rrd")
    with pytest.raises(KeyError, match="No format 'csv'"):
        studio.export([first], tmp_path / "out", "csv")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="from 1 to 100 Hz"):
        Options(rate=500)


def test_an_earlier_version_of_the_edits_can_be_exported(tmp_path: Path) -> None:
    first = record(tmp_path, 0.5)
    with Studio(tmp_path) as studio:
        studio.annotate(first, author="ann", trim=(0.1, 0.4))
        studio.annotate(first, author="ann", trim=(0.2, 0.3))
        (take,) = choose(studio.catalog, [first], {first: 1})
        assert (take.trim, take.edit_version) == ((0.1, 0.4), 1)
        with pytest.raises(ValueError, match="no version 3"):
            choose(studio.catalog, [first], {first: 3})


# The command


def run_studio(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def test_the_command_exports_by_id_filter_or_collection(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = record(tmp_path, 0.2), record(tmp_path, 0.2, success=False)
    with Studio(tmp_path) as studio:
        studio.make_collection("both", author="ann", episode_ids=[second, first])
        studio.annotate(first, author="ann", outcome="failure")
    for number, (which, expected) in enumerate(
        (
            ([second], [second]),
            (["--outcome", "failure"], [first, second]),
            (["--collection", "both"], [second, first]),
        )
    ):
        out = tmp_path / f"out-{number}"
        options = ("--out", out, "--format", "act-hdf5", "--no-images", "--data", tmp_path, "--json")
        assert run_studio("export", *which, *options) == 0
        told = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert (told["episode_ids"], told["format"]) == (expected, "act-hdf5")
        takes = json.loads((out / "takes.json").read_text())["takes"]
    assert [take["outcome"] for take in takes] == ["failure", "success"]  # as they were in the collection


def test_the_command_says_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    take = record(tmp_path, 0.2)
    for arguments, status, told in (
        ([], 2, "Say which takes"),
        ([take, "--task", "made-up"], 2, "Say which takes"),
        (["--task", "drawing"], 2, "No take is chosen"),
        ([take, "--out", tmp_path], 1, "is not empty"),
        ([take, "--rate", "0"], 2, "from 1 to 100 Hz"),
    ):
        out = () if "--out" in arguments else ("--out", tmp_path / "out")
        assert run_studio("export", *arguments, *out, "--data", tmp_path) == status
        assert told in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


# ACT HDF5


def test_act_files_have_the_layout_of_the_paper(studio: Studio, tmp_path: Path) -> None:
    first, second = ids_of(studio)
    studio.export([first, second], tmp_path / "out", "act-hdf5")
    shapes = {
        "observations/qpos": (20, 14),
        "observations/qvel": (20, 14),
        "observations/eef_pos": (20, 14),
        "observations/ft": (20, 12),
        "observations/q_command": (20, 12),
        "observations/images/front": (20, 240, 320, 3),
        "observations/images/wrist": (20, 240, 320, 3),
        "action": (20, 38),
    }
    for number, (name, length) in enumerate(((first, 20), (second, 12))):
        with h5py.File(tmp_path / "out" / f"episode_{number}.hdf5") as file:
            assert {path: file[path].shape for path in shapes} == shapes
            assert file["observations/images/front"].dtype == np.uint8
            assert file["observations/images/front"].chunks == (1, 240, 320, 3)
            assert (file.attrs["length"], file.attrs["max_timesteps"]) == (length, 20)
            assert (file.attrs["episode_id"], file.attrs["sim"]) == (name, True)
            assert list(file.attrs["camera_names"]) == ["front", "wrist"]
            assert np.array_equal(file["action"][length - 1], file["action"][-1])
            last = file["observations/images/wrist"]
            assert np.array_equal(last[length - 1], last[-1])


def test_act_files_hold_the_take_at_each_row(studio: Studio, tmp_path: Path) -> None:
    first = ids_of(studio)[0]
    studio.export([first], tmp_path / "out", "act-hdf5", Options(pad=False))
    with h5py.File(tmp_path / "out" / "episode_0.hdf5") as file, studio.open(first) as episode:
        columns = episode.columns()
        state, tick = slice(0, None, 25), slice(0, None, 5)  # 20 of 500 and of 100 Hz
        for index, arm in enumerate(("left", "right")):
            of_arm = slice(7 * index, 7 * index + 7)
            q, gripper = columns[f"{arm}/state/q"][state], columns[f"{arm}/state/gripper"][state]
            joined = np.column_stack((q, gripper))[: len(file["action"])].astype(np.float32)
            assert np.array_equal(file["observations/qpos"][:, of_arm], joined)
            wrench = columns[f"{arm}/state/wrench"][state].astype(np.float32)
            assert np.array_equal(file["observations/ft"][:, 6 * index : 6 * index + 6], wrench[:20])
            action = file["action"][:, 19 * index : 19 * index + 19].astype(float)
            target = columns[f"{arm}/applied/base_from_target"][tick]
            assert np.abs(action[:, 12:15] - target[:, :3]).max() < 1e-6
            for row, pose, stiffness in zip(
                action, target, columns[f"{arm}/applied/stiffness"][tick], strict=True
            ):
                turn = rotation_of(quaternion_from_rotation_vector(row[15:18]))
                assert np.abs(turn - rotation_of(pose[3:])).max() < 1e-5
                upper = np.zeros((2, 3, 3))
                upper[:, *np.triu_indices(3)] = row[:12].reshape(2, 6)
                translational, rotational = np.swapaxes(upper, 1, 2) @ upper
                told = Stiffness.from_vector(stiffness)
                assert np.allclose(translational, told.translational, rtol=1e-6, atol=1e-3)
                assert np.allclose(rotational, told.rotational, rtol=1e-6, atol=1e-3)
            assert np.array_equal(action[:, 18].astype(np.float32), np.full(20, 0.5, np.float32))
        for row in range(20):
            assert np.array_equal(file["observations/images/wrist"][row], episode.image("wrist", row))


def test_trims_cut_an_export_to_the_row(tmp_path: Path) -> None:
    first = record(tmp_path, 1.0)
    with Studio(tmp_path) as studio:
        studio.annotate(first, author="ann", trim=(0.25, 0.5))
        studio.export([first], tmp_path / "out", "act-hdf5")
        with h5py.File(tmp_path / "out" / "episode_0.hdf5") as file, studio.open(first) as episode:
            q = episode.columns("right/state")["right/state/q"][125:251:25].astype(np.float32)
            assert np.array_equal(file["observations/qpos"][:, :6], q)  # 0.25 s to 0.5 s: six rows
            assert np.array_equal(file["observations/images/front"][0], episode.image("front", 5))


def test_a_take_without_targets_is_refused_with_what_helps(tmp_path: Path) -> None:
    joints = record(tmp_path, 0.3, cameras=(), action=JointTarget(np.zeros(6)))
    with Studio(tmp_path) as studio:
        with pytest.raises(ValueError, match=r"follows no Cartesian target for 100% of its time.*as joints"):
            studio.export([joints], tmp_path / "out", "act-hdf5")
        studio.export([joints], tmp_path / "out", "act-hdf5", Options(control="joints"))
        with h5py.File(tmp_path / "out" / "episode_0.hdf5") as file:
            assert not file["action"][:, :6].any()  # the joints that were asked for
        studio.annotate(joints, author="ann", trim=(0.1, 0.12))
        with pytest.raises(ValueError, match="fewer than two rows at 20 Hz within its trim"):
            studio.export([joints], tmp_path / "two", "act-hdf5", Options(control="joints"))


def test_joint_actions_are_what_the_servo_commanded_next(studio: Studio, tmp_path: Path) -> None:
    first = ids_of(studio)[0]
    studio.export([first], tmp_path / "out", "act-hdf5", Options(control="joints", cameras=()))
    with h5py.File(tmp_path / "out" / "episode_0.hdf5") as file, studio.open(first) as episode:
        commanded = episode.columns("left/state")["left/state/q_command"][round(CONTROL_PERIOD * 500) :: 25]
        assert np.array_equal(file["action"][:, :6], commanded[:20].astype(np.float32))
        assert file["action"].shape == (20, 14)
        assert "images" not in file["observations"]


# Rerun


def verified(path: Path) -> str:
    """What `rerun rrd verify` says of a file that it passes."""
    command = [Path(sys.executable).parent / "rerun", "rrd", "verify", path]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return done.stdout + done.stderr


def entities(path: Path) -> dict[str, set[str]]:
    """Components of each entity of an `.rrd`."""
    from rerun.chunk import RrdReader

    found: dict[str, set[str]] = {}
    for chunk in RrdReader(path).stream():
        found.setdefault(str(chunk.entity_path), set()).update(map(str, chunk.to_record_batch().schema.names))
    return found


def curve(path: Path, entity: str, component: str) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and values of one component of an `.rrd`."""
    from rerun.chunk import RrdReader

    times, values = [], []
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if str(chunk.entity_path) == entity and {"time", component} <= set(batch.schema.names):
            times += batch.column("time").cast("int64").to_pylist()
            values += batch.column(component).to_pylist()
    order = np.argsort(times)
    return np.array(times)[order] * 1e-9, np.squeeze(np.array(values)[order])


def test_rerun_verifies_a_recording_with_cameras(studio: Studio, tmp_path: Path) -> None:
    first = ids_of(studio)[0]
    studio.export([first], tmp_path / "out", "rrd")
    path = tmp_path / "out" / f"{first}.rrd"
    assert "without error" in verified(path)
    shown = entities(path)
    for arm in ("left", "right"):
        for curve in ("force", "torque", "stiffness"):
            assert {"Scalars:scalars", "SeriesLines:names", "time"} <= shown[f"/{arm}/{curve}"]
        assert {"Arrows3D:vectors", "Arrows3D:origins", "time"} <= shown[f"/world/{arm}/force"]
    assert {"EncodedImage:blob", "time"} <= shown["/camera/front"]
    assert not any("/scene/" in path for path in shown)  # the task is made up


def test_rerun_gets_the_robot_with_meshes_forces_and_stiffness(
    recorded: tuple[Path, DemoReport], tmp_path: Path
) -> None:
    data, report = recorded
    with Studio(data) as studio:
        studio.export(report.ids[:1], tmp_path / "out", "rrd")
    path = tmp_path / "out" / f"{report.ids[0]}.rrd"
    assert "without error" in verified(path)
    shown = entities(path)
    for body in ("right_forearm_link", "right_hand_left_driver", "eraser"):
        assert {"Asset3D:blob", "Transform3D:translation", "time"} <= shown[f"/world/scene/{body}"]
    assert "Asset3D:blob" in shown["/world/scene/world"]  # table and board, which never move
    with Studio(data) as studio, studio.open(report.ids[0]) as episode:
        columns = episode.columns("right/state")
    times, force = curve(path, "/right/force", "Scalars:scalars")
    assert np.allclose(times, columns["right/state/time"], atol=1e-9)
    assert np.array_equal(force, columns["right/state/wrench"][:, :3])
    arrow_times, vectors = curve(path, "/world/right/force", "Arrows3D:vectors")
    assert len(arrow_times) == pytest.approx(30 * times[-1], rel=0.1)
    shown_force = force[np.searchsorted(times, arrow_times - 1e-6)]
    assert np.allclose(vectors, shown_force * 0.01, atol=1e-6)  # 1 cm a newton; base axes are the world's
