"""The settings of training as a form: JSON schema of `TrainConfig`, with the same help as the command line.

A new field of it appears by itself: its title is its name in words, its help the text below it, its unit what
that begins with, its heading the comment above.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import textwrap
from functools import cache
from typing import Any

import msgspec

from policy.config import PRESETS, TrainConfig

MACHINE = ("device", "threads", "tensorboard")  # settings that do not change what is learned
WORDS = {  # where a part of a name is none, or says too little alone
    **{"lr": "learning rate", "ema": "averaging of weights", "cvae": "CVAE", "kl": "KL", "max": "largest"},
    **{"clip": "gradient clip", "batch": "batch size", "latent": "latent size", "seconds": "length"},
}

_UNIT = re.compile(r"\[(.+?)\] ?")


@cache
def train_form() -> dict[str, Any]:
    """`schema`: properties with default, title, description, `unit`, `flag` of the command line and `group`.

    `presets`: what each sets. `machine`: names of settings that do not change what is learned.
    """
    ((_, told),) = msgspec.json.schema_components([TrainConfig])[1].items()
    helps, groups = _texts()
    properties = {
        name: {**fields, **_words(name, helps.get(name, "")), "group": groups.get(name, "")}
        for name, fields in told["properties"].items()
    }
    presets = {name: dataclasses.asdict(preset) for name, preset in PRESETS.items()}
    return {"schema": {**told, "properties": properties}, "presets": presets, "machine": list(MACHINE)}


def _words(name: str, told: str) -> dict[str, str]:
    """How people read a field."""
    title = " ".join(WORDS.get(part, part) for part in name.split("_"))
    unit = _UNIT.match(told)
    rest = told[unit.end() :] if unit else ""
    return {
        "title": title[0].upper() + title[1:],
        "flag": f"--{name.replace('_', '-')}",
        "unit": unit[1] if unit else "",
        "description": rest[:1].upper() + rest[1:] if unit else told,
    }


def _texts() -> tuple[dict[str, str], dict[str, str]]:
    """Help and heading of each field, as they stand in the source."""
    source = textwrap.dedent(inspect.getsource(TrainConfig))
    (tree,) = ast.parse(source).body
    assert isinstance(tree, ast.ClassDef)
    lines = enumerate(source.splitlines(), 1)
    headings = {number: line.strip("# ") for number, line in lines if line.startswith("    # ")}
    helps: dict[str, str] = {}
    groups: dict[str, str] = {}
    name = ""
    for node in tree.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            name = node.target.id
            groups[name] = next((headings[n] for n in range(node.lineno, 0, -1) if n in headings), "")
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and name:
            helps[name] = inspect.cleandoc(str(node.value.value))
        else:
            name = ""
    return helps, groups
