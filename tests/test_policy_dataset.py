"""The training cache: samples tell what was true at the moment their images show."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from synthetic import Synthetic, dataset_of

from policy.batches import Batches
from policy.config import TrainConfig
from policy.dataset import Dataset, fit
from policy.features import Encoding
from policy.rotations import matrices

TINY = TrainConfig(width=16, feedforward=32, heads=2, chunk_seconds=0.5, batch=4, brightness=0.0)


def everything(dataset: Dataset) -> np.ndarray:
    return np.arange(len(dataset))


def test_a_sample_is_the_state_that_its_images_show(tmp_path: Path) -> None:
    take = Synthetic("a", goal=0.5, start=3.0)
    dataset = dataset_of(tmp_path / "cache", take)
    track, shown = take.track("right"), take.image_times("front")
    assert len(dataset) == len(shown) == 20
    rows = np.searchsorted(track.state_time, shown - 1e-9)
    seen = dataset.seen(everything(dataset))
    np.testing.assert_array_equal(seen.base_from_tcp[:, 0], track.base_from_tcp[rows])
    np.testing.assert_array_equal(seen.q[:, 0], track.q[rows])
    assert [picture[0, -1, 0, 0] // 5 for picture in dataset.images(everything(dataset))] == sorted(range(20))


def test_the_images_of_a_sample_show_the_same_moment(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "cache", Synthetic("a", late=0.02))
    assert len(dataset) == 20
    with pytest.raises(ValueError, match=r"a has [01] moments to learn from"):
        dataset_of(tmp_path / "other", Synthetic("a", late=0.985))


def test_a_chunk_begins_at_its_sample_and_repeats_the_last_target(tmp_path: Path) -> None:
    takes = [Synthetic("a", goal=0.5), Synthetic("b", goal=-1.0, start=2.0)]
    dataset = dataset_of(tmp_path / "cache", *takes)
    targets, valid = dataset.targets(everything(dataset), 10, 20.0)
    for number, take in enumerate(takes):
        track = take.track("right")
        for sample in range(20):
            index = number * 20 + sample
            rows = sample * 5 + np.arange(10) * 5
            within = rows < len(track.action_time)
            np.testing.assert_array_equal(valid[index], within)
            wanted = track.base_from_target[np.minimum(rows, len(track.action_time) - 1)]
            np.testing.assert_allclose(targets.base_from_target[index, :, 0], wanted, atol=1e-12)


def test_a_rate_between_the_ticks_blends_targets(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "cache", Synthetic("a", goal=1.0))
    targets, _ = dataset.targets(np.array([0]), 4, 40.0)  # every 2.5 ticks
    y = targets.base_from_target[0, :, 0, 1]
    np.testing.assert_allclose(y, 0.2 * np.arange(4) * 0.025, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(targets.base_from_target[..., 3:], axis=-1), 1.0)


def test_joint_targets_are_what_the_period_commanded(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "cache", Synthetic("a"))
    targets, _ = dataset.targets(np.array([3]), 1, 20.0)
    # At 0.15 s begins the period at whose end, 0.16 s, the last command is that for 0.162 s.
    np.testing.assert_allclose(targets.q[0, 0, 0], 0.162 * np.arange(1, 7), atol=1e-12)


def test_forces_reach_back_and_not_into_another_take(tmp_path: Path) -> None:
    takes = [Synthetic("a"), Synthetic("b", start=5.0)]
    dataset = dataset_of(tmp_path / "cache", *takes)
    wrench = dataset.wrench(np.array([20, 25]), 16)[:, :, 0, 0]
    np.testing.assert_allclose(wrench[0], np.sin(5.0))
    np.testing.assert_allclose(wrench[1], np.sin(5.25 - 0.01 * np.arange(15, -1, -1)), atol=1e-9)


def test_a_trimmed_take_ends_where_it_was_cut(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "cache", Synthetic("a", goal=1.0, cut=(0.2, 0.6)))
    assert len(dataset) == 9  # 0.20, 0.25 … 0.60 s
    targets, valid = dataset.targets(np.array([8]), 5, 20.0)
    assert valid[0].tolist() == [True, False, False, False, False]
    np.testing.assert_allclose(targets.base_from_target[0, :, 0, 1], 0.2 * 0.6, atol=1e-9)
    assert dataset.describe(np.array([0])) == "a at 0.20 s"


def test_takes_are_split_whole(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "cache", *(Synthetic(str(n)) for n in range(5)))
    training, aside = dataset.split(0.2, seed=1)
    assert len(aside) == 20
    assert len({index // 20 for index in aside}) == 1
    assert sorted([*training, *aside]) == list(range(100))
    assert np.array_equal(dataset.split(0.2, seed=1)[1], aside)
    everything_, nothing = dataset.split(0.0, seed=1)
    assert (len(everything_), len(nothing)) == (100, 0)


def test_the_scales_come_from_the_training_takes_alone(tmp_path: Path) -> None:
    takes = [Synthetic(str(n), goal=n / 10) for n in range(5)]
    dataset = dataset_of(tmp_path / "cache", *takes)
    training, aside = dataset.split(0.2, seed=1)
    odd = dataset.takes[int(aside[0]) // 20].name
    others = [take for take in takes if take.name != odd]
    alone = dataset_of(tmp_path / "alone", *others)
    together = fit(dataset, TINY, training).to_json()
    assert together == fit(alone, TINY, everything(alone)).to_json()


def test_without_cameras_moments_are_sampled_at_20_hz(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "cache", Synthetic("a", cameras={}), max_size=None)
    assert len(dataset) == 20
    assert dataset.images(np.array([0, 1])).shape[:2] == (2, 0)


@pytest.mark.parametrize(
    ("other", "why"),
    [
        ({"task": "drawing"}, "b has task drawing, but a wiping"),
        ({"arms": ("left", "right")}, r"b has arms \['left', 'right'\], but a \['right'\]"),
        ({"cameras": {"front": (48, 64)}}, "b has cameras"),
        ({"cameras": {}}, "b has no images; --no-images"),
        ({"stiffness_table": "literal"}, "b has stiffness table literal, but a tuned"),
        ({"image_rate": 10.0}, "b has front at 10.0 Hz, but a at 20.0"),
        ({"cameras": {"front": (48, 64), "wrist": (24, 64)}}, "differ in size"),
    ],
)
def test_takes_that_are_not_alike_are_refused(tmp_path: Path, other: dict[str, object], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        dataset_of(tmp_path / "cache", Synthetic("a"), Synthetic("b", **other))
    assert not list(tmp_path.iterdir())  # no half cache stays


def test_a_dead_sensor_is_refused_by_name(tmp_path: Path) -> None:
    class Dead(Synthetic):
        def track(self, arm: str):
            track = super().track(arm)
            track.wrench[100] = np.nan
            return track

    with pytest.raises(ValueError, match=r"b, right arm: wrench is not finite at 0\.20 s"):
        dataset_of(tmp_path / "cache", Synthetic("a"), Dead("b"))


def test_a_camera_without_images_is_named(tmp_path: Path) -> None:
    class Dark(Synthetic):
        def image_times(self, camera: str) -> np.ndarray:
            return super().image_times(camera)[: 0 if camera == "wrist" else None]

    with pytest.raises(ValueError, match="b has no image of wrist"):
        dataset_of(tmp_path / "cache", Synthetic("a"), Dark("b"))


def test_takes_driven_by_joints_teach_no_compliance(tmp_path: Path) -> None:
    class Joints(Synthetic):
        def track(self, arm: str):
            track = super().track(arm)
            track.base_from_target[:25] = np.nan
            return track

    dataset = dataset_of(tmp_path / "cache", Joints("a"))
    with pytest.raises(ValueError, match="a follows joint targets for 25% of its time"):
        fit(dataset, TINY, everything(dataset))
    fit(dataset, dataclasses.replace(TINY, policy="act"), everything(dataset))


def test_stiffness_off_the_diagonal_is_refused_but_by_cholesky(tmp_path: Path) -> None:
    full = Synthetic("a", stiffness=(500.0, 50, 0, 500, 0, 500, 35, 0, 0, 35, 0, 35))
    dataset = dataset_of(tmp_path / "cache", full)
    with pytest.raises(ValueError, match="right arm of a has stiffness off the diagonal"):
        fit(dataset, TINY, everything(dataset))
    fit(dataset, dataclasses.replace(TINY, stiffness="cholesky"), everything(dataset))


def test_processes_share_the_batches_of_one(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "cache", *(Synthetic(str(n)) for n in range(3)))
    config = dataclasses.replace(TINY, brightness=0.2, shift=3)
    features = fit(dataset, config, everything(dataset))
    double = Batches(dataset, features, dataclasses.replace(config, batch=8), everything(dataset))
    pair = [Batches(dataset, features, config, everything(dataset), rank, 2) for rank in (0, 1)]
    for step in (0, 7, 23):  # 7 spans the end of the first round
        whole, indices = double.at(step)
        halves = [batches.at(step) for batches in pair]
        assert np.array_equal(indices, np.concatenate([half[1] for half in halves]))
        for name in ("state", "images", "light", "action"):
            first, second = (getattr(half[0], name) for half in halves)
            assert np.array_equal(getattr(whole, name), np.concatenate((first, second)))


def test_every_sample_comes_once_a_round(tmp_path: Path) -> None:
    dataset = dataset_of(tmp_path / "cache", Synthetic("a"))
    features = fit(dataset, TINY, everything(dataset))
    batches = Batches(dataset, features, TINY, everything(dataset))
    drawn = np.concatenate([indices for _, indices in batches.stream(0, 10)])
    assert sorted(drawn[:20]) == sorted(drawn[20:]) == list(range(20))
    assert drawn[:20].tolist() != drawn[20:].tolist()


def test_absolute_axis_angle_of_a_tool_that_points_down_does_not_jump(tmp_path: Path) -> None:
    class Trembling(Synthetic):
        def track(self, arm: str):
            track = super().track(arm)
            angle = np.pi + 0.02 * np.sin(40 * track.state_time)
            track.base_from_tcp[:, 3:] = np.stack(
                (np.cos(angle / 2), np.sin(angle / 2), 0 * angle, 0 * angle), axis=1
            )
            return track

    dataset = dataset_of(tmp_path / "cache", Trembling("a"))
    config = dataclasses.replace(TINY, rotation="axis-angle", frame="absolute")
    features = fit(dataset, config, everything(dataset))
    turns = features.encoding.state(dataset.seen(everything(dataset)))[:, 3:6]
    assert np.ptp(turns, axis=0).max() < 0.1
    assert isinstance(features.encoding, Encoding)
    assert matrices(dataset.seen(everything(dataset)).base_from_tcp[..., 3:]).shape == (20, 1, 3, 3)
