"""What somebody asks for, as a job: checked before it waits in the queue, with its takes as they are now.

DATA/exports/<name>/      where an export goes that was asked for as a job
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import os
import re
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Unpack

from controller.stiffness import StiffnessTable
from policy import checkpoint
from policy.config import TrainConfig
from studio import collections, tasks, training
from studio.catalog import Catalog
from studio.evaluate import Plan
from studio.export import Format, Options, choose
from studio.index import Filters
from studio.jobs.job import LOCAL, Job, Kind, new_job_id
from studio.jobs.queue import JobNow, Jobs, check_runner
from studio.references import REFERENCES
from studio.training import TAKES, Choice, Chosen, Run

MOST_OF_A_SWEEP = 64  # jobs

_NAME = re.compile(r"[A-Za-z0-9][\w.-]{0,99}", re.ASCII)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Where:
    """Who asks, and on what it runs."""

    author: str
    runner: str = LOCAL
    processes: int = 1
    threads: int = 0  # 0: one core less than there are, which the live session may use
    sweep: str = ""
    swept: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.processes < 1 or self.threads < 0:
            raise ValueError(f"No job has {self.processes} processes of {self.threads} threads.")


@dataclasses.dataclass(frozen=True, slots=True)
class Request:
    """A job, and the files that it needs in its folder."""

    job: Job
    files: Mapping[str, bytes] = dataclasses.field(default_factory=dict)
    run: Run | None = None  # a new one, whose folder `submit` makes
    origin: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def submit(jobs: Jobs, request: Request) -> JobNow:
    """Put a job into the queue.

    Raises FileExistsError where its run is there already, ValueError where its cluster does not answer.
    """
    check_runner(request.job.runner)
    if request.run is None:
        return jobs.submit(request.job, request.files)
    folder = request.run.folder
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise FileExistsError(f"There is a run {folder.name} already; give another name.") from None
    try:
        training.lay_out(request.run, request.origin)
        return jobs.submit(request.job, request.files)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)  # made just now, by us
        raise


def train(
    catalog: Catalog,
    where: Where,
    task: str,
    config: TrainConfig,
    *,
    name: str | None = None,
    **choice: Unpack[Choice],
) -> Request:
    """Learn a new run, of the takes that match now. Raises ValueError where none does."""
    tasks.load(task)
    run = training.prepare(catalog, task, config, name=name, **choice)
    episodes, collection = choice.get("episodes"), choice.get("collection")
    asked = {"task": task, "episodes": episodes, "collection": collection, **_given(choice.get("filters"))}
    return Request(
        run=run,
        origin={"author": where.author, "sweep": where.sweep, **asked},
        job=_job(
            "train",
            where,
            title=f"Train {run.folder.name}",
            command=("train", "--resume", run.folder.name),
            subject=run.folder.name,
            gpus=where.processes if _is_gpu(config.device) else 0,
            settings={**asked, "takes": len(run.takes), "config": dataclasses.asdict(config)},
        ),
    )


def evaluate(
    catalog: Catalog,
    where: Where,
    agent: str,
    *,
    task: str | None = None,
    which: str = "last",
    seed: int = 1000,
    episodes: int = 20,
    workers: int = 1,
    **settings: Any,
) -> Request:
    """Roll out a reference, or the checkpoint `which` of a run, over seeds. `settings` as `Plan` has them."""
    folder = catalog.data_dir / "runs" / agent
    named = agent
    if _NAME.fullmatch(agent) and folder.is_dir():
        named = f"runs/{agent}" if which == "last" else f"runs/{agent}/{checkpoint.CHECKPOINTS}/{which}"
        found = catalog.data_dir / named
        if not _NAME.fullmatch(which) or not found.exists():
            raise KeyError(f"The run {agent} has no checkpoint {which!r}.")
    if workers < 1:
        raise ValueError(f"Workers must be at least 1, not {workers}.")
    plan = Plan.of(
        str(catalog.data_dir / named) if named != agent else agent,
        task,
        range(seed, seed + episodes),
        catalog.data_dir,
        **settings,
    )
    asked = {"task": plan.task, "seed": seed, "episodes": episodes, "workers": workers, **settings}
    return Request(
        _job(
            "evaluate",
            where,
            title=f"Evaluate {agent} on {plan.task}",
            command=("evaluate", named, *_flags(asked)),
            subject=agent,
            gpus=int(_is_gpu(plan.device)),
            settings={"agent": agent, "which": which, "step": plan.spec.step if plan.spec else None, **asked},
        )
    )


def sweep(
    make: Callable[[Mapping[str, Any], Where], Request], where: Where, fields: Mapping[str, Sequence[Any]]
) -> list[Request]:
    """A request for each combination of the values of some fields, named together."""
    count = math.prod(map(len, fields.values())) if fields else 0
    if not 1 <= count <= MOST_OF_A_SWEEP:
        raise ValueError(f"A sweep makes 1 to {MOST_OF_A_SWEEP} jobs, not {count}.")
    name = where.sweep or time.strftime("sweep-%Y%m%d-%H%M%S")
    found = []
    for values in itertools.product(*fields.values()):
        swept = dict(zip(fields, values, strict=True))
        found.append(make(swept, dataclasses.replace(where, sweep=name, swept=swept)))
    return found


def known_agent(data_dir: Path, name: str) -> str:
    """A reference, or a run of this data folder: what may be asked for from elsewhere. Raises KeyError."""
    runs = sorted(path.name for path in (data_dir / "runs").glob("[!.]*/"))
    if name not in runs and name not in REFERENCES:
        raise KeyError(f"No run or reference {name!r}; there are {', '.join([*runs, *sorted(REFERENCES)])}.")
    return name


def export(
    catalog: Catalog,
    where: Where,
    name: str,
    form: Format = "lerobot",
    options: Options | None = None,
    *,
    episode_ids: Sequence[str] | None = None,
    collection: str | None = None,
    filters: Filters | None = None,
) -> Request:
    """Write takes, as they are annotated now or were in a collection, to DATA/exports/<name>."""
    if not _NAME.fullmatch(name):
        raise ValueError(f"{name!r} cannot name an export; use at most 100 letters, digits, - _ .")
    out = catalog.data_dir / "exports" / name
    if out.exists() and any(out.iterdir()):
        raise FileExistsError(f"There is an export {name} already; give another name.")
    if (episode_ids is not None) + (collection is not None) + bool(_given(filters)) != 1:
        raise ValueError("Say which takes: by their ids, by a collection, or by filters.")
    members = _members(catalog, episode_ids, collection, filters)
    choose(catalog, list(members)[:1], members)  # an empty choice is refused
    options = options or Options()
    flags: dict[str, Any] = {
        "format": form,
        "rate": options.rate,
        "actions": options.control,
        "pad": options.pad,
    }
    if options.cameras == ():
        flags["images"] = False
    elif options.cameras is not None:
        flags["cameras"] = options.cameras
    job = _job(
        "export",
        where,
        title=f"Export {len(members)} take{'' if len(members) == 1 else 's'} as {form}",
        command=(),
        subject=name,
        settings={
            **{"name": name, "takes": len(members), "collection": collection, "filters": _given(filters)},
            **flags,
        },
    )
    takes = catalog.data_dir / "jobs" / job.job_id / TAKES
    command = ("export", "--takes", str(takes), "--out", str(out), *_flags(flags))
    chosen = [dataclasses.asdict(Chosen(name, None, version)) for name, version in members.items()]
    return Request(dataclasses.replace(job, command=command), {TAKES: json.dumps(chosen, indent=1).encode()})


def demo(
    catalog: Catalog,
    where: Where,
    task: str,
    *,
    episodes: int = 1,
    seed: int = 0,
    workers: int = 1,
    cameras: bool = True,
    spread: float = 1.0,
    stiffness_table: StiffnessTable = "tuned",
) -> Request:
    """Record scripted demonstrations."""
    tasks.load(task)
    if episodes < 1 or workers < 1 or seed < 0:
        raise ValueError(
            f"Episodes and workers must be at least 1, seeds 0: not {episodes}, {workers}, {seed}."
        )
    asked = {
        **{"episodes": episodes, "seed": seed, "workers": workers, "cameras": cameras, "spread": spread},
        "stiffness_table": stiffness_table,
    }
    return Request(
        _job(
            "demo",
            where,
            title=f"Record {episodes} demonstration{'' if episodes == 1 else 's'} of {task}",
            command=("demo", task, *_flags(asked)),
            subject=task,
            settings={"task": task, **asked},
        )
    )


def default_threads(processes: int) -> int:
    """Of each process: all together leave one core to the live session."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, (cores - 1) // processes)


