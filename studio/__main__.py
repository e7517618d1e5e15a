"""The command line: `studio …`. Each command is a thin skin of `studio.api`.

Exit status: 0 done, 1 a check or a task failed, 2 wrong use. With `--json` the last output is one JSON value.
"""

from __future__ import annotations

import functools
import itertools
import sys
from collections.abc import Callable, Sequence

import tyro

from policy.config import PRESETS
from studio.commands import dataset, exchange, machine, policies, recording, serving, takes
from studio.commands.terminal import complain

COMMANDS: dict[str, Callable[..., int]] = {
    "serve": serving.serve,
    "cert": serving.make_certificate,
    "tasks": recording.show_tasks,
    "doctor": machine.doctor,
    "demo": recording.demo,
    "train": policies.train,
    "evaluate": policies.evaluate,
    "references": policies.show_references,
    "report": policies.report,
    "probe": policies.probe,
    "policy-server": policies.policy_server,
    "episodes": takes.episodes,
    "show": takes.show,
    "annotate": takes.annotate,
    "delete": takes.delete,
    "restore": takes.restore,
    "recover": takes.recover,
    "replay": takes.replay,
    "health": dataset.health,
    "export": exchange.export,
    "import": exchange.import_takes,
    "collections": dataset.show_collections,
    "collection": dataset.collection,
    "steamvr": serving.steamvr,
    "bench": machine.bench,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit."""
    status: int = 2
    try:
        commands = COMMANDS | {"train": _train_with(sys.argv[1:] if arguments is None else arguments)}
        status = tyro.extras.subcommand_cli_from_dict(commands, prog="studio", args=arguments)
    except KeyboardInterrupt:
        complain("Interrupted.")
        status = 130
    except (KeyError, ValueError) as error:
        complain(error.args[0] if error.args else repr(error))
    except (OSError, RuntimeError) as error:
        complain(str(error))
        status = 1
    sys.exit(status)


def _train_with(arguments: Sequence[str]) -> Callable[..., int]:
    """`train` with the settings of the preset that is asked for as its defaults, which `--help` shows."""
    asked = [value for name, value in itertools.pairwise(arguments) if name == "--preset"]
    asked += [name.partition("=")[2] for name in arguments if name.startswith("--preset=")]
    chosen = next((config for preset, config in PRESETS.items() if preset in asked), PRESETS["small"])
    return functools.partial(policies.train, config=chosen)


if __name__ == "__main__":
    main()
