"""What this machine can do, and for what it lacks the exact line that installs it.

Whatever could abort or takes long (OpenGL, torch) is tried in a process of its own.
"""

from __future__ import annotations

import dataclasses
import functools
import getpass
import importlib.metadata
import importlib.util
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Backend = Literal["egl", "osmesa"]
BACKENDS: tuple[Backend, ...] = ("egl", "osmesa")
PROJECT = "compact-studio"
PYTHON = ((3, 11), (3, 14))  # from, below
CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
NODE = 18  # oldest major version that installs the page's libraries: Debian 12 has it
FREE_DISK = 5e9  # [bytes] an hour of takes with cameras; recording itself stops at 1 GB
CORES = 2  # one for the session, one for cameras and page
PATIENCE = 120.0  # [s] for one trial: a first `import torch` from a cold disk is slow

_RENDER = """
import mujoco
from OpenGL import GL
model = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><light pos="0 0 3"/><geom size=".1"/></worldbody></mujoco>'
)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 16, 16) as renderer:
    renderer.update_scene(data)
    assert renderer.render().any(), "the image is black"
    print(GL.glGetString(GL.GL_RENDERER).decode())
"""
_LIBRARIES = """
import os
os.environ["MUJOCO_GL"] = "disable"
import cv2, mujoco, pinocchio
"""
_REALTIME = """
import os
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
"""
_GPU = """
import torch
if torch.cuda.is_available():
    print(", ".join(torch.cuda.get_device_name(n) for n in range(torch.cuda.device_count())))
"""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at."""

    name: str
    ok: bool
    detail: str  # what was found
    needed_for: str
    remedy: str = ""  # the line that installs it; empty where nothing is to be done


def diagnose() -> list[Finding]:
    """Look at everything; takes a few seconds."""
    with ThreadPoolExecutor() as pool:
        return list(pool.map(lambda check: check(), CHECKS))


def render_backend() -> Backend | None:
    """What MUJOCO_GL must be for a process that renders: the first that draws an image here, or None."""
    return _rendering()[0]


def as_text(findings: Sequence[Finding]) -> str:
    """For people: one line a finding, and what to do under those that are not well."""
    width = max(len(finding.name) for finding in findings)
    lines = []
    for finding in findings:
        lines.append(f"{'ok     ' if finding.ok else 'missing'}  {finding.name:{width}}  {finding.detail}")
        if not finding.ok:
            lines.append(f"{'':{width + 11}}needed for {finding.needed_for}")
        if finding.remedy:
            lines.append(f"{'':{width + 11}}$ {finding.remedy}")
    return "\n".join(lines)


def as_json(findings: Sequence[Finding]) -> str:
    return json.dumps([dataclasses.asdict(finding) for finding in findings])


def check_python() -> Finding:
    (oldest, newest), version = PYTHON, sys.version_info[:2]
    return Finding(
        "Python",
        oldest <= version < newest,
        f"{platform.python_version()}, {sys.executable}",
        f"everything: 3.{oldest[1]} to 3.{newest[1] - 1}",
        "" if oldest <= version < newest else apt("python3.11", "python3.11-venv"),
    )


def check_packages() -> Finding:
    try:
        required = importlib.metadata.requires(PROJECT) or []
    except importlib.metadata.PackageNotFoundError:
        return Finding("packages", False, f"{PROJECT} is not installed", "everything", "make studio")
    names = [re.split(r"[^\w.-]", text)[0] for text in required if "extra ==" not in text]
    versions = {name: _version(name) for name in sorted(names)}
    lacking = [name for name, version in versions.items() if version is None]
    detail = ", ".join(f"{name} {version or 'missing'}" for name, version in versions.items())
    return Finding("packages", not lacking, detail, "everything", "make studio" if lacking else "")


def check_libraries() -> Finding:
    try:
        _python(_LIBRARIES)
    except subprocess.SubprocessError as error:
        return Finding("libraries", False, _reason(error), "everything", apt("libgomp1"))
    return Finding("libraries", True, "pinocchio, mujoco and opencv load", "everything")


def check_rendering() -> Finding:
    backend, detail = _rendering()
    remedy = "" if backend else apt("libegl1", "libgl1", "libgl1-mesa-dri")
    return Finding("rendering", backend is not None, detail, "camera images, and policies that see", remedy)


def check_chromium() -> Finding:
    found = next((path for name in CHROMIUM if (path := shutil.which(name))), None)
    remedy = "" if found else apt("chromium")
    return Finding("chromium", found is not None, found or "not found", "browser tests", remedy)


def check_node() -> Finding:
    npm, version = shutil.which("npm"), _output("node", "--version")
    major = re.match(r"v(\d+)", version)
    ok = npm is not None and major is not None and int(major[1]) >= NODE
    detail = f"{version or 'no node'}, {npm or 'no npm'}"
    return Finding(
        "node", ok, detail, f"the page's libraries: {NODE} or newer", "" if ok else apt("nodejs", "npm")
    )


def check_vr() -> Finding:
    """Headsets by WebXR need a browser only; SteamVR devices need its runtime and `openvr`."""
    runtime = Path.home() / ".config" / "openvr" / "openvrpaths.vrpath"
    package, has_runtime = _version("openvr"), runtime.exists()
    detail = f"openvr {package or 'not installed'}, SteamVR {'found' if has_runtime else 'not found'}"
    remedies = [] if package else [f"{sys.executable} -m pip install openvr"]
    remedies += [] if has_runtime else ["steam steam://install/250820"]
    return Finding(
        "SteamVR",
        not remedies,
        detail,
        "controllers by SteamVR (a WebXR headset needs none)",
        " && ".join(remedies),
    )


def check_gpu() -> Finding:
    if importlib.util.find_spec("torch") is None:
        return Finding("GPU", False, "torch is not installed", "training", "make studio")
    try:
        names = _python(_GPU)
    except subprocess.SubprocessError as error:
        return Finding("GPU", False, f"torch cannot be tried: {_reason(error)}", "training", "make studio")
    if names:
        return Finding("GPU", True, names, "quick training")
    driver = "" if shutil.which("nvidia-smi") else apt("nvidia-driver")
    detail = f"none that torch {_version('torch')} can use; training runs on the CPU"
    return Finding("GPU", False, detail, "quick training", driver)


def check_disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free
    return Finding("disk", free > FREE_DISK, f"{free / 1e9:.1f} GB free in {Path.cwd()}", "recording")


def check_cores() -> Finding:
    n_cores = len(os.sched_getaffinity(0))
    return Finding("cores", n_cores >= CORES, f"{n_cores} usable", "camera images beside a live session")


def check_realtime() -> Finding:
    try:
        _python(_REALTIME)
    except subprocess.SubprocessError as error:
        limit = (
            f"echo '{getpass.getuser()} - rtprio 20' | sudo tee /etc/security/limits.d/compact-studio.conf"
        )
        return Finding(
            "real time",
            False,
            _reason(error),
            "a loop that is never late beside other work (log in again)",
            limit,
        )
    return Finding("real time", True, "the loop may run before everything else", "a loop that is never late")


CHECKS: tuple[Callable[[], Finding], ...] = (
    check_python,
    check_packages,
    check_libraries,
    check_rendering,
    check_chromium,
    check_node,
    check_vr,
    check_gpu,
    check_disk,
    check_cores,
    check_realtime,
)


def apt(*packages: str) -> str:
    """The line that installs Debian packages, for this user."""
    line = f"apt-get install -y --no-install-recommends {' '.join(packages)}"
    return line if os.geteuid() == 0 else f"sudo {line}"


@functools.cache
def _rendering() -> tuple[Backend | None, str]:
    """The backend that works and its OpenGL, else why none does."""
    reasons = []
    for backend in BACKENDS:
        try:
            return backend, f"{backend}: {_python(_RENDER, MUJOCO_GL=backend)}"
        except subprocess.SubprocessError as error:
            reasons.append(f"{backend}: {_reason(error)}")
    return None, "; ".join(reasons)


def _python(program: str, **environment: str) -> str:
    """What a program prints. It runs in an empty folder: MuJoCo leaves a log file where it fails."""
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [sys.executable, "-c", program],
            cwd=folder,
            env={**os.environ, **environment},
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=True,
        )
    return done.stdout.strip()


def _reason(error: subprocess.SubprocessError) -> str:
    """The last line that a failed program wrote."""
    if isinstance(error, subprocess.CalledProcessError):
        lines = error.stderr.strip().splitlines() or [f"ended with status {error.returncode}"]
        return str(lines[-1])
    return f"no answer for {PATIENCE:.0f} s"


def _output(*command: str) -> str:
    """What a command prints; empty where it is missing or fails."""
    try:
        return subprocess.run(
            command, capture_output=True, text=True, timeout=PATIENCE, check=True
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