def _is_gpu(device: str) -> bool:
    return device.startswith("cuda")


def _job(kind: Kind, where: Where, **fields: Any) -> Job:
    return Job(
        job_id=new_job_id(kind),
        kind=kind,
        author=where.author,
        created=time.time(),
        runner=where.runner,
        processes=where.processes,
        threads=where.threads or default_threads(where.processes),
        sweep=where.sweep,
        swept=dict(where.swept),
        **fields,
    )


def _members(
    catalog: Catalog, episode_ids: Sequence[str] | None, collection: str | None, filters: Filters | None
) -> dict[str, int]:
    """The edit version of each take, the oldest first or as they were named."""
    if collection is not None:
        members = collections.load(catalog.data_dir, collection).members
        return {member.episode_id: member.edit_version for member in members}
    catalog.refresh()
    rows = (
        [catalog.get(name) for name in dict.fromkeys(episode_ids)]
        if episode_ids is not None
        else catalog.episodes(sort="started", descending=False, limit=None, **(filters or {}))
    )
    return {row.episode_id: row.edit_version for row in rows}


def _given(filters: Filters | None) -> dict[str, Any]:
    return {name: value for name, value in (filters or {}).items() if value not in (None, (), [], "")}


def _flags(values: Mapping[str, Any]) -> list[str]:
    """As the command line takes them; None is left out."""
    flags: list[str] = []
    for name, value in values.items():
        dashed = name.replace("_", "-")
        if value is True or value is False:
            flags.append(f"--{dashed}" if value else f"--no-{dashed}")
        elif isinstance(value, list | tuple):
            flags += [f"--{dashed}", *map(str, value)] if value else []
        elif value is not None:
            flags += [f"--{dashed}", str(value)]
    return flags
