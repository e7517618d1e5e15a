"""The statistics that a LeRobot dataset keeps of each feature, of one take and of all together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from controller.types import Array

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
PICTURES = 100  # at most, of a take and a camera
EVERY = 4  # pixels, in both directions

Statistics = Mapping[str, Array]


def of_numbers(values: Array) -> Statistics:
    """Of (n, ...), over the first axis; NaN of a dead sensor does not count."""
    values = np.asarray(values, float)
    values = np.where(np.isfinite(values), values, np.nan)
    values = np.where(np.isnan(values).all(0), 0.0, values)  # JSON has no NaN
    found = {
        "min": np.nanmin(values, axis=0),
        "max": np.nanmax(values, axis=0),
        "mean": np.nanmean(values, axis=0),
        "std": np.nanstd(values, axis=0),
        "count": np.array([len(values)]),
    }
    return found | {name: np.nanquantile(values, share, axis=0) for name, share in QUANTILES.items()}


def of_pictures(pictures: Sequence[Array]) -> Statistics:
    """Of some (h, w, 3) uint8 RGB: (3, 1, 1) of each channel, black 0 and white 1."""
    pixels = np.concatenate([picture[::EVERY, ::EVERY].reshape(-1, 3) for picture in pictures])
    found = of_numbers(pixels / 255.0)
    shaped = {name: value.reshape(3, 1, 1) for name, value in found.items() if name != "count"}
    return shaped | {"count": np.array([len(pictures)])}


def together(parts: Sequence[Statistics]) -> Statistics:
    """Of several takes. Quantiles are means of theirs, weighted by their lengths, as LeRobot has it."""
    counts = np.array([part["count"][0] for part in parts], float)

    def mean_of(values: Array) -> Array:
        return np.asarray(np.tensordot(counts / counts.sum(), values, axes=1))

    of = {name: np.stack([part[name] for part in parts]) for name in parts[0]}
    mean = mean_of(of["mean"])
    return {
        "min": of["min"].min(0),
        "max": of["max"].max(0),
        "mean": mean,
        "std": np.sqrt(mean_of(of["std"] ** 2 + (of["mean"] - mean) ** 2)),
        "count": np.array([int(counts.sum())]),
        **{name: mean_of(of[name]) for name in QUANTILES},
    }
