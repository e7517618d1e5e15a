"""Takes from elsewhere: what was exported comes back, and what others wrote as far as its columns exist."""

from __future__ import annotations

import json
import shutil
import threading
from pathlib import Path

import cv2
import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
from exported import names, record

from controller.types import Array, rotation_of
from studio import edits
from studio.__main__ import main
from studio.api import Studio
from studio.cursor import Cursor
from studio.episode import Episode
from studio.export import Cancelled, Format, Options
from studio.health import check

ARMS = ("left", "right")


def columns_at(episode: Episode, every: int, n: int) -> dict[str, Array]:
    """State columns and applied actions of the first `n` rows at 100 / `every` Hz."""
    columns = episode.columns(*(f"{arm}/{group}" for arm in ARMS for group in ("state", "applied")))
    return {name: c[:: every * (5 if "/state/" in name else 1)][:n] for name, c in columns.items()}


@pytest.mark.parametrize("form", ["lerobot", "act-hdf5"])
def test_what_was_exported_comes_back(tmp_path: Path, form: Format) -> None:
    take = record(tmp_path / "a", 0.5, arms=ARMS, operator="ann", instruction="push", seed=4)
    longer = record(tmp_path / "a", 0.7, arms=ARMS, success=False)
    with Studio(tmp_path / "a") as studio, Studio(tmp_path / "b") as other:
        studio.export([take, longer], tmp_path / "out", form)
        imported = other.import_takes(tmp_path / "out")
        assert (imported.source, imported.refused) == (form, {})
        first, second = imported.episode_ids
        rows = {row.episode_id: row for row in other.episodes()}
        assert (rows[first].operator, rows[first].instruction, rows[first].seed) == ("ann", "push", 4)
        assert (rows[first].outcome, rows[second].outcome) == ("success", "failure")
        with studio.open(take) as before, other.open(first) as after:
            assert after.header.provenance["imported_from"]["take"] == take
            assert after.header.robot == before.header.robot
            assert not {"rate", "gap"} & {finding.kind for finding in check(after).findings}
            known, found = columns_at(before, 5, 10), columns_at(after, 1, 10)
            found |= {name: after.columns()[name] for name in found if "/state/" in name}  # 20 Hz, too
            for name, values in known.items():
                if name.endswith("/kind"):
                    assert (values == found[name]).all()
                elif name.endswith(("base_from_tcp", "base_from_target")):
                    assert np.allclose(values[:, :3], found[name][:, :3], atol=1e-6)
                    for a, b in zip(values, found[name], strict=True):
                        assert np.abs(rotation_of(a[3:]) - rotation_of(b[3:])).max() < 1e-5
                else:
                    assert np.allclose(values, found[name], rtol=1e-6, atol=1e-3, equal_nan=True), name
            for camera in ("front", "wrist"):
                assert np.array_equal(before.image_times(camera), after.image_times(camera))
                difference = np.abs(before.image(camera, 3).astype(int) - after.image(camera, 3))
                assert difference.mean() < 6  # of 255: H.264 or JPEG, of noise
        other.export([first, second], tmp_path / "again", form)
        assert_same_numbers(tmp_path / "out", tmp_path / "again", form)


def assert_same_numbers(before: Path, after: Path, form: Format) -> None:
    if form == "act-hdf5":
        for number in range(2):
            name = f"episode_{number}.hdf5"
            with h5py.File(before / name) as a, h5py.File(after / name) as b:
                for key in ("qpos", "eef_pos", "ft", "q_command"):
                    assert np.allclose(a["observations"][key], b["observations"][key], atol=1e-5)
                assert np.allclose(a["action"], b["action"], atol=1e-4)
        return
    path = "data/chunk-000/file-000.parquet"
    a, b = (pq.read_table(folder / path).to_pydict() for folder in (before, after))
    assert a.keys() == b.keys()
    for key in a:
        assert np.allclose(a[key], b[key], atol=1e-4), key


@pytest.mark.parametrize("form", ["lerobot", "act-hdf5"])
def test_joint_actions_come_back_as_joint_targets(tmp_path: Path, form: Format) -> None:
    take = record(tmp_path / "a", 0.3, cameras=())
    options = Options(control="joints")
    with Studio(tmp_path / "a") as studio, Studio(tmp_path / "b") as other:
        studio.export([take], tmp_path / "out", form, options)
        (again,) = other.import_takes(tmp_path / "out").episode_ids
        with other.open(again) as after, studio.open(take) as before:
            told = after.columns("right/applied")
            assert set(told["right/applied/kind"]) == {"joint"}
            commanded = before.columns("right/state")["right/state/q_command"][5::25]
            assert np.allclose(told["right/applied/q"], commanded[:6], atol=1e-6)


# Datasets of others


