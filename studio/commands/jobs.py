"""Commands about jobs: what runs in the background, and what becomes of it."""

from __future__ import annotations

import functools
import getpass
import inspect
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional, arg

from studio.commands import exchange, policies, recording
from studio.commands.terminal import DATA, Data, Json, console, plain, print_json, table_of
from studio.jobs.job import LOCAL, Job
from studio.jobs.plans import Request, Where
from studio.jobs.queue import JobNow, Jobs

JobId = Annotated[str, arg(metavar="ID", help="A job; see `studio jobs list`. Its first characters may do.")]


def list_jobs(trash: bool = False, data: Data = DATA, json: Json = False) -> int:
    """List the jobs, the newest first; further: studio jobs --help.

    Args:
        trash: The deleted ones instead.
    """
    jobs = _jobs(data)
    if trash:
        return _print(jobs.trash()) if json else _tell_deleted(jobs.trash())
    found = jobs.all()
    if json:
        return _print(found)
    are_here = all(now.job.runner == LOCAL for now in found)
    table = table_of("id", "state", ">done", ">left", "what", *([] if are_here else ["on"]), "by", "why")
    for now in found:
        table.add_row(
            now.job.job_id,
            now.standing.state,
            _share(now),
            "" if now.seconds_left is None else _duration(now.seconds_left),
            now.job.title,
            *([] if are_here else [now.job.runner]),
            now.job.author,
            now.standing.why,
        )
    console.print(table if found else f"No jobs in {data}. Submit one: studio jobs submit -- train wiping")
    return 0


def show(job_id: Positional[JobId], data: Data = DATA, json: Json = False) -> int:
    """Show one job: what was asked, where it stands, what came of it."""
    jobs = _jobs(data)
    now = jobs.get(_whole(jobs, job_id))
    if json:
        return _print(now)
    told = {
        "what": now.job.title,
        "command": " ".join(("studio", *now.job.command)),
        "state": f"{now.standing.state} {now.standing.why}".strip(),
        "done": _share(now),
        "asked": f"{_moment(now.job.created)} by {now.job.author}",
        "runs on": "this machine" if now.job.runner == LOCAL else now.job.runner,
        "started": _moment(now.standing.started),
        "ended": _moment(now.standing.ended),
        **{f"swept {name}": value for name, value in now.job.swept.items()},
    }
    for name, value in told.items():
        if value not in ("", None):
            console.print(f"{name:>10}  {value}", soft_wrap=True)
    for line in now.last_lines:
        console.print(f"{'':>10}  {line}", style="yellow", soft_wrap=True)
    return 0


def log(job_id: Positional[JobId], data: Data = DATA) -> int:
    """Print what a job said: its last 64 KiB."""
    jobs = _jobs(data)
    print(jobs.log(_whole(jobs, job_id), start=-1)[0], end="")
    return 0


def cancel(job_id: Positional[JobId], data: Data = DATA, json: Json = False) -> int:
    """Take a job out of the queue, or have it end; what trains saves a checkpoint first."""
    jobs = _jobs(data)
    return _tell(jobs.cancel(_whole(jobs, job_id)), json)


def resume(job_id: Positional[JobId], data: Data = DATA, json: Json = False) -> int:
    """Queue a job again that did not finish: training goes on where it was, all else begins anew."""
    jobs = _jobs(data)
    return _tell(jobs.resume(_whole(jobs, job_id)), json)


def delete(job_id: Positional[JobId], data: Data = DATA) -> int:
    """Move a job to the trash, with the run that it learned."""
    jobs = _jobs(data)
    job = jobs.delete(_whole(jobs, job_id))
    console.print(f"{job.title} is in the trash; studio jobs restore {job.job_id} brings it back.")
    return 0


def restore(job_id: Positional[JobId], data: Data = DATA, json: Json = False) -> int:
    """Bring a job back from the trash."""
    return _tell(_jobs(data).restore(job_id), json)


def slots(n: Positional[int | None] = None, data: Data = DATA, json: Json = False) -> int:
    """Show or set how many jobs run at a time on this machine.

    Args:
        n: 0 holds the queue; what runs goes on.
    """
    jobs = _jobs(data)
    if n is not None:
        jobs.slots = n
        jobs.advance()
    if json:
        return _print({"slots": jobs.slots})
    console.print(f"{jobs.slots} at a time.")
    return 0


def submit(
    command: Positional[tuple[Annotated[str, arg(metavar="COMMAND")], ...]],
    sweep: tuple[str, ...] = (),
    processes: int = 1,
    threads: int = 0,
    runner: str = LOCAL,
    data: Data = DATA,
    json: Json = False,
) -> int:
    """Queue a command: studio jobs submit [options] -- train wiping --steps 500

    Args:
        command: After `--`: train, evaluate, export or demo, with its options as they are typed otherwise.
        sweep: A job for each value, or each combination: lr=1e-4,5e-4 seed=0,1
        processes: That learn together, through torchrun.
        threads: Of the CPU for each process; 0 leaves one core to others.
        runner: Or the address of a Ray cluster that sees the data folder: http://head:8265. There a job with
            --device cuda has a GPU for each process, any other none.
    """
    from studio.api import Studio
    from studio.jobs import plans

    where = Where(author=getpass.getuser(), runner=runner, processes=processes, threads=threads)
    kind, *arguments = command or [""]
    if kind not in REQUESTS:
        raise ValueError(f"{kind!r} cannot be a job; there are {', '.join(REQUESTS)}. Write it after `--`.")
    with Studio(data) as studio:

        def make(swept: Mapping[str, Any], where: Where) -> Request:
            more = [part for name, value in swept.items() for part in (f"--{name.replace('_', '-')}", value)]
            return REQUESTS[kind](studio, where, [*arguments, *more])

        fields = dict(_field(text) for text in sweep)
        requests = plans.sweep(make, where, fields) if fields else [make({}, where)]
        found = [studio.submit(request) for request in requests]
    if json:
        return _print(found if fields else found[0])
    for now in found:
        console.print(f"{now.job.job_id}  {now.standing.state}  {now.job.title}")
    return 0


