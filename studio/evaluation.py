"""What came of rolling out one agent over many seeds, kept as a file, and how two such compare.

DATA/evaluations/<id>.json      an `Evaluation`; its rollouts are episodes of the catalogue
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Rollout:
    """One seed. Forces are of the arm that feels the most, means over the time in contact."""

    seed: int
    success: bool
    error: str | None = None  # why it says nothing about the agent; the rest is then empty
    episode_id: str = ""
    progress: float = 0.0  # 0 .. 1 at the end
    phase: str = ""
    seconds: float = 0.0  # simulated
    wall_seconds: float = 0.0
    contact_seconds: float = 0.0
    force_mean_N: float = 0.0
    force_sd_N: float = 0.0
    force_max_N: float = 0.0  # over all fast steps
    impulse_Ns: float = 0.0
    limits: tuple[str, ...] = ()  # kinds of limits that acted
    late_ticks: int = 0  # for which a policy had no word, and its last target was held


@dataclass(frozen=True, slots=True)
class Curves:
    """Force and stiffness of one arm over time, over the trials that still run then."""

    time_s: list[float]
    trials: list[int]
    force_mean_N: list[float]
    force_sd_N: list[float]
    stiffness_mean_N_m: list[float | None]  # None under joint control
    stiffness_sd_N_m: list[float | None]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What came of a plan."""

    evaluation_id: str
    started: float  # [s] unix time
    run: str
    task: str
    spread: float
    provenance: dict[str, Any]
    versions: dict[str, str]
    rollouts: tuple[Rollout, ...]  # by seed
    curves: dict[str, Curves]  # of each arm
    images: str = "no"  # "yes", "no", or why there are none although asked for

    @property
    def label(self) -> str:
        """The agent, and how it was run where that is not the usual way."""
        extra = [f"{hidden} hidden" for hidden in self.provenance.get("hidden", ())]
        if self.provenance.get("execution") == "ensemble":
            extra.append("ensemble")
        if (table := self.provenance.get("stiffness_table", "tuned")) != "tuned":
            extra.append(f"{table} stiffness")
        return f"{self.run} ({', '.join(extra)})" if extra else self.run

    @property
    def judged(self) -> tuple[Rollout, ...]:
        """The rollouts without an error."""
        return tuple(rollout for rollout in self.rollouts if rollout.error is None)

    @property
    def successes(self) -> int:
        return sum(rollout.success for rollout in self.judged)

    def summary(self) -> dict[str, Any]:
        """What `studio evaluate --json` prints."""
        judged = self.judged
        mean, sd = _pooled(judged)
        return {
            "evaluation": self.evaluation_id,
            **self.provenance,
            "run": self.run,
            "task": self.task,
            "episodes": len(judged),
            "successes": self.successes,
            "wilson_95": [round(bound, 4) for bound in wilson(self.successes, len(judged))],
            "force_mean_N": round(mean, 4),
            "force_sd_N": round(sd, 4),
            "force_max_N": round(max((r.force_max_N for r in judged), default=0.0), 4),
            "force_peak_mean_N": round(_mean(r.force_max_N for r in judged), 4),
            "impulse_mean_Ns": round(_mean(r.impulse_Ns for r in judged), 4),
            "contact_seconds_mean": round(_mean(r.contact_seconds for r in judged), 4),
            "seconds_per_episode": round(_mean(r.seconds for r in judged), 3),
            "wall_seconds_per_episode": round(_mean(r.wall_seconds for r in judged), 3),
            "late_ticks": sum(r.late_ticks for r in judged),
            "spread": self.spread,
            "seeds": [r.seed for r in self.rollouts],
            "ids": [r.episode_id for r in judged],
            "failed_seeds": [r.seed for r in judged if not r.success],
            "errors": {str(r.seed): r.error for r in self.rollouts if r.error is not None},
            "images": self.images,
        }

    def __str__(self) -> str:
        judged, (low, high) = self.judged, wilson(self.successes, len(self.judged))
        mean, sd = _pooled(judged)
        return (
            f"{self.label} on {self.task}: {self.successes} of {len(judged)} succeeded "
            f"({low:.0%} to {high:.0%}), contact force {mean:.1f} ± {sd:.1f} N and at most "
            f"{max((r.force_max_N for r in judged), default=0.0):.1f} N, "
            f"{_mean(r.seconds for r in judged):.1f} s an episode; {self.evaluation_id}"
        )

    def save(self, data_dir: Path) -> Path:
        """Write it below a data folder, whole or not at all."""
        path = _path(data_dir, self.evaluation_id)
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        part.write_bytes(msgspec.json.encode(self))
        part.rename(path)
        return path


