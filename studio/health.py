"""How sound a take is: what is wrong in its recording, how badly and when, and a grade with its reasons.

Nothing is ever left out because of a finding. Whoever trains or exports sees the grade, and decides.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from controller.servo import ServoConfig
from controller.types import Array
from studio import tasks
from studio.episode import Episode, Header
from studio.session import CONTROL_PERIOD, IMAGE_EVERY, LATE

VERSION = 2  # of these checks: what an older version found is looked for again

Kind = Literal[
    "unreadable",
    "rate",
    "gap",
    "late",
    "dead_sensor",
    "saturated_sensor",
    "missing_images",
    "frozen_camera",
    "idle_head",
    "idle_tail",
    "force_spike",
    "velocity_spike",
    "duplicate",
    "balance",
]
Severity = Literal["note", "warning", "fault"]
Grade = Literal["good", "fair", "poor"]

FAST = ServoConfig().fast_period  # [s] between states
IMAGE_PERIOD = IMAGE_EVERY * CONTROL_PERIOD  # [s]
SLOW = (0.95, 0.80)  # share of its rate below which a stream deserves a warning, and is at fault
LOST = 1.5  # periods without a sample that count as a gap
LONG_GAP = 0.2  # [s] a gap that a policy would notice; also what cameras may miss at either end
OFTEN_LATE = (0.01, 0.10)  # share of ticks
DEAD = 0.5  # [s] of one and the same value; noise never repeats itself for so long
CLIPPED = 5  # samples in a row at the very extreme
LOADED = (5.0, 0.5)  # [N], [N·m] below which an extreme is no end of a sensor's range
FROZEN = 1.0  # [s] of one and the same picture ...
MOVES = 0.01  # [m] ... while what it shows moves
STILL = 0.02  # [rad/s] of the fastest joint; an arm's reach makes 1 cm/s of it
WINDOW = 0.05  # [s] over which that speed is measured
IDLE, MOSTLY_IDLE = 1.0, 0.25  # [s] worth trimming; share of a take that is worth a warning
GRIPS = 0.01  # share of the gripper's opening
HARD = 50.0  # [N] no task here needs more than 30
GLITCH = 15.0  # [N] out and back within one sample; hard contacts in the twin make 5
TOO_FAST = np.pi  # [rad/s] a UR5e's joints turn no faster
JERKS = 0.3  # [rad/s] from one sample to the next, 150 rad/s²; contacts in the twin make 0.03


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is not as it should be."""

    kind: Kind
    severity: Severity
    text: str  # a sentence
    where: str = ""  # the arm, camera or stream
    start: float | None = None  # [s] since the take's start; None where it concerns all of it
    end: float | None = None  # [s]


@dataclass(frozen=True, slots=True)
class TakeHealth:
    """What a recording shows; edits are not part of it."""

    episode_id: str
    duration: float  # [s]
    rates: dict[str, float]  # [Hz] achieved, of each stream
    late_share: float  # of the ticks
    findings: tuple[Finding, ...]
    fingerprint: str  # the same for the same motion
    start: dict[str, tuple[float, float, float]]  # [m] where tools (base axes) and objects were at first

    @property
    def grade(self) -> Grade:
        return grade_of(self.findings)

    def within(self, trim: tuple[float, float] | None) -> TakeHealth:
        """Without what was cut off: findings that end before or begin after the trim."""
        if trim is None:
            return self
        kept = [f for f in self.findings if f.start is None or f.end is None or _overlaps(f, trim)]
        return replace(self, findings=tuple(kept))

    def and_also(self, *findings: Finding) -> TakeHealth:
        return replace(self, findings=(*self.findings, *findings))


def grade_of(findings: Sequence[Finding]) -> Grade:
    """The worst finding decides; notes change nothing."""
    severities = {finding.severity for finding in findings}
    return "poor" if "fault" in severities else "fair" if "warning" in severities else "good"


def _overlaps(finding: Finding, trim: tuple[float, float]) -> bool:
    assert finding.start is not None
    assert finding.end is not None
    return finding.end > trim[0] and finding.start < trim[1]


@dataclass(frozen=True, slots=True)
class _Arm:
    """What was measured, at 500 Hz or at the rate of the dataset that it was imported from."""

    name: str
    time: Array  # (n,) [s]
    q: Array  # (n, 6) [rad]
    dq: Array  # (n, 6) [rad/s]
    position: Array  # (n, 3) [m]
    wrench: Array  # (n, 6)
    gripper: Array  # (n,)
    period: float  # [s] from one sample to the next, as it should be


