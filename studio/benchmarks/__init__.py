"""Measurements of our own parts, and the goals they are held against; run by `studio bench`."""

from __future__ import annotations

import importlib
import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from studio.recorder import versions

# Modules with a `measure()`.
PARTS = (
    "fdcc",
    "contact",
    "loop",
    "cameras",
    "episodes",
    "catalog",
    "export",
    "live",
    "gizmo",
    "xr",
    "scene",
    "proxy",
    "review",
    "view",
    "page",
    "policy",
    "jobs",
)

Results = dict[str, Any]  # what a part measured

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Goal:
    """A bound on something that a part measured."""

    part: str
    what: str
    value: Callable[[Results], float]
    bound: Literal["<=", ">="]
    limit: float

    def against(self, results: Results) -> Results:
        value = self.value(results)
        met = value <= self.limit if self.bound == "<=" else value >= self.limit
        goal = f"{self.bound} {self.limit:g}"
        return {"part": self.part, "what": self.what, "measured": value, "goal": goal, "met": met}


def run(only: Sequence[str] = (), tell: Callable[[str], None] | None = None) -> Results:
    """Measure all parts, or `only` some, one after the other; `tell` is told the name of each as it begins.

    The load average stands beside each part, as of its end: other programs slow what is measured. A part that
    cannot be measured costs the others nothing: why not stands under "failed", and its goals are left out.
    """
    unknown = set(only) - set(PARTS)
    if unknown:
        raise KeyError(f"No part {', '.join(sorted(unknown))}; there are {list(PARTS)}.")
    results: Results = {"machine": {**versions(), "cores": os.cpu_count()}, "failed": {}}
    for part in only or PARTS:
        if tell:
            tell(part)
        try:
            measured = importlib.import_module(f"{__name__}.{part}").measure()
        except Exception as error:  # whatever breaks in one part
            log.exception("The part %s failed.", part)
            results["failed"][part] = f"{type(error).__name__}: {error}"
        else:
            results[part] = {**measured, "load_average": os.getloadavg()[0]}
    results["goals"] = [goal.against(results[goal.part]) for goal in GOALS if goal.part in results]
    return results


def _deviation(kind: str) -> Callable[[Results], float]:
    """[N] of the least quiet mode."""
    return lambda results: max(press["std_N"] for press in results[kind].values())


def _furthest(name: str) -> Callable[[Results], float]:
    """How far a press's ratio is from one, at most over the modes."""
    return lambda results: max(abs(press[name] - 1.0) for press in results["press"].values())


def _rise(mode: str) -> Callable[[Results], float]:
    """[s] on the slowest axis."""
    return lambda results: max(step["rise_s"] for step in results["step"][mode].values())


