"""LeRobot datasets, read back with pyarrow and PyAV, and with Rerun's own reader."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from exported import record

from controller.types import Array, Stiffness, rotation_of
from studio.api import Studio
from studio.export import Options, lerobot, statistics
from studio.export.video import VideoWriter

ARMS = ("left", "right")


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, list[str]]:
    """A data folder with two takes, of which the second is trimmed and failed, and its export at 20 Hz."""
    folder = tmp_path_factory.mktemp("lerobot")
    first, second = (record(folder / "data", s, arms=ARMS, instruction=f"do {s}") for s in (1.0, 0.8))
    with Studio(folder / "data") as studio:
        studio.annotate(second, author="ann", trim=(0.15, 0.6), outcome="failure")
        studio.export([first, second], folder / "out", "lerobot")
    return folder / "data", folder / "out", [first, second]


def table(out: Path, path: str = lerobot.DATA_PATH.format(chunk_index=0, file_index=0)) -> dict[str, Any]:
    return {name: np.array(values) for name, values in pq.read_table(out / path).to_pydict().items()}


def info(out: Path) -> dict[str, Any]:
    return dict(json.loads((out / "meta" / "info.json").read_text()))


def pictures(out: Path, camera: str) -> list[Array]:
    path = out / f"videos/observation.images.{camera}/chunk-000/file-000.mp4"
    with av.open(str(path)) as container:
        assert container.streams.video[0].codec_context.name == "h264"
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def psnr(a: Array, b: Array) -> float:
    """[dB]"""
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2)))


def test_rows_equal_the_takes_to_float32(exported: tuple[Path, Path, list[str]]) -> None:
    data, out, ids = exported
    rows, names = table(out), info(out)["features"]
    assert names["action"]["names"][:3] == ["left.x", "left.y", "left.z"]
    assert names["action"]["names"][10] == "left.translational_cholesky_xx"
    assert names["observation.state"]["shape"] == [32]
    begin = 0
    with Studio(data) as studio:
        for take, (skipped, length) in zip(ids, ((0, 20), (3, 10)), strict=True):
            of_take = slice(begin, begin + length)
            begin += length
            with studio.open(take) as episode:
                columns = episode.columns()

            at = {}
            for name, column in columns.items():
                every = 25 if "/state/" in name else 5  # 20 of 500 and of 100 Hz
                at[name] = column[every * skipped :: every][:length]
                if column.dtype == float:
                    at[name] = at[name].astype(np.float32)
            for name, column in (
                ("observation.velocity", "dq"),
                ("observation.joint_command", "q_command"),
                ("observation.wrench", "wrench"),
            ):
                told = np.concatenate(
                    [at[f"{arm}/state/{column}"].astype(np.float32) for arm in ARMS], axis=1
                )
                assert np.array_equal(rows[name][of_take], told)
            for number, arm in enumerate(ARMS):
                seen = rows["observation.state"][of_take, 16 * number : 16 * number + 16]
                assert np.array_equal(seen[:, :6], at[f"{arm}/state/q"].astype(np.float32))
                assert np.array_equal(seen[:, 6:9], at[f"{arm}/state/base_from_tcp"][:, :3])
                turns = [
                    rotation_of(pose[3:])
                    for pose in columns[f"{arm}/state/base_from_tcp"][25 * skipped :: 25]
                ]
                two_columns = np.array([turn[:, :2].T.ravel() for turn in turns[:length]])
                assert np.abs(seen[:, 9:15] - two_columns).max() < 1e-6
                assert np.array_equal(seen[:, 15], at[f"{arm}/state/gripper"])
                done = rows["action"][of_take, 22 * number : 22 * number + 22].astype(float)
                assert np.array_equal(
                    done[:, :3], at[f"{arm}/applied/base_from_target"][:, :3].astype(np.float32)
                )
                for upper, told in zip(done[:, 10:], at[f"{arm}/applied/stiffness"], strict=True):
                    blocks = np.zeros((2, 3, 3))
                    blocks[:, *np.triu_indices(3)] = upper.reshape(2, 6)
                    stiffness = Stiffness.from_vector(told)
                    both = np.stack((stiffness.translational, stiffness.rotational))
                    assert np.allclose(np.swapaxes(blocks, 1, 2) @ blocks, both, rtol=1e-6, atol=1e-3)
    assert begin == len(rows["index"])


def test_rows_are_numbered_and_timed(exported: tuple[Path, Path, list[str]]) -> None:
    _, out, _ = exported
    rows = table(out)
    assert rows["index"].tolist() == list(range(30))
    assert rows["episode_index"].tolist() == [0] * 20 + [1] * 10
    assert rows["frame_index"].tolist() == [*range(20), *range(10)]
    assert np.allclose(rows["timestamp"], rows["frame_index"] / 20, atol=1e-6)
    assert np.flatnonzero(rows["next.success"]).tolist() == [19]  # the second take failed
    tasks = table(out, "meta/tasks.parquet")
    assert tasks["__index_level_0__"][rows["task_index"][[0, 20]]].tolist() == ["do 1.0", "do 0.8"]
    facts = info(out)
    assert (facts["codebase_version"], facts["fps"], facts["total_frames"]) == ("v3.0", 20, 30)
    assert (facts["total_episodes"], facts["splits"]) == (2, {"train": "0:2"})


def test_pictures_equal_the_takes_to_the_frame(exported: tuple[Path, Path, list[str]]) -> None:
    data, out, ids = exported
    episodes = table(out, lerobot.EPISODES_PATH)
    for camera in ("front", "wrist"):
        shown = pictures(out, camera)
        assert len(shown) == 30
        with Studio(data) as studio:
            for number, (take, skipped) in enumerate(zip(ids, (0, 3), strict=True)):
                begin = round(episodes[f"videos/observation.images.{camera}/from_timestamp"][number] * 20)
                end = round(episodes[f"videos/observation.images.{camera}/to_timestamp"][number] * 20)
                with studio.open(take) as episode:
                    for index, picture in enumerate(shown[begin:end]):
                        right, wrong = (episode.image(camera, (skipped + index + d) % 8) for d in (0, 1))
                        assert psnr(picture, right) > max(32.0, psnr(picture, wrong) + 5.0)  # [dB]


def test_statistics_are_those_of_the_rows(exported: tuple[Path, Path, list[str]]) -> None:
    data, out, ids = exported
    rows, episodes = table(out), pq.read_table(out / lerobot.EPISODES_PATH).to_pydict()
    stats = json.loads((out / "meta" / "stats.json").read_text())
    for name in ("observation.state", "observation.wrench", "action"):
        values = rows[name].astype(float)
        told = {key: np.array(value) for key, value in stats[name].items()}
        assert np.allclose(told["min"], values.min(0))
        assert np.allclose(told["max"], values.max(0))
        assert np.allclose(told["mean"], values.mean(0))
        assert np.allclose(told["std"], values.std(0), atol=1e-9)
        assert told["count"].tolist() == [30]
        assert np.allclose(episodes[f"stats/{name}/q90"][1], np.quantile(values[20:], 0.9, axis=0))
    with Studio(data) as studio, studio.open(ids[0]) as episode:
        images = np.array([episode.image("front", row)[::4, ::4] for row in range(20)]) / 255
    assert np.allclose(np.squeeze(episodes["stats/observation.images.front/mean"][0]), images.mean((0, 1, 2)))
    assert np.shape(stats["observation.images.front"]["std"]) == (3, 1, 1)


def test_rerun_reads_the_dataset(exported: tuple[Path, Path, list[str]]) -> None:
    from rerun.experimental import LeRobotReader

    _, out, _ = exported
    reader = LeRobotReader(out)
    assert list(reader.episodes()) == [0, 1]
    rows: dict[str, int] = {}
    for chunk in reader.stream(1):
        if not chunk.is_static:
            entity = str(chunk.entity_path)
            rows[entity] = rows.get(entity, 0) + chunk.to_record_batch().num_rows
    for feature in ("observation.state", "observation.wrench", "action"):
        assert rows[f"/{feature}"] == 10
    assert rows["/observation.images.front"] >= 10


@pytest.mark.parametrize(("rate", "rows", "shown"), [(10, 10, range(0, 20, 2)), (50, 49, None)])
def test_any_rate_takes_the_newest_of_everything(
    tmp_path: Path, rate: int, rows: int, shown: range | None
) -> None:
    take = record(tmp_path, 1.0, cameras=("front",))
    with Studio(tmp_path) as studio:
        studio.export([take], tmp_path / "out", "lerobot", Options(rate=rate))
        told = table(tmp_path / "out")
        with studio.open(take) as episode:
            columns = episode.columns()
            times, known = np.arange(len(told["index"])) / rate, episode.image_times("front")
            state = np.searchsorted(columns["right/state/time"], times + 1e-6) - 1
            assert np.array_equal(
                told["observation.wrench"], columns["right/state/wrench"][state].astype(np.float32)
            )
            images = np.searchsorted(known, times + 1e-6) - 1
            for picture, index in zip(pictures(tmp_path / "out", "front"), images, strict=True):
                assert psnr(picture, episode.image("front", int(index))) > 30


def test_files_roll_over_when_they_are_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    takes = [record(tmp_path, 0.3, cameras=("front",)) for _ in range(3)]
    monkeypatch.setattr(lerobot, "DATA_MB", 0.001)
    monkeypatch.setattr(lerobot, "VIDEO_MB", 0.001)
    with Studio(tmp_path) as studio:
        studio.export(takes, tmp_path / "out", "lerobot")
    episodes = table(tmp_path / "out", lerobot.EPISODES_PATH)
    assert episodes["data/file_index"].tolist() == [0, 1, 2]
    assert episodes["videos/observation.images.front/file_index"].tolist() == [0, 1, 2]
    assert episodes["videos/observation.images.front/from_timestamp"].tolist() == [0, 0, 0]
    for number in range(3):
        rows = table(tmp_path / "out", lerobot.DATA_PATH.format(chunk_index=0, file_index=number))
        assert set(rows["episode_index"].tolist()) == {number}


def test_a_dead_sensor_spoils_no_statistics() -> None:
    values = np.array([[1.0, np.nan], [3.0, np.nan], [np.inf, np.nan]])
    found = statistics.of_numbers(values)
    assert found["mean"].tolist() == [2.0, 0.0]
    assert found["max"].tolist() == [3.0, 0.0]
    json.dumps({name: value.tolist() for name, value in found.items()}, allow_nan=False)


def test_what_lerobot_cannot_hold_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="even width and height, not 321 x 240"):
        VideoWriter(tmp_path / "odd.mp4", 20, 321, 240)
    take = record(tmp_path, 0.3)
    with Studio(tmp_path) as studio, pytest.raises(ValueError, match="whole number of rows"):
        studio.export([take], tmp_path / "out", "lerobot", Options(rate=12.5))