def load(path: Path) -> Evaluation:
    """Read an evaluation. Raises ValueError with what is wrong with the file."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Evaluation)
    except msgspec.DecodeError as error:
        raise ValueError(f"{path} is no evaluation: {error}.") from error


def load_all(data_dir: Path) -> list[Evaluation]:
    """Those of a data folder, the newest first; damaged files are named in the log."""
    found = []
    for path in _path(data_dir, "").parent.glob("*.json"):
        try:
            found.append(load(path))
        except ValueError as error:
            log.warning("%s", error)
    return sorted(found, key=lambda evaluation: -evaluation.started)


def named(data_dir: Path, evaluation_id: str) -> Evaluation:
    """By its id alone. Raises KeyError for an unknown one, ValueError for a damaged file."""
    path = _path(data_dir, evaluation_id)
    if path.parent != data_dir / "evaluations" or evaluation_id.startswith(".") or not path.is_file():
        raise KeyError(f"No evaluation {evaluation_id!r}.")
    return load(path)


def find(data_dir: Path, name: str, task: str | None = None) -> Evaluation:
    """By path, by id, or the newest of the agent `name` (on `task`, where it is given)."""
    for path in (Path(name), _path(data_dir, name)):
        if path.suffix == ".json" and path.is_file():
            return load(path)
    saved = load_all(data_dir)
    found = [e for e in saved if e.run == name and task in (None, e.task)]
    if not found:
        there = sorted({f"{e.run} on {e.task}" for e in saved}) or "none yet; studio evaluate makes them"
        raise KeyError(f"No evaluation of {name!r}{f' on {task}' if task else ''}; there are {there}.")
    return found[0]


def _path(data_dir: Path, evaluation_id: str) -> Path:
    return data_dir / "evaluations" / f"{evaluation_id}.json"


# Statistics


def wilson(successes: int, n: int) -> tuple[float, float]:
    """95 % interval of a success rate (Wilson, 1927); (0, 1) without any trial."""
    if n == 0:
        return 0.0, 1.0
    z2 = 1.959963984540054**2
    center = (successes + z2 / 2) / (n + z2)
    half = math.sqrt(z2 * (successes * (n - successes) / n + z2 / 4)) / (n + z2)
    return max(0.0, center - half), min(1.0, center + half)


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two agents on the same scenes."""

    one: str
    other: str
    task: str
    pairs: int
    only_one: int  # scenes in which only `one` succeeded
    only_other: int
    difference: float  # of the success rates
    difference_95: tuple[float, float]  # see `paired_interval`
    mcnemar_p: float  # exact, two-sided
    force_difference_N: float  # mean over pairs of the mean contact force, `one` less `other`

    def __str__(self) -> str:
        return (
            f"{self.one} against {self.other} on {self.pairs} scenes of {self.task}: {self.difference:+.0%}, "
            f"95 % {self.difference_95[0]:+.0%} to {self.difference_95[1]:+.0%} "
            f"({self.only_one} : {self.only_other} where only one succeeded, exact McNemar p = "
            f"{self.mcnemar_p:.2g}), contact force {self.force_difference_N:+.1f} N."
        )


