"""The health of many takes together: duplicates, and how evenly they cover what a policy has to learn."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from controller.types import Array
from studio import health
from studio.edits import OUTCOMES
from studio.episode import EpisodeError, open_episode
from studio.health import Finding, Grade, TakeHealth, grade_of
from studio.index import EpisodeRow

FEW = 10  # takes of a task that say nothing about balance yet
SHARES_TASK = 5.0  # of the most recorded task to the least recorded one
DOMINATES = 0.8  # share of one operator where there are several
UNJUDGED = 0.2  # share of takes that nobody judged
ALIKE = 0.005  # [m] all starts within this box are one
SPREAD = 0.01  # [m] of a coordinate before it is asked whether it is covered evenly
RARE = 0.1  # share of the takes in the emptiest third of a range
MANY_POOR, MANY_FAIR = 0.1, 0.25  # share of takes that are poor, or not good


_Kept = tuple[list[int], TakeHealth]  # stamp of the recording, and what was found


@dataclass(frozen=True, slots=True)
class Spread:
    """Where something was at the start of the takes of a task."""

    low: tuple[float, float, float]  # [m]
    high: tuple[float, float, float]
    thirds: tuple[tuple[int, int, int], ...]  # takes in each third of the range, of x, y and z


@dataclass(frozen=True, slots=True)
class DatasetHealth:
    """A selection of takes: each of them, and all together."""

    grade: Grade
    reasons: tuple[str, ...]  # for the grade
    grades: dict[Grade, int]  # takes of each
    balance: dict[str, dict[str, int]]  # takes of each task, operator, agent and outcome
    starts: dict[str, dict[str, Spread]]  # by task, and by tool or object
    findings: tuple[Finding, ...]  # about all of them
    takes: tuple[TakeHealth, ...]  # as trimmed


def examined(data_dir: Path, row: EpisodeRow) -> TakeHealth | None:
    """The health of one recording, where it was examined before: DATA/cache/health keeps it."""
    try:
        stamp, told = msgspec.json.decode(_place(data_dir, row).read_bytes(), type=_Kept)
    except (OSError, msgspec.DecodeError):
        return None
    return told if stamp == _stamp(row.path) else None


def examine(data_dir: Path, row: EpisodeRow) -> TakeHealth:
    """The health of one recording; one that nobody examined yet is read whole."""
    if (known := examined(data_dir, row)) is not None:
        return known
    stamp, place = _stamp(row.path), _place(data_dir, row)
    try:
        with open_episode(row.path) as episode:
            told = health.check(episode)
    except (EpisodeError, ValueError) as error:
        fault = Finding("unreadable", "fault", f"It cannot be read: {error}")
        return TakeHealth(row.episode_id, row.duration, {}, 0.0, (fault,), "", {})
    place.parent.mkdir(parents=True, exist_ok=True)
    part = place.with_suffix(".part")
    part.write_bytes(msgspec.json.encode((stamp, told)))
    part.rename(place)
    return told


def examine_some(data_dir: Path, rows: Sequence[EpisodeRow], patience: float) -> list[TakeHealth]:
    """As many takes of a list, from its beginning, as can be read anew in `patience` [s]; at least one."""
    found: list[TakeHealth] = []
    for row in rows:
        known = examined(data_dir, row)
        if known is None:
            if patience <= 0:
                break
            begin = time.monotonic()
            known = examine(data_dir, row)
            patience -= time.monotonic() - begin
        found.append(known)
    return found


def _place(data_dir: Path, row: EpisodeRow) -> Path:
    return data_dir / "cache" / "health" / f"{row.episode_id}.json"


def _stamp(path: Path) -> list[int]:
    status = path.stat()
    return [health.VERSION, status.st_mtime_ns, status.st_size]


def survey(takes: Sequence[tuple[EpisodeRow, TakeHealth]]) -> DatasetHealth:
    """Each take as it is trimmed and seen beside the others, and all of them together."""
    rows = [row for row, _ in takes]
    found = [
        told.within(row.trim).and_also(*twins)
        for (row, told), twins in zip(takes, _twins(takes), strict=True)
    ]
    balance = {
        name: dict(Counter(str(getattr(row, name)) for row in rows).most_common())
        for name in ("task", "operator", "agent", "outcome")
    }
    by_task = defaultdict(list)
    for row, told in takes:
        if told.start:
            by_task[row.task].append(told.start)
    starts = {task: _spreads(places) for task, places in by_task.items()}
    findings = [*_uneven(balance), *_narrow(starts, by_task)]
    grades: dict[Grade, int] = {"good": 0, "fair": 0, "poor": 0}
    for told in found:
        grades[told.grade] += 1
    reasons = [*_shares(grades, len(found)), *(f for f in findings if f.severity != "note")]
    return DatasetHealth(
        grade=grade_of(reasons),
        reasons=tuple(reason.text for reason in reasons),
        grades=grades,
        balance=balance,
        starts=starts,
        findings=tuple(findings),
        takes=tuple(found),
    )


def _shares(grades: dict[Grade, int], n: int) -> Iterator[Finding]:
    if grades["poor"] > MANY_POOR * n:
        yield Finding("balance", "fault", f"{grades['poor']} of {n} takes are poor.")
    elif n - grades["good"] > MANY_FAIR * n:
        yield Finding("balance", "warning", f"{n - grades['good']} of {n} takes are fair or poor.")


def _twins(takes: Sequence[tuple[EpisodeRow, TakeHealth]]) -> list[list[Finding]]:
    """For each take, which others have the very same motion."""
    same = defaultdict(list)
    for row, told in takes:
        if told.fingerprint:
            same[told.fingerprint].append(row.episode_id)
    findings = []
    for row, told in takes:
        others = [other for other in same.get(told.fingerprint, ()) if other != row.episode_id]
        text = f"The very motion of {', '.join(others[:3])}{' and others' if len(others) > 3 else ''}."
        findings.append([Finding("duplicate", "warning", text)] if others else [])
    return findings


def _uneven(balance: dict[str, dict[str, int]]) -> Iterator[Finding]:
    """Between tasks, operators and outcomes."""
    n = sum(balance["task"].values())
    if n < FEW:
        return
    (most, often), *_, (least, rarely) = [*balance["task"].items()] * 2
    if often > SHARES_TASK * rarely:
        yield Finding("balance", "note", f"{often} takes of {most}, only {rarely} of {least}.", "task")
    operator, count = next(iter(balance["operator"].items()))
    if len(balance["operator"]) > 1 and count > DOMINATES * n:
        yield Finding("balance", "note", f"{operator} recorded {count} of {n} takes.", "operator")
    success, failure, unmarked = (balance["outcome"].get(outcome, 0) for outcome in OUTCOMES)
    if unmarked > UNJUDGED * n:
        yield Finding("balance", "note", f"Nobody judged {unmarked} of {n} takes.", "outcome")
    if failure > success:
        text = f"{failure} failures, only {success} successes."
        yield Finding("balance", "warning", text, "outcome")


def _spreads(places: Sequence[dict[str, tuple[float, float, float]]]) -> dict[str, Spread]:
    """Of each tool and object that every take of a task has."""
    names = [name for name in places[0] if all(name in other for other in places)]
    return {name: _spread(np.array([other[name] for other in places])) for name in names}


def _spread(points: Array) -> Spread:
    """Of (n, 3) [m]."""
    low, high = points.min(axis=0), points.max(axis=0)
    third = ((points - low) / np.maximum(high - low, 1e-12) * 3).astype(int).clip(0, 2)
    counts = (np.bincount(column, minlength=3).tolist() for column in third.T)
    return Spread(tuple(low.tolist()), tuple(high.tolist()), tuple(tuple(count) for count in counts))


def _narrow(starts: dict[str, dict[str, Spread]], takes: Mapping[str, Sequence[object]]) -> Iterator[Finding]:
    """Where the takes of a task begin too much alike, or leave out a part of the range."""
    for task, spreads in starts.items():
        n = len(takes[task])
        if n < FEW or not spreads:
            continue
        ranges = {name: np.subtract(spread.high, spread.low) for name, spread in spreads.items()}
        if max(float(range_.max()) for range_ in ranges.values()) < ALIKE:
            text = f"All {n} takes of {task} begin alike: a policy would learn one way only."
            yield Finding("balance", "warning", text, "start")
        for name, spread in spreads.items():
            for axis, range_, counts in zip("xyz", ranges[name], spread.thirds, strict=True):
                if range_ > SPREAD and min(counts) < RARE * n:
                    which = ("lower", "middle", "upper")[counts.index(min(counts))]
                    text = (
                        f"{task}: {name} starts in the {which} third of its range in {axis} "
                        f"({range_ * 100:.0f} cm) in only {min(counts)} of {n} takes."
                    )
                    yield Finding("balance", "note", text, "start")
