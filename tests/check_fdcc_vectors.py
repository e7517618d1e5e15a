"""Compare our FDCC with recorded runs of the reference program.

    python tests/check_fdcc_vectors.py FILE.json[.gz]

Prints the largest joint difference of each scenario; exit status 1 if one is above 1e-9 rad. The files hold
commands of the original C++ controller (cartesian_controllers, ros2, commit f53f798); their header says how
to read them.
"""

from __future__ import annotations

import gzip
import json
import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from controller.fdcc import Fdcc, FdccConfig
from controller.model import ArmModel, Segment
from controller.types import Pose, Stiffness

TOLERANCE = 1e-9  # [rad]


@dataclass(frozen=True, slots=True)
class Comparison:
    scenario: str
    difference: float  # [rad] largest over all steps and joints

    @property
    def passed(self) -> bool:
        return self.difference <= TOLERANCE  # False for NaN, too


def compare(path: Path) -> Iterator[Comparison]:
    """Run every scenario of a file."""
    file = read(path)
    for scenario in file["scenarios"]:
        yield compare_scenario(scenario, file["chains"][scenario["chain"]])


def read(path: Path) -> dict[str, Any]:
    content = path.read_bytes()
    file: dict[str, Any] = json.loads(gzip.decompress(content) if path.suffix == ".gz" else content)
    return file


def compare_scenario(scenario: Mapping[str, Any], chain: Mapping[str, Any]) -> Comparison:
    """Run FDCC beside the recorded commands, fed with its own ones where the recorded feedback was ideal."""
    arm = arm_of(chain, scenario["end_effector_link"])
    reference = np.array(scenario["q_cmd"])  # (steps, n)
    measured = scenario.get("q_meas")
    wrenches = np.array(scenario.get("ft_wrench", np.zeros((len(reference), 6))))
    events: dict[int, dict[str, Any]] = {}
    for event in scenario["events"]:
        events.setdefault(event["step"], {}).update(event)
    fdcc = Fdcc(
        arm,
        np.array(scenario["q0"]),
        FdccConfig(
            iterations=scenario["iterations"],
            internal_dt=scenario["internal_dt"],
            link_mass=scenario["link_mass"],
            hand_frame_control=scenario["hand_frame_control"],
        ),
        compliance_frame=scenario["compliance_ref_link"],
        sensor_frame=scenario["ft_sensor_ref_link"],
    )
    q = np.array(scenario["q0"])
    target, target_wrench = arm.forward_kinematics(q), np.zeros(6)
    stiffness = Stiffness.diagonal((500.0, 500.0, 500.0, 50.0, 50.0, 50.0))  # the reference's default
    difference = 0.0
    for k, wrench in enumerate(wrenches):
        event = events.get(k, {})
        fdcc.configure(replace(fdcc.config, **gains_of(event)))
        target = target_of(event["target_pose"]) if "target_pose" in event else target
        stiffness = Stiffness.diagonal(event["stiffness"]) if "stiffness" in event else stiffness
        target_wrench = np.array(event.get("target_wrench", target_wrench))
        feedback = q if measured is None else np.array(measured[k])
        q = fdcc.step(feedback, target, stiffness, wrench, target_wrench)
        difference = float(np.maximum(difference, np.abs(q - reference[k]).max()))
    return Comparison(scenario["name"], difference)


def arm_of(chain: Mapping[str, Any], end_effector: str) -> ArmModel:
    """The chain up to its end effector."""
    links = [segment["link"] for segment in chain["segments"]]
    segments = chain["segments"][: links.index(end_effector) + 1]
    return ArmModel(chain["base_link"], [segment_of(segment) for segment in segments])


def segment_of(segment: Mapping[str, Any]) -> Segment:
    kinds = ("fixed", "revolute", "continuous")
    if segment["type"] not in kinds:
        raise ValueError(f"Joint {segment['joint']!r} is {segment['type']}; known are {kinds}.")
    pose = Pose.of(np.array(segment["rotation_matrix_row_major"]), np.array(segment["origin_xyz"]))
    if segment["type"] == "fixed":
        return Segment(segment["link"], pose)
    return Segment(
        link=segment["link"],
        parent_from_link=pose,
        axis=np.array(segment["axis"]),
        lower=segment.get("lower", -math.inf),
        upper=segment.get("upper", math.inf),
    )


def target_of(pose: list[float]) -> Pose:
    """From position, then quaternion xyzw."""
    x, y, z, qx, qy, qz, qw = pose
    return Pose(np.array([x, y, z]), np.array([qw, qx, qy, qz]))


def gains_of(event: Mapping[str, Any]) -> dict[str, Any]:
    gains: dict[str, Any] = {name: tuple(event[name]) for name in ("p_gains", "d_gains") if name in event}
    return gains | ({"error_scale": event["error_scale"]} if "error_scale" in event else {})


def main(path: Path) -> int:
    comparisons = list(compare(path))
    for c in comparisons:
        sys.stdout.write(f"{'ok  ' if c.passed else 'FAIL'} {c.scenario:32s} {c.difference:.1e} rad\n")
    failed = sum(not c.passed for c in comparisons)
    sys.stdout.write(f"{len(comparisons)} scenarios, {failed} failed, tolerance {TOLERANCE:.0e} rad\n")
    return 1 if failed or not comparisons else 0


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.stderr.write(f"{__doc__}\n")
        sys.exit(2)
    sys.exit(main(Path(sys.argv[1])))