def check_same_scenes(run: str, task: str, spread: float, seeds: Iterable[int], other: Evaluation) -> None:
    """Raise ValueError where an evaluation met none of the scenes of a run."""
    if (task, spread) != (other.task, other.spread):
        raise ValueError(
            f"{run} ran on {task} with spread {spread:g}, {other.run} on {other.task} with "
            f"spread {other.spread:g}: these are other scenes."
        )
    if not {rollout.seed for rollout in other.judged} & set(seeds):
        raise ValueError(f"The evaluations of {run} and {other.run} have no seed in common.")


def compare(one: Evaluation, other: Evaluation) -> Comparison:
    """Pair two evaluations by scene; raises ValueError where they share none."""
    check_same_scenes(one.run, one.task, one.spread, (r.seed for r in one.judged), other)
    others = {rollout.seed: rollout for rollout in other.judged}
    pairs = [(r, others[r.seed]) for r in one.judged if r.seed in others]
    only_one = sum(a.success and not b.success for a, b in pairs)
    only_other = sum(b.success and not a.success for a, b in pairs)
    return Comparison(
        one=one.label,
        other=other.label,
        task=one.task,
        pairs=len(pairs),
        only_one=only_one,
        only_other=only_other,
        difference=(only_one - only_other) / len(pairs),
        difference_95=paired_interval(only_one, only_other, len(pairs)),
        mcnemar_p=mcnemar(only_one, only_other),
        force_difference_N=_mean(a.force_mean_N - b.force_mean_N for a, b in pairs),
    )


def pooled(comparisons: Sequence[Comparison], one: str, other: str) -> Comparison:
    """Several as one: the same question asked of several runs."""
    pairs = sum(c.pairs for c in comparisons)
    only_one, only_other = sum(c.only_one for c in comparisons), sum(c.only_other for c in comparisons)
    return Comparison(
        one=one,
        other=other,
        task=", ".join(dict.fromkeys(c.task for c in comparisons)),
        pairs=pairs,
        only_one=only_one,
        only_other=only_other,
        difference=(only_one - only_other) / pairs,
        difference_95=paired_interval(only_one, only_other, pairs),
        mcnemar_p=mcnemar(only_one, only_other),
        force_difference_N=sum(c.force_difference_N * c.pairs for c in comparisons) / pairs,
    )


def paired_interval(only_one: int, only_other: int, pairs: int) -> tuple[float, float]:
    """95 % interval of the difference of two success rates on the same scenes; (-1, 1) without any.

    Wald's, with half a scene added to each of the four outcomes (Agresti and Min, Statist. Med. 2005).
    """
    if pairs == 0:
        return -1.0, 1.0
    n, one, other = pairs + 2.0, only_one + 0.5, only_other + 0.5
    difference = (one - other) / n
    half = 1.959963984540054 * math.sqrt((one + other) - (one - other) ** 2 / n) / n
    return max(-1.0, difference - half), min(1.0, difference + half)


def mcnemar(only_one: int, only_other: int) -> float:
    """Exact two-sided p of discordant pairs (McNemar, 1947): a fair coin for each."""
    n = only_one + only_other
    tail: float = sum(math.comb(n, k) for k in range(min(only_one, only_other) + 1)) / 2**n
    return min(1.0, 2 * tail)


def _pooled(rollouts: Sequence[Rollout]) -> tuple[float, float]:
    """Mean and standard deviation [N] over all time in contact."""
    weights = np.array([r.contact_seconds for r in rollouts])
    if not weights.sum():
        return 0.0, 0.0
    means, sds = (np.array([getattr(r, f"force_{what}_N") for r in rollouts]) for what in ("mean", "sd"))
    mean = float(np.average(means, weights=weights))
    square = float(np.average(means**2 + sds**2, weights=weights))
    return mean, math.sqrt(max(0.0, square - mean**2))


def _mean(values: Iterable[float]) -> float:
    found = list(values)
    return sum(found) / len(found) if found else 0.0