GOALS = (
    Goal("fdcc", "FDCC step, times Pinocchio's bare calls", lambda r: r["ratio"], "<=", 4.0),
    Goal("contact", "press, share off K (target - tcp)", _furthest("to_law"), "<=", 0.03),
    Goal("contact", "press, share off K 10 mm", _furthest("to_depth"), "<=", 0.10),
    Goal("contact", "press, standard deviation [N]", _deviation("press"), "<=", 0.1),
    Goal("contact", "the same at twice error_scale [N]", _deviation("press_at_twice_error_scale"), "<=", 0.1),
    Goal("contact", "20 mm step to 63 %, low [s]", _rise("low"), "<=", 0.50),
    Goal("contact", "20 mm step to 63 %, medium [s]", _rise("medium"), "<=", 0.28),
    Goal("contact", "20 mm step to 63 %, high [s]", _rise("high"), "<=", 0.20),
    Goal("loop", "one arm in contact, times real time", lambda r: r["one_arm"], ">=", 8.0),
    Goal("loop", "two arms in contact, times real time", lambda r: r["two_arms"], ">=", 4.0),
    Goal("cameras", "240x320 image of two arms, CPU [ms]", lambda r: r["cpu_ms"], "<=", 10.0),
    Goal(
        "episodes",
        "recorder besides JPEG, share of a core",
        lambda r: r["recorder_share_of_core"],
        "<=",
        0.05,
    ),
    Goal("episodes", "columns of 60 s with two arms, CPU [s]", lambda r: r["columns_cpu_s"], "<=", 0.8),
    Goal("episodes", "any image of a take [ms]", lambda r: r["frame_ms"], "<=", 6.0),
    Goal("catalog", "slowest filtered page of 100,000 takes, CPU [ms]", lambda r: r["page_ms"], "<=", 5.0),
    Goal("catalog", "the same right after an edit [ms]", lambda r: r["page_ms_after_edit"], "<=", 5.0),
    Goal("catalog", "slowest text search in 100,000 takes, CPU [ms]", lambda r: r["search_ms"], "<=", 30.0),
    Goal("catalog", "the same right after an edit [ms]", lambda r: r["search_ms_after_edit"], "<=", 30.0),
    Goal("catalog", "slowest facets of 100,000 takes, CPU [ms]", lambda r: r["facets_ms"], "<=", 100.0),
    Goal("catalog", "the same right after an edit [ms]", lambda r: r["facets_ms_after_edit"], "<=", 100.0),
    Goal("catalog", "slowest sums of 100,000 takes [ms]", lambda r: r["amount_ms_after_edit"], "<=", 100.0),
    Goal("catalog", "index of 1,000 takes built anew, CPU [s]", lambda r: r["rebuild_s"], "<=", 20.0),
    Goal("export", "60 s of three cameras to LeRobot, CPU [s]", lambda r: r["lerobot_cpu_s"], "<=", 20.0),
    Goal("live", "ticks more than 2 ms late, share", lambda r: r["late_share"], "<=", 0.005),
    Goal("scene", "scene of two arms [MB]", lambda r: r["two_arms_scene_MB"], "<=", 3.0),
    Goal("scene", "poses of one arm, to a viewer [kB/s]", lambda r: r["one_arm_stream_kB_per_s"], "<=", 60.0),
    Goal(
        "scene", "poses of two arms, to a viewer [kB/s]", lambda r: r["two_arms_stream_kB_per_s"], "<=", 60.0
    ),
    Goal("view", "60 s of two arms to the first frame, page [s]", lambda r: r["open_s"], "<=", 0.5),
    Goal("view", "scrub step of three cameras, page [ms]", lambda r: r["scrub_ms"], "<=", 50.0),
    Goal("page", "first full render in Chromium [s]", lambda r: r["first_render_s"], "<=", 6.0),
    Goal(
        "gizmo",
        "isolated move of the gizmo to the servo, p95 [ms]",
        lambda r: r["isolated_p95_ms"],
        "<=",
        40.0,
    ),
    Goal("xr", "hand to servo at 60 Hz, p50 [ms]", lambda r: r["p50_ms"], "<=", 12.0),
    Goal("xr", "hand to servo at 60 Hz, p95 [ms]", lambda r: r["p95_ms"], "<=", 25.0),
    Goal("xr", "the same while others download, p50 [ms]", lambda r: r["with_downloads_p50_ms"], "<=", 12.0),
    Goal("xr", "the same while others download, p95 [ms]", lambda r: r["with_downloads_p95_ms"], "<=", 25.0),
    Goal("xr", "poses that arrived, share", lambda r: r["arrived"], ">=", 0.99),
    Goal("xr", "two hands at 120 Hz, share of a core", lambda r: r["two_hands_share_of_core"], "<=", 0.06),
    Goal("policy", "small, training step at batch 16 [s]", lambda r: r["small_step_s"], "<=", 0.16),
    Goal("policy", "small, an answer [ms]", lambda r: r["small_answer_ms"], "<=", 15.0),
    Goal("policy", "small, reading data, share of a step", lambda r: r["small_data_share"], "<=", 0.05),
    Goal("policy", "small, peak memory of training [GB]", lambda r: r["small_peak_GB"], "<=", 4.0),
    Goal("policy", "paper at 240x320, step at batch 8 [s]", lambda r: r["paper_step_s"], "<=", 7.0),
    Goal("policy", "the same, one decoder layer [s]", lambda r: r["shallow_step_s"], "<=", 3.9),
    Goal("jobs", "asked for training to its first step [s]", lambda r: r["first_step_s"], "<=", 15.0),
    Goal("jobs", "a page that lists ten, share of a core", lambda r: r["refresh_share_of_core"], "<=", 0.03),
    Goal("jobs", "late ticks while all cores train, share", lambda r: r["late_share"], "<=", 0.02),
)