def test_plain_act_files_are_read_as_far_as_they_go(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    (tmp_path / "act").mkdir()
    for number in (0, 1, 10):  # in the order of their numbers
        with h5py.File(tmp_path / "act" / f"episode_{number}.hdf5", "w") as file:
            file.attrs["sim"] = True
            file["observations/qpos"] = np.full((6, 14), float(number))
            file["observations/qvel"] = rng.normal(size=(6, 14))
            file["observations/images/top"] = rng.integers(0, 255, (6, 48, 64, 3), np.uint8)
            file["observations/effort"] = rng.normal(size=(6, 14))
            file["action"] = rng.normal(size=(6, 14))
    with Studio(tmp_path / "data") as studio:
        with pytest.raises(ValueError, match="does not tell its rate"):
            studio.import_takes(tmp_path / "act", task="transfer-cube")
        with pytest.raises(ValueError, match="does not tell its task"):
            studio.import_takes(tmp_path / "act", rate=50)
        with pytest.raises(ValueError, match="14 joint positions; ACT has 7 for each arm"):
            studio.import_takes(tmp_path / "act", task="transfer-cube", rate=50, arms=("left",))
        assert studio.episodes() == []
        imported = studio.import_takes(tmp_path / "act", task="transfer-cube", rate=50)
        assert imported.left_out == ("observations/effort",)
        found = []
        for name in imported.episode_ids:
            with studio.open(name) as episode:
                columns = episode.columns()
                found.append(columns["right/state/q"][0, 0])
                assert episode.header.arms == ARMS
                assert episode.header.cameras == {"top": (64, 48)}
                assert np.isnan(columns["left/state/wrench"]).all()
                assert np.isnan(columns["left/state/base_from_tcp"][:, :3]).all()
                assert set(columns["left/applied/kind"]) == {"joint"}
                assert np.allclose(np.diff(columns["left/state/time"]), 0.02)
                assert episode.outcome.success is None
                assert Cursor(episode).at(0.05).arms[0].gripper == found[-1]  # can be looked at
        assert found == [0.0, 1.0, 10.0]


def test_a_file_that_is_no_act_file_says_what_it_has(tmp_path: Path) -> None:
    (tmp_path / "episode_0.hdf5").write_bytes(b"nonsense")
    with Studio(tmp_path / "data") as studio:
        with pytest.raises(ValueError, match="is no HDF5 file"):
            studio.import_takes(tmp_path / "episode_0.hdf5", task="any", rate=50)
        with h5py.File(tmp_path / "other.hdf5", "w") as file:
            file["data/demo_0/actions"] = np.zeros(3)
        with pytest.raises(ValueError, match="no /observations/qpos; it has"):
            studio.import_takes(tmp_path / "other.hdf5", task="any", rate=50)
        with pytest.raises(FileNotFoundError, match="nothing at"):
            studio.import_takes(tmp_path / "gone")
        (tmp_path / "empty").mkdir()
        with pytest.raises(ValueError, match="neither a data folder"):
            studio.import_takes(tmp_path / "empty")


def renamed(out: Path) -> None:
    """Make an export look as if somebody else had written it."""
    (out / "takes.json").unlink()
    told = json.loads((out / "meta" / "info.json").read_text())
    for feature in told["features"].values():
        feature["names"] = None
    (out / "meta" / "info.json").write_text(json.dumps(told))


def test_lerobot_datasets_of_others_need_to_be_told_their_arms(tmp_path: Path) -> None:
    take = record(tmp_path / "a", 0.3, cameras=("front",))
    with Studio(tmp_path / "a") as studio, Studio(tmp_path / "b") as other:
        studio.export([take], tmp_path / "out", "lerobot", Options(control="joints"))
        renamed(tmp_path / "out")
        with pytest.raises(ValueError, match="no dimension of a known name"):
            other.import_takes(tmp_path / "out", task="push")
        with pytest.raises(ValueError, match=r"16 numbers in observation\.state; 1 arms have 6 joints"):
            other.import_takes(tmp_path / "out", task="push", arms=("right",))
        told = json.loads((tmp_path / "out" / "meta" / "info.json").read_text())
        del told["features"]["observation.state"]
        (tmp_path / "out" / "meta" / "info.json").write_text(json.dumps(told))
        imported = other.import_takes(tmp_path / "out", task="push", arms=("right",))
        (again,) = imported.episode_ids
        assert "observation.wrench: 0" in imported.left_out
        with other.open(again) as after:
            assert set(after.columns("right/applied")["right/applied/kind"]) == {"joint"}
            assert np.isnan(after.columns("right/state")["right/state/q"]).all()
            assert len(after.image_times("front")) == 6
            assert after.outcome.success is True  # next.success
        renamed_version(tmp_path / "out", "v2.1")
        with pytest.raises(ValueError, match=r"a LeRobot dataset v2\.1; v3\.0 can be read"):
            other.import_takes(tmp_path / "out", task="push")


def test_lerobot_datasets_may_keep_pictures_in_their_table(tmp_path: Path) -> None:
    take = record(tmp_path / "a", 0.3, cameras=("front",))
    out = tmp_path / "out"
    with Studio(tmp_path / "a") as studio, Studio(tmp_path / "b") as other:
        studio.export([take], out, "lerobot", Options(cameras=()))
        with studio.open(take) as before:
            pixels = [before.image("front", row) for row in range(6)]
        encoded = [cv2.imencode(".png", picture[..., ::-1])[1].tobytes() for picture in pixels]
        path = out / "data" / "chunk-000" / "file-000.parquet"
        cells = [{"bytes": png, "path": None} for png in encoded]
        pq.write_table(pq.read_table(path).append_column("observation.images.front", [cells]), path)
        told = json.loads((out / "meta" / "info.json").read_text())
        told["features"]["observation.images.front"] = {"dtype": "image", "shape": [240, 320, 3]}
        (out / "meta" / "info.json").write_text(json.dumps(told))
        (again,) = other.import_takes(out).episode_ids
        with other.open(again) as after:
            for row, picture in enumerate(pixels):
                assert np.abs(picture.astype(int) - after.image("front", row)).mean() < 6  # of 255: JPEG


def renamed_version(out: Path, version: str) -> None:
    told = json.loads((out / "meta" / "info.json").read_text())
    (out / "meta" / "info.json").write_text(json.dumps(told | {"codebase_version": version}))


def test_an_import_that_breaks_leaves_nothing_behind(tmp_path: Path) -> None:
    takes = [record(tmp_path / "a", 0.3) for _ in range(2)]
    with Studio(tmp_path / "a") as studio, Studio(tmp_path / "b") as other:
        studio.export(takes, tmp_path / "out", "act-hdf5")
        (tmp_path / "out" / "episode_1.hdf5").write_bytes(b"torn")
        with pytest.raises(ValueError, match="is no HDF5 file"):
            other.import_takes(tmp_path / "out")
        (tmp_path / "out" / "episode_1.hdf5").unlink()
        cancel = threading.Event()
        with pytest.raises(Cancelled):
            other.import_takes(tmp_path / "out", on_progress=lambda *_: cancel.set(), cancel=cancel)
        assert other.episodes() == []
    assert not [name for name in names(tmp_path / "b") if name.startswith("episodes")]


# Other data folders


def test_takes_of_another_folder_keep_their_ids_and_edits(tmp_path: Path) -> None:
    first, second = (record(tmp_path / "a", 0.2, cameras=()) for _ in range(2))
    with Studio(tmp_path / "a") as studio:
        studio.annotate(first, author="ann", quality=4, note="fine")
    before = names(tmp_path / "a")
    with Studio(tmp_path / "b") as other:
        imported = other.import_takes(tmp_path / "a")
        assert sorted(imported.episode_ids) == sorted([first, second])
        assert (other.catalog.get(first).quality, other.catalog.get(first).note) == (4, "fine")
        other.annotate(first, author="bob", quality=2)
        again = other.import_takes(tmp_path / "a")
        assert again.episode_ids == ()
        assert "is here already" in again.refused[first]
        other.delete(second)
        assert "in the trash" in other.import_takes(tmp_path / "a").refused[second]
        assert other.catalog.get(first).quality == 2
        with pytest.raises(ValueError, match="this very data folder"):
            other.import_takes(tmp_path / "b")
    assert names(tmp_path / "a") == before  # nothing was written there
    a, b = (folder / "episodes" / "made-up" / f"{first}.mcap" for folder in (tmp_path / "a", tmp_path / "b"))
    assert a.read_bytes() == b.read_bytes()
    assert len(edits.read(edits.edits_path(a)).history) == 1


def test_a_take_that_cannot_be_read_does_not_stop_the_others(tmp_path: Path) -> None:
    good, torn = (record(tmp_path / "a", 0.2, cameras=()) for _ in range(2))
    path = tmp_path / "a" / "episodes" / "made-up" / f"{torn}.mcap"
    path.write_bytes(path.read_bytes()[:-100])
    shutil.copy(path.with_name(f"{good}.mcap"), path.with_name("renamed.mcap"))
    with Studio(tmp_path / "b") as other:
        imported = other.import_takes(tmp_path / "a")
        assert imported.episode_ids == (good,)
        assert "is torn" in imported.refused[torn]
        assert "says that it is episode" in imported.refused["renamed"]


def test_the_command_imports_and_tells_what_it_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    take = record(tmp_path / "a", 0.2, cameras=())
    for status, ids, refused in ((0, [take], []), (1, [], [take])):
        with pytest.raises(SystemExit) as ended:
            main(["import", str(tmp_path / "a"), "--data", str(tmp_path / "b"), "--json"])
        told = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert (ended.value.code, told["episode_ids"], list(told["refused"])) == (status, ids, refused)
        assert told["source"] == "studio"