def _train(studio: Any, where: Where, arguments: Sequence[str]) -> Request:
    from studio.jobs import plans

    given = _parsed("train", policies.train_with(arguments), arguments)
    _refuse(given, resume=None)
    filters = {name: given[name] for name in ("agent", "operator", "min_quality", "flags")}
    name = given["name"]
    if where.swept and name:
        name = "-".join((name, *(f"{key}{value}" for key, value in where.swept.items())))
    elif where.swept:
        name = "-".join((where.sweep, *(f"{key}{value}" for key, value in where.swept.items())))
    return plans.train(
        studio.catalog,
        where,
        given["task"],
        given["config"],
        name=name,
        episodes=given["episodes"],
        filters=filters,  # type: ignore[arg-type]
        collection=given["collection"],
    )


def _evaluate(studio: Any, where: Where, arguments: Sequence[str]) -> Request:
    from studio.jobs import plans

    given = _parsed("evaluate", policies.evaluate, arguments)
    _refuse(given, compare=None)
    seeds = policies.seeds_of(given["seeds"], given["seed"], given["episodes"])
    if not seeds or seeds != tuple(range(seeds[0], seeds[0] + len(seeds))):
        raise ValueError(f"A job takes seeds that follow each other, like 1000:1020, not {given['seeds']!r}.")
    given |= {"seed": seeds[0], "episodes": len(seeds)}
    names = ("task", "seed", "episodes", "workers", "hide", "execution", "replan_every", "latency", "device")
    asked = {name: given[name] for name in (*names, "spread", "stiffness_table", "cameras")}
    return plans.evaluate(studio.catalog, where, given["agent"], **asked)


def _export(studio: Any, where: Where, arguments: Sequence[str]) -> Request:
    from studio.export import Options
    from studio.jobs import plans

    given = _parsed("export", exchange.export, arguments)
    _refuse(given, takes=None)
    if given["out"].name != str(given["out"]):
        raise ValueError(
            f"An export as a job goes to DATA/exports; --out {given['out'].name} names it there."
        )
    filters = {name: given[name] for name in ("task", "operator", "agent", "outcome", "min_quality", "flags")}
    return plans.export(
        studio.catalog,
        where,
        str(given["out"]),
        given["format"],
        Options(given["rate"], given["actions"], given["cameras"] if given["images"] else (), given["pad"]),
        episode_ids=given["ids"] or None,
        collection=given["collection"],
        filters=filters,  # type: ignore[arg-type]
    )


def _demo(studio: Any, where: Where, arguments: Sequence[str]) -> Request:
    from studio.jobs import plans

    given = _parsed("demo", recording.demo, arguments)
    names = ("episodes", "seed", "workers", "cameras", "spread", "stiffness_table")
    return plans.demo(studio.catalog, where, given["task"], **{name: given[name] for name in names})


REQUESTS: dict[str, Callable[[Any, Where, Sequence[str]], Request]] = {
    "train": _train,
    "evaluate": _evaluate,
    "export": _export,
    "demo": _demo,
}


def _parsed(name: str, command: Callable[..., int], arguments: Sequence[str]) -> dict[str, Any]:
    """What a command would be called with."""
    signature = inspect.signature(command)

    @functools.wraps(command)
    def called(*given: Any, **named: Any) -> dict[str, Any]:
        bound = signature.bind(*given, **named)
        bound.apply_defaults()
        return bound.arguments

    return tyro.cli(called, prog=f"studio {name}", args=list(arguments))


def _refuse(given: Mapping[str, Any], **usual: Any) -> None:
    for name, value in usual.items():
        if given[name] != value:
            raise ValueError(f"A job takes no --{name.replace('_', '-')}.")


def _field(text: str) -> tuple[str, list[str]]:
    name, separator, values = text.partition("=")
    if not separator or not name or not all(values.split(",")):
        raise ValueError(f"A sweep is told like lr=1e-4,5e-4, not {text!r}.")
    return name, values.split(",")


def _jobs(data: Path) -> Jobs:
    """Whoever looks carries the queue on."""
    jobs = Jobs(data)
    jobs.advance()
    return jobs


def _whole(jobs: Jobs, start: str) -> str:
    found = [now.job.job_id for now in jobs.all() if now.job.job_id.startswith(start)]
    if len(found) > 1:
        raise KeyError(f"{start!r} may be {', '.join(found)}.")
    return found[0] if found else start


def _tell(now: JobNow, json: bool) -> int:
    if json:
        return _print(now)
    console.print(f"{now.job.title}: {now.standing.state}")
    return 0


def _tell_deleted(found: list[Job]) -> int:
    table = table_of("id", "what", "asked", "by")
    for job in found:
        table.add_row(job.job_id, job.title, _moment(job.created), job.author)
    console.print(table if found else "No jobs in the trash.")
    return 0


def _print(value: Any) -> int:
    print_json(plain(value))
    return 0


def _share(now: JobNow) -> str:
    told = now.progress
    return "" if told is None or not told.total else f"{told.done:g}/{told.total:g}"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}" if minutes >= 60 else f"{minutes}:{rest:02d}"


def _moment(time: float | None) -> str:
    return "" if time is None else datetime.fromtimestamp(time).strftime("%d %b %Y %H:%M:%S")
