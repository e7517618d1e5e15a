"""What an export holds: takes as people judged them, on a grid of constant rate."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from controller.types import Array
from studio import edits
from studio.catalog import Catalog
from studio.episode import Episode, Header, open_episode
from studio.interpolation import NANOSECOND
from studio.session import CONTROL_PERIOD

Control = Literal["cartesian", "joints"]


@dataclass(frozen=True, slots=True)
class Take:
    """One take with what a version of its sidecar says about it."""

    path: Path
    header: Header
    edit_version: int
    outcome: edits.Outcome
    trim: tuple[float, float] | None  # [s]
    duration: float  # [s] of the recording

    @property
    def episode_id(self) -> str:
        return self.header.episode_id

    @property
    def span(self) -> tuple[float, float]:
        """[s] since the take's start."""
        first, last = self.trim or (0.0, self.duration)
        return first, min(last, self.duration)

    def to_json(self) -> dict[str, Any]:
        """What an export tells of where it comes from."""
        return {
            "episode_id": self.episode_id,
            "edit_version": self.edit_version,
            "outcome": self.outcome,
            "trim": self.trim,
            "header": json.loads(self.header.to_json()),
        }


def choose(
    catalog: Catalog, episode_ids: Sequence[str], versions: Mapping[str, int] | None = None
) -> list[Take]:
    """Takes by id as they are annotated now, or as a version of their edits told them."""
    twice = sorted(name for name, count in Counter(episode_ids).items() if count > 1)
    if twice:
        raise ValueError(f"{', '.join(twice)} would be exported twice.")
    if not episode_ids:
        raise ValueError("No take is chosen; name some, or give a filter that matches any.")
    return [_take(catalog.get(name).path, (versions or {}).get(name)) for name in episode_ids]


def _take(path: Path, version: int | None) -> Take:
    said = edits.read(edits.edits_path(path), version)
    with open_episode(path) as episode:
        success = episode.outcome.success
        recorded: edits.Outcome = "unmarked" if success is None else "success" if success else "failure"
        outcome = said.outcome or recorded
        return Take(path, episode.header, said.version, outcome, said.trim, episode.duration)


def check_alike(takes: Sequence[Take], cameras: Sequence[str] | None) -> None:
    """Raise ValueError, telling what differs, where takes cannot be in one dataset."""
    for what in ("task", "arms", "cameras"):
        found: dict[str, list[str]] = {}
        for take in takes:
            found.setdefault(_told(take.header, what, cameras), []).append(take.episode_id)
        if len(found) > 1:
            told = "; ".join(f"{value or 'none'}: {_some(names)}" for value, names in found.items())
            raise ValueError(f"Takes of one dataset must be alike, but their {what} differ: {told}.")
    header = takes[0].header
    missing = sorted(set(cameras or ()) - set(header.cameras))
    if missing:
        raise KeyError(f"No camera {missing[0]!r}; the takes have {list(header.cameras)}.")


def cameras_of(header: Header, chosen: Sequence[str] | None) -> list[str]:
    """The cameras of a take that are asked for; None asks for all."""
    return [name for name in header.cameras if chosen is None or name in chosen]


def _told(header: Header, what: str, cameras: Sequence[str] | None) -> str:
    if what == "cameras":
        sizes = {name: "x".join(map(str, header.cameras[name])) for name in cameras_of(header, cameras)}
        return ", ".join(f"{name} {size}" for name, size in sizes.items())
    return header.task if what == "task" else ", ".join(header.arms)


def _some(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{len(names)} takes, like {names[0]}"


class Grid:
    """An open take at constant rate. Each row is what the robot knew then: the newest at or before."""

    def __init__(self, take: Take, episode: Episode, rate: float, control: Control) -> None:
        """Raise ValueError where a row would have no action of the kind asked for."""
        self.take, self.episode = take, episode
        arms = take.header.arms
        self._columns = episode.columns(*(f"{arm}/{group}" for arm in arms for group in ("state", "applied")))
        known = self._columns[f"{arms[0]}/state/time"]
        issued = self._columns[f"{arms[0]}/applied/time"]
        if not len(known) or not len(issued):
            raise ValueError(f"{take.episode_id} holds no states: it was cut off as it began.")
        first, last = (known[0] + moment for moment in take.span)
        n = int((min(last, issued[-1]) - first) * rate + 1e-6) + 1
        if n < 2:
            raise ValueError(f"{take.episode_id} has fewer than two rows at {rate:g} Hz within its trim.")
        self.times = first + np.arange(n) / rate  # (n,) [s] since reset
        self._state = self._newest(known, self.times)
        self._after = self._newest(known, self.times + CONTROL_PERIOD)
        self._action = self._newest(issued, self.times)
        self._check(control)

    def __len__(self) -> int:
        return len(self.times)

    def state(self, arm: str, name: str) -> Array:
        """(n, ...) of `{arm}/state`."""
        return np.asarray(self._columns[f"{arm}/state/{name}"][self._state])

    def action(self, arm: str, name: str) -> Array:
        """(n, ...) of `{arm}/applied`."""
        return np.asarray(self._columns[f"{arm}/applied/{name}"][self._action])

    def commanded(self, arm: str) -> Array:
        """(n, 6) [rad] the joints asked for; where none were, those that the period then commanded."""
        asked, command = self.action(arm, "q"), self._columns[f"{arm}/state/q_command"][self._after]
        return np.where(np.isfinite(asked), asked, command)

    def image_numbers(self, camera: str) -> Array:
        """(n,) which image of a camera shows each moment."""
        shown = self.episode.image_times(camera)
        if not len(shown):
            raise ValueError(f"{self.take.episode_id} has no image of camera {camera!r}.")
        return self._newest(shown, self.times)

    def _newest(self, known: Array, times: Array) -> Array:
        return np.maximum(np.searchsorted(known, times + 10 * NANOSECOND, side="right") - 1, 0)

    def _check(self, control: Control) -> None:
        for arm in self.take.header.arms:
            if control == "joints":
                missing = ~np.isfinite(self.commanded(arm)).all(1)
                why = "commands no joints"
            else:
                missing = ~np.isfinite(self.action(arm, "base_from_target")).all(1)
                why = "follows no Cartesian target"
            if missing.any():
                other = "cartesian" if control == "joints" else "joints"
                raise ValueError(
                    f"The {arm} arm of {self.take.episode_id} {why} for {missing.mean():.0%} of its time, "
                    f"first at {self.times[missing.argmax()]:.2f} s; leave the take out, or export actions "
                    f"as {other}."
                )


@contextmanager
def opened(take: Take, rate: float, control: Control) -> Iterator[Grid]:
    """A take, open for reading at constant rate."""
    if not 0 < rate <= 1 / CONTROL_PERIOD:
        raise ValueError(f"A rate between 0 and {1 / CONTROL_PERIOD:g} Hz is possible, not {rate:g}.")
    with open_episode(take.path) as episode:
        yield Grid(take, episode, rate, control)
