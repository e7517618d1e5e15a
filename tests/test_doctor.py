"""The doctor tells the truth about this machine and knows a line for what is missing."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from studio import doctor
from studio.doctor import Finding, as_json, as_text, diagnose

REPOSITORY = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def findings() -> dict[str, Finding]:
    return {finding.name: finding for finding in diagnose()}


def test_everything_is_looked_at(findings: dict[str, Finding]) -> None:
    assert list(findings) == [
        "Python", "packages", "libraries", "rendering", "chromium",
        "node", "SteamVR", "GPU", "disk", "cores", "real time",
    ]  # fmt: skip
    assert findings["Python"].ok
    assert sys.executable in findings["Python"].detail


def test_what_is_well_needs_no_remedy(findings: dict[str, Finding]) -> None:
    for finding in findings.values():
        assert finding.detail
        assert finding.needed_for
        assert not (finding.ok and finding.remedy)


@pytest.mark.parametrize("name", ["rendering", "chromium", "node", "SteamVR"])
def test_what_is_missing_has_a_line_that_installs_it(name: str, empty_machine: dict[str, Finding]) -> None:
    finding = empty_machine[name]
    assert not finding.ok
    assert "install" in finding.remedy


@pytest.fixture(scope="module")
def empty_machine(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Finding]:
    """What the doctor finds with nothing on the PATH, no home and no OpenGL backend that exists."""
    program = """
from studio import doctor
doctor.BACKENDS = ("none such",)
print(doctor.as_json([check() for check in doctor.CHECKS if check is not doctor.check_gpu]))
"""
    home = tmp_path_factory.mktemp("home")
    environment = {"PATH": str(home), "HOME": str(home), "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    return {fields["name"]: Finding(**fields) for fields in json.loads(done.stdout)}


def test_a_process_renders_with_the_backend_that_was_found(findings: dict[str, Finding]) -> None:
    backend = doctor.render_backend()
    assert findings["rendering"].ok == (backend is not None)
    if backend is None:
        pytest.skip(f"no offscreen rendering: {findings['rendering'].detail}")
    program = "import mujoco; mujoco.GLContext(16, 16).free()"
    subprocess.run([sys.executable, "-c", program], env={**os.environ, "MUJOCO_GL": backend}, check=True)


def test_looking_loads_neither_torch_nor_mujoco() -> None:
    program = """
import sys
from studio import doctor
doctor.diagnose()
assert not {"torch", "mujoco"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", program], cwd=REPOSITORY, check=True)


def test_text_and_json_tell_the_same(findings: dict[str, Finding]) -> None:
    told = list(findings.values())
    assert [Finding(**fields) for fields in json.loads(as_json(told))] == told
    text = as_text(told)
    for finding in told:
        assert finding.detail in text
        assert finding.remedy in text
