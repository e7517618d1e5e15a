"""What a linear fit tells: as much as there is, nothing from noise; and what each task hides from the eye."""

from __future__ import annotations

import numpy as np
import pytest

from studio import probes, tasks
from studio.probes import HIDDEN, collect, probe, ridge_r2


def test_ridge_finds_what_is_there_and_nothing_else() -> None:
    rng = np.random.default_rng(3)
    target = rng.normal(size=200)
    noise = rng.normal(size=(200, 500))
    half = 3.0 * target[:, None] + 3.0 * rng.normal(size=(200, 1))  # R² at most .5
    shown = noise.copy()
    shown[:, :100] += target[:, None]
    assert ridge_r2(shown, target) > 0.8
    assert 0.3 < ridge_r2(half, target) < 0.6
    assert ridge_r2(noise, target) < 0.1  # a fit without a penalty tells 1 where it was fitted, and < 0 here
    assert ridge_r2(np.zeros((200, 4)), target) < 0.01


def test_ridge_is_the_primal_solution() -> None:
    rng = np.random.default_rng(4)
    x, z = rng.normal(size=(60, 5)), rng.normal(size=(7, 5))
    weights = rng.normal(size=5)
    y = x @ weights + 0.5
    np.testing.assert_allclose(probes._ridge(x, y, z, 1e-9), z @ weights + 0.5, atol=1e-2)


def test_only_tasks_that_hide_something_are_probed() -> None:
    assert set(HIDDEN) <= set(tasks.names())
    with pytest.raises(KeyError, match="peg-cylinder"):
        probe("wiping", range(20))


def test_offsets_are_those_of_the_grasp_before_any_contact() -> None:
    samples = collect("peg-cylinder", range(2))
    assert samples.parts == ("hole", "peg")
    assert samples.offsets.shape == (2, 2)
    assert np.abs(samples.offsets).max() < 0.0075  # 6 mm, and a little of slip and tilt
    assert samples.forces.shape == (2, probes.FELT, 2, 6)
    first = np.linalg.norm(samples.forces[:, 0, :, :3], axis=-1).max(axis=1)
    assert (first > 0.3).all()
    assert {image.shape for image in samples.images.values()} == {(2, 60, 80, 3)}
    assert samples.untouched == ()


@pytest.mark.verify
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("task", sorted(HIDDEN))
def test_how_a_part_lies_is_felt_and_not_seen(task: str) -> None:
    for told in probe(task, range(200)):
        assert told.from_forces >= 0.5, told
        assert max(told.from_images, *told.from_each_camera.values()) <= 0.2, told