def check(episode: Episode) -> TakeHealth:
    """Look through all of a take. Reads every column and image: about a second for a minute of two arms.

    Raise `studio.episode.EpisodeError` where the file is damaged, ValueError where it holds no states.
    """
    header, duration = episode.header, episode.duration
    columns = episode.columns(*(f"{arm}/state" for arm in header.arms), "tick")
    imported = _imported_period(header)
    arms = [_arm(columns, name, imported or FAST) for name in header.arms]
    ticks = columns["tick/time"]
    if len(ticks) < 2 or any(len(arm.time) < 2 for arm in arms):
        raise ValueError(f"{header.episode_id} holds no states: it was cut off as it began.")
    origin = float(arms[0].time[0])
    images = {camera: episode.image_times(camera) for camera in episode.cameras}
    streams = [(f"states of {arm.name}", arm.time, arm.period) for arm in arms]
    streams += [("ticks", ticks, imported or CONTROL_PERIOD)]
    image_period = imported or IMAGE_PERIOD
    streams += [(f"images of {name}", times, image_period) for name, times in images.items() if len(times)]
    late = columns["tick/late"]
    findings = [
        *_streams(streams, origin, origin + duration),
        *_lateness(late, columns["tick/wall"]),
        *(finding for arm in arms for finding in _sensor(arm)),
        *(Finding("missing_images", "fault", f"{name} sent no image.", name) for name in _blind(images)),
        *_frozen(episode, arms, images),
        *_idle(arms),
        *(finding for arm in arms for finding in (*_forces(arm), *_speeds(arm))),
    ]
    return TakeHealth(
        episode_id=header.episode_id,
        duration=duration,
        rates={name: round(_rate(times), 3) for name, times, _ in streams},
        late_share=float(np.mean(late > LATE)),
        findings=tuple(_since(origin, finding) for finding in findings),
        fingerprint=_fingerprint(arms),
        start=_start(episode, arms),
    )


def _imported_period(header: Header) -> float | None:
    """[s] between all samples of a take that was a dataset's; None for one recorded here."""
    rate = header.provenance.get("imported_from", {}).get("rate_Hz")
    return 1 / rate if isinstance(rate, int | float) and rate > 0 else None


def _arm(columns: Mapping[str, Array], name: str, period: float) -> _Arm:
    state = {key: columns[f"{name}/state/{key}"] for key in ("time", "q", "dq", "wrench", "gripper")}
    return _Arm(name, position=columns[f"{name}/state/base_from_tcp"][:, :3], period=period, **state)


def _since(origin: float, finding: Finding) -> Finding:
    if finding.start is None or finding.end is None:
        return finding
    return replace(finding, start=round(finding.start - origin, 3), end=round(finding.end - origin, 3))


# Streams


def _streams(streams: Sequence[tuple[str, Array, float]], begin: float, end: float) -> Iterator[Finding]:
    for name, times, period in streams:
        rate, due = _rate(times), 1 / period
        if rate < SLOW[0] * due:
            severity: Severity = "fault" if rate < SLOW[1] * due else "warning"
            yield Finding("rate", severity, f"{name}: {rate:.1f} Hz instead of {due:.0f}.", name)
        at_ends = [time for time in (begin, end) if np.abs(times - time).min() > LONG_GAP]
        padded = np.sort(np.concatenate((times, at_ends)))
        pauses = np.diff(padded)
        (gaps,) = np.nonzero(pauses > LOST * period)
        if len(gaps):
            worst = gaps[pauses[gaps].argmax()]
            severity = "fault" if pauses[worst] > LONG_GAP else "warning"
            gaps_told = f"{len(gaps)} gaps, the longest" if len(gaps) > 1 else "a gap"
            text = f"{name}: {gaps_told} of {pauses[worst]:.3f} s at {padded[worst] - begin:.2f} s."
            yield Finding("gap", severity, text, name, float(padded[worst]), float(padded[worst + 1]))


def _rate(times: Array) -> float:
    """[Hz] between the first and the last sample."""
    span = float(times[-1] - times[0])
    return (len(times) - 1) / span if span > 0 else 0.0


