"""The command line: `studio …`. Each command is a thin skin of `studio.api`.

Exit status: 0 done, 1 a check or a task failed, 2 wrong use. With `--json` the last output is one JSON value.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

import tyro

from studio.commands import dataset, exchange, jobs, machine, policies, recording, serving, takes
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
    "jobs": jobs.list_jobs,
    "steamvr": serving.steamvr,
    "bench": machine.bench,
}


JOBS: dict[str, Callable[..., int]] = {
    "list": jobs.list_jobs,
    "show": jobs.show,
    "log": jobs.log,
    "submit": jobs.submit,
    "cancel": jobs.cancel,
    "resume": jobs.resume,
    "delete": jobs.delete,
    "restore": jobs.restore,
    "slots": jobs.slots,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit."""
    status: int = 2
    try:
        given = sys.argv[1:] if arguments is None else list(arguments)
        commands, program = COMMANDS | {"train": policies.train_with(given)}, "studio"
        verb = given[1] if given[:1] == ["jobs"] and len(given) > 1 else "--"
        if not verb.startswith("--") or verb == "--help":
            commands, program, given = JOBS, "studio jobs", given[1:]
        status = tyro.extras.subcommand_cli_from_dict(commands, prog=program, args=given)
    except KeyboardInterrupt:
        complain("Interrupted.")
        status = 130
    except (KeyError, ValueError) as error:
        complain(error.args[0] if error.args else repr(error))
    except (OSError, RuntimeError) as error:
        complain(str(error))
        status = 1
    sys.exit(status)


if __name__ == "__main__":
    main()
