"""Imports go one way: web_assets <- studio -> policy -> controller, and heavy ones stand in few files."""

import ast
import graphlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parent.parent

# What each package must not import.
FORBIDDEN = {
    "controller": ("policy", "studio", "mujoco", "viser", "fastapi"),
    "policy": ("studio", "mujoco", "viser", "fastapi"),
    "studio": (),
}

# Heavy modules and borders to formats and devices, and the only places that may import them.
ONLY_IN = {
    "torch": ("policy/",),
    "mcap": ("studio/mcap_file.py", "studio/recovery.py"),
    "viser": ("studio/ui/", "studio/server.py", "studio/site.py"),
    "rerun": ("studio/export/rrd.py",),
    "openvr": ("studio/inputs/steamvr.py",),
    "ray": ("studio/jobs/cluster.py",),
    "h5py": ("studio/export/act_hdf5.py",),
    "av": ("studio/export/video.py",),
    "sqlite3": ("studio/index.py",),
    "matplotlib": ("studio/report.py",),
}

# Inside studio, lowest first: a file imports nothing of a layer above its own.
LAYERS = (
    ("channels", "schema", "edits", "index", "doctor"),
    ("episode", "episode_writer", "recovery", "tasks", "session"),
    ("twin", "cameras", "inputs", "policy_link"),
    (
        *("recorder", "catalog", "replay", "training", "runs", "jobs", "export", "pilot"),
        *("references", "evaluation", "evaluate", "report", "probes", "health", "survey", "collections"),
    ),
    ("api",),
    (
        *("server", "site", "headset", "http", "http_takes", "http_wire", "reading", "ui", "serve"),
        *("http_jobs", "http_runs", "commands", "client", "client_jobs", "__main__"),
    ),
)
SKINS = len(LAYERS) - 1

FILES = sorted(
    path.relative_to(REPOSITORY).as_posix()
    for name in FORBIDDEN
    for path in REPOSITORY.glob(f"{name}/**/*.py")
)


def imports(file: str) -> Iterator[str]:
    """Full names that a file imports, also inside functions; not those for types only."""
    tree = ast.parse((REPOSITORY / file).read_text())
    for_types = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")
        for inner in ast.walk(node)
    }
    for node in set(ast.walk(tree)) - for_types:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file} imports relatively; write the full name."
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def module_of(file: str) -> str:
    return file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def layer_of(name: str) -> int | None:
    """Of a module of studio, or of a name in it; None where LAYERS does not say."""
    package, _, rest = name.partition(".")
    part = rest.split(".")[0]
    return next((n for n, parts in enumerate(LAYERS) if package == "studio" and part in parts), None)


@pytest.mark.parametrize("file", FILES)
def test_imports_go_one_way(file: str) -> None:
    package, own = file.split("/")[0], layer_of(module_of(file))
    for name in imports(file):
        root, layer = name.split(".")[0], layer_of(name)
        assert root not in FORBIDDEN[package], f"{file} imports {name}."
        places = ONLY_IN.get(root, ("",))
        assert any(file.startswith(place) for place in places), f"{file} imports {name}; only {places} may."
        if own is not None and layer is not None:
            assert layer <= own, f"{file} imports {name}, which is built upon it."


def test_imports_make_no_circle() -> None:
    modules = {module_of(file): file for file in FILES}
    graph = {module: set() for module in modules}
    for module, file in modules.items():
        for name in imports(file):
            found = next((known for known in (name, name.rpartition(".")[0]) if known in modules), None)
            graph[module] |= {found} - {None, module}
    list(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError, naming the circle


def test_the_headless_studio_loads_neither_torch_nor_viser() -> None:
    modules = [module_of(file) for file in FILES if file.startswith("studio/")]
    headless = [module for module in modules if layer_of(module) != SKINS]
    program = f"""
import importlib, sys
for name in {headless}:
    importlib.import_module(name)
assert not {{"torch", "viser"}} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", program], cwd=REPOSITORY, check=True)