def _lateness(late: Array, wall: Array) -> Iterator[Finding]:
    """Of a live session: a headless one has no deadlines, and runs as fast as it can."""
    if not (late > 0).any():
        return
    share = float(np.mean(late > LATE))
    if share > OFTEN_LATE[0]:
        severity: Severity = "fault" if share > OFTEN_LATE[1] else "warning"
        text = f"{share:.1%} of the ticks were late, by up to {late.max() * 1e3:.0f} ms."
        yield Finding("late", severity, text, "ticks")
    rate, due = _rate(wall), 1 / CONTROL_PERIOD
    if rate < SLOW[0] * due:
        severity = "fault" if rate < SLOW[1] * due else "warning"
        text = f"By the clock there were {rate:.1f} ticks a second instead of {due:.0f}: time ran slowly."
        yield Finding("rate", severity, text, "clock")


# Sensors


_AXES = ("force x", "force y", "force z", "torque x", "torque y", "torque z")


def _sensor(arm: _Arm) -> Iterator[Finding]:
    broken = ~np.isfinite(arm.wrench).all(axis=1)
    if broken.any():
        start, end = _runs(broken)[0]
        text = f"The F/T sensor of {arm.name} told no number in {broken.mean():.1%} of the samples."
        yield Finding(
            "dead_sensor", "fault", text, arm.name, float(arm.time[start]), float(arm.time[end - 1])
        )
    stuck, clipped = [], []  # (axis, first sample, last)
    for axis, values in enumerate(arm.wrench.T):
        finite = values[np.isfinite(values)]
        extremes = {finite.max(), finite.min()} if len(finite) and np.ptp(finite) else set()
        for start, end in _runs(np.diff(values) == 0):  # samples start .. end are equal
            at_extreme = values[start] in extremes and abs(values[start]) >= LOADED[axis // 3]
            if at_extreme and end - start >= CLIPPED - 1:
                clipped.append((axis, start, end))
            elif arm.time[end] - arm.time[start] >= DEAD:
                stuck.append((axis, start, end))
    for kind, found, what in (
        ("dead_sensor", stuck, "told one and the same value for"),
        ("saturated_sensor", clipped, "was at the end of its range for"),
    ):
        if found:
            axes = ", ".join(dict.fromkeys(_AXES[axis] for axis, _, _ in found))
            _, start, end = max(found, key=lambda run: run[2] - run[1])
            seconds = arm.time[end] - arm.time[start]
            text = f"The F/T sensor of {arm.name} ({axes}) {what} {seconds:.2f} s."
            yield Finding(kind, "fault", text, arm.name, float(arm.time[start]), float(arm.time[end]))  # type: ignore[arg-type]


def _forces(arm: _Arm) -> Iterator[Finding]:
    force = arm.wrench[:, :3]
    norm = np.nan_to_num(np.linalg.norm(force, axis=1))
    if norm.max() > HARD:
        worst = int(norm.argmax())
        start, end = next(run for run in _runs(norm > HARD) if run[0] <= worst < run[1])
        text = f"{arm.name} felt {norm[worst]:.0f} N at {arm.time[worst]:.2f} s, above {HARD:.0f} N."
        yield Finding(
            "force_spike", "warning", text, arm.name, float(arm.time[start]), float(arm.time[end - 1])
        )
    steps = np.nan_to_num(np.diff(force, axis=0))
    sizes = np.linalg.norm(steps, axis=1)
    there_and_back = np.minimum(sizes[:-1], sizes[1:]) * ((steps[:-1] * steps[1:]).sum(axis=1) < 0)
    # A sample of a slow dataset lasts long enough for a real knock.
    if arm.period <= FAST and len(there_and_back) and there_and_back.max() > GLITCH:
        worst = int(there_and_back.argmax())
        text = f"The force of {arm.name} jumped by {there_and_back[worst]:.0f} N for one sample."
        moment = float(arm.time[worst + 1])
        yield Finding("force_spike", "warning", text, arm.name, moment, moment + FAST)


def _speeds(arm: _Arm) -> Iterator[Finding]:
    steps = np.diff(arm.time)[:, None]
    moved = np.abs(np.diff(arm.q, axis=0)) / np.maximum(steps, arm.period / 2)
    speed = np.nan_to_num(np.maximum(moved, np.abs(arm.dq[1:])).max(axis=1))
    jump = np.nan_to_num(np.abs(np.diff(arm.dq, axis=0)).max(axis=1))
    for values, limit, words in (
        (speed, TOO_FAST, "turned at {0:.1f} rad/s, faster than its joints can"),
        (jump, JERKS * arm.period / FAST, "changed its speed by {0:.2f} rad/s within a sample"),
    ):
        if values.max() > limit:
            worst = int(values.argmax())
            text = (
                f"{arm.name} {words.format(values[worst])}, {np.count_nonzero(values > limit)} times in all."
            )
            start, end = float(arm.time[worst]), float(arm.time[worst + 1])
            yield Finding("velocity_spike", "warning", text, arm.name, start, end)


# Cameras


def _blind(images: Mapping[str, Array]) -> list[str]:
    return [camera for camera, times in images.items() if not len(times)]


def _frozen(episode: Episode, arms: Sequence[_Arm], images: Mapping[str, Array]) -> Iterator[Finding]:
    carriers = _carriers(episode.header.task)
    for camera, times in images.items():
        hashes = [hash(episode.jpeg(camera, number)) for number in range(len(times))]
        seen = [arm for arm in arms if arm.name == carriers.get(camera)] or arms
        stills = [(times[start], times[end]) for start, end in _runs(np.diff(np.array(hashes)) == 0)]
        found = [
            (a, b) for a, b in stills if b - a >= FROZEN and any(_moved(arm, a, b) > MOVES for arm in seen)
        ]
        if found:
            start, end = max(found, key=lambda still: still[1] - still[0])
            text = f"{camera} showed one and the same picture for {end - start:.1f} s while an arm moved."
            yield Finding("frozen_camera", "fault", text, camera, float(start), float(end))


def _carriers(task: str) -> dict[str, str | None]:
    """The arm that carries each camera of a task that is known."""
    try:
        return {view.name: view.arm for view in tasks.load(task).cameras}
    except KeyError:
        return {}


def _moved(arm: _Arm, start: float, end: float) -> float:
    """[m] from corner to corner of the box in which the tool was."""
    first, last = np.searchsorted(arm.time, (start, end))
    if first == last:
        return 0.0
    return float(np.linalg.norm(np.ptp(arm.position[first:last], axis=0)))


# The whole


def _idle(arms: Sequence[_Arm]) -> Iterator[Finding]:
    """Before anything moves, and after everything has."""
    span = max(1, round(WINDOW / arms[0].period))
    begin, end = float(arms[0].time[0]), float(arms[0].time[-1])
    begins, ends = [], []
    for arm in arms:
        if len(arm.time) <= span:
            continue
        turned = np.abs(arm.q[span:] - arm.q[:-span]).max(axis=1)
        gripped = np.abs(arm.gripper[span:] - arm.gripper[:-span])
        (busy,) = np.nonzero((turned > STILL * span * arm.period) | (gripped > GRIPS))
        if len(busy):
            begins.append(float(arm.time[busy[0]]))
            ends.append(float(arm.time[busy[-1] + span]))
    if not begins:
        yield Finding("idle_head", "fault", "Nothing moves in the whole take.", "", begin, end)
        return
    whole = max(end - begin, FAST)
    head, tail = min(begins), max(ends)
    for kind, start, stop, words in (
        ("idle_head", begin, head, "before anything moves"),
        ("idle_tail", tail, end, "after the last motion"),
    ):
        if stop - start > IDLE:
            severity: Severity = "warning" if (stop - start) / whole > MOSTLY_IDLE else "note"
            text = f"{stop - start:.1f} s {words}; a trim would cut it off."
            yield Finding(kind, severity, text, "", start, stop)  # type: ignore[arg-type]


def _fingerprint(arms: Sequence[_Arm]) -> str:
    """Of the joints' way, to a µrad: times, images and the header may differ."""
    digest = hashlib.blake2b(digest_size=16)
    for arm in arms:
        digest.update(np.round(arm.q * 1e6).astype("<i8").tobytes())
    return digest.hexdigest()


def _start(episode: Episode, arms: Sequence[_Arm]) -> dict[str, tuple[float, float, float]]:
    """Tools in base axes, objects in the world."""
    places = {f"tool of {arm.name}": arm.position[0] for arm in arms}
    for name, pose in episode.task_state_at(float(arms[0].time[0])).items():
        if name.startswith("pose/"):
            places[name.removeprefix("pose/")] = pose[:3]
    return {name: (float(x), float(y), float(z)) for name, (x, y, z) in places.items()}


def _runs(flags: Array) -> list[tuple[int, int]]:
    """First index, and the one after the last, of every stretch of True in (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(np.int8)))
    return [(int(start), int(end)) for start, end in edges.reshape(-1, 2)]
