"""Commands that train, evaluate and compare."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from controller.stiffness import StiffnessTable
from policy.config import PRESETS, TrainConfig
from studio.commands.terminal import (
    DATA,
    Data,
    Json,
    ProgressPath,
    TaskName,
    console,
    ends_orderly,
    errors,
    plain,
    print_json,
    progress,
    say,
    table_of,
)
from studio.index import Filters
from studio.jobs.progress import ProgressFile

if TYPE_CHECKING:
    from studio.api import Studio
    from studio.evaluate import Plan
    from studio.training import Run


def train(
    task: Positional[Annotated[str, arg(metavar="TASK")]] = "",
    config: OmitArgPrefixes[TrainConfig] = PRESETS["small"],
    name: str | None = None,
    resume: str | None = None,
    episodes: int | None = None,
    agent: str | None = None,
    operator: str | None = None,
    min_quality: int | None = None,
    flags: tuple[str, ...] = (),
    collection: str | None = None,
    data: Data = DATA,
    progress_file: ProgressPath = None,
    json: Json = False,
) -> int:
    """Learn a policy from the successful demonstrations of a task. Stopped, it can go on.

    Args:
        task: What was demonstrated; see `studio tasks`.
        name: Of the run; task, policy and time if not given.
        resume: A run to go on with, instead of a task and settings.
        episodes: Learn from the first so many demonstrations that match.
        agent: Only from what this agent demonstrated.
        operator: Only from what this person demonstrated.
        flags: All of these must be set.
        collection: Exactly these takes, as they were annotated when it was made; see `studio collection`.
    """
    from studio.api import Studio

    if bool(task) == bool(resume):
        raise ValueError("Give a task to begin a run, or --resume RUN to go on with one.")
    chosen = any(x is not None for x in (name, episodes, agent, operator, min_quality, collection)) or flags
    if resume and (chosen or config != PRESETS[config.preset]):
        raise ValueError(
            "A run goes on with the settings and takes that it was begun with; leave out all others."
        )
    with Studio(data) as studio:
        filters: Filters = {"agent": agent, "operator": operator, "min_quality": min_quality, "flags": flags}
        run = (
            studio.run(resume)
            if resume
            else studio.begin_run(task, config, name, episodes, filters, collection)
        )
        return _learn(studio, run, progress_file, json)


def _learn(studio: Studio, run: Run, progress_file: Path | None, json: bool) -> int:
    """Let a run learn, and tell how it goes. Of several processes only the leading one tells."""
    from studio.training import leads

    quiet = json or not leads()
    if run.rollouts and not quiet:
        told = f"{len(run.rollouts)} of {len(run.takes)} takes are no demonstrations: a policy drove."
        errors.print(told, style="yellow")
    total = run.config.steps - run.done
    file = ProgressFile(progress_file if leads() else None, run.config.steps, run.done)
    what = f"{run.folder.name}, {len(run.takes)} takes"
    with progress(what, total, quiet=quiet) as advance, ends_orderly():  # while it reads takes, too

        def tell(metrics: Mapping[str, float]) -> None:
            advance()
            file.tell(metrics["step"])
            if "validation" in metrics and not quiet:
                errors.print(_training_line(metrics))

        def read(name: str) -> None:
            file.tell(run.done, f"reads {name}")

        result = studio.train(run, on_take=read, on_step=tell)
    file.end(plain(result))
    if json and leads():
        print_json(result)
    elif leads():
        end = (
            "Finished" if result.is_finished else f"Stopped; studio train --resume {run.folder.name} goes on"
        )
        console.print(f"{end}: step {result.step} of {run.config.steps}, {run.folder}", soft_wrap=True)
    return 0


def train_with(arguments: Sequence[str]) -> Callable[..., int]:
    """`train` with the settings of the preset that is asked for as its defaults, which `--help` shows."""
    asked = [value for name, value in itertools.pairwise(arguments) if name == "--preset"]
    asked += [name.partition("=")[2] for name in arguments if name.startswith("--preset=")]
    chosen = next((config for preset, config in PRESETS.items() if preset in asked), PRESETS["small"])
    return functools.partial(train, config=chosen)


def _training_line(metrics: Mapping[str, float]) -> str:
    """Losses, and mean errors of a chunk on the demonstrations kept aside."""
    told = [f"step {metrics['step']}", f"loss {metrics['loss']:.3f}"]
    units = {"position_mm": "mm", "rotation_deg": "°", "joints_deg": "°", "stiffness_N_per_m": "N/m"}
    told.append(f"on others {metrics['validation']:.3f}")
    told += [f"{metrics[name]:.1f} {unit}" for name, unit in units.items() if name in metrics]
    return ", ".join(told)


def evaluate(
    agent: Positional[Annotated[str, arg(metavar="AGENT")]],
    task: str | None = None,
    episodes: int = 20,
    seed: int = 1000,
    seeds: str | None = None,
    hide: tuple[Literal["images", "objects", "wrench"], ...] = (),
    execution: Literal["replan", "ensemble"] = "replan",
    replan_every: int | None = None,
    latency: float = 0.02,
    device: str = "cpu",
    compare: str | None = None,
    data: Data = DATA,
    workers: int = 1,
    cameras: bool = False,
    spread: float = 1.0,
    stiffness_table: StiffnessTable | None = None,
    progress_file: ProgressPath = None,
    json: Json = False,
) -> int:
    """Roll out an agent over many seeds; every rollout is an episode.

    Args:
        agent: A run, the folder of a run or checkpoint, ws://HOST:PORT of a policy server, or a reference:
            demonstrator, nothing, average, replay, all-low, all-high, off-compliant, off-joint.
        task: What it does; a policy knows its own.
        episodes: How many; their seeds are seed, seed + 1, …
        seed: Of the first episode.
        seeds: Instead of these two, e.g. 1000:1020 (the last excluded) or 3,5,8.
        hide: From a policy: its images or wrenches (their training mean instead), or in the images the marks
            and objects that no hand holds at the start.
        execution: Play each chunk until the next, or the average of all.
        replan_every: Steps of a chunk between two questions; 10, or 1 for ensemble.
        latency: Seconds between question and answer, in simulated time.
        device: Of the policy: cpu or cuda.
        compare: An evaluation, or an agent whose newest one is meant, on the same scenes.
        workers: Processes that roll out side by side.
        cameras: Record images although the agent needs none.
        spread: Above 1 widens the task's randomisation.
        stiffness_table: What low, medium and high mean to a reference; a policy has what it learned with.
    """
    from studio.evaluate import Plan

    plan = Plan.of(
        agent,
        task,
        seeds_of(seeds, seed, episodes),
        data,
        hide=hide,
        execution=execution,
        replan_every=replan_every,
        latency=latency,
        device=device,
        spread=spread,
        stiffness_table=stiffness_table,
        cameras=cameras,
    )
    return _roll_out(plan, compare, data, workers, progress_file, json)


def _roll_out(
    plan: Plan, other: str | None, data: Path, workers: int, progress_file: Path | None, json: bool
) -> int:
    """Evaluate a plan, compare it with the evaluation named `other`, and print both."""
    from studio.api import Studio
    from studio.evaluation import Rollout, check_same_scenes, compare

    with Studio(data) as studio:
        found_before = studio.evaluation(other, plan.task) if other else None
        if found_before:  # not only after an hour
            check_same_scenes(plan.run, plan.task, plan.spread, plan.seeds, found_before)
        file = ProgressFile(progress_file, len(plan.seeds))
        with progress(f"{plan.run} on {plan.task}", len(plan.seeds), quiet=json) as advance, ends_orderly():

            def tell(rollout: Rollout) -> None:
                advance()
                file.add(plain(rollout))

            found = studio.evaluate(plan, workers=workers, on_rollout=tell)
        file.end(found.summary())
    comparison = compare(found, found_before) if found_before else None
    if json:
        paired = {"comparison": dataclasses.asdict(comparison)} if comparison else {}
        print_json(found.summary() | paired)
    else:
        console.print(str(found))
        for rollout in found.rollouts:
            if rollout.error is not None:
                console.print(f"  error: seed {rollout.seed}: {rollout.error}", style="yellow")
        if comparison:
            console.print(str(comparison))
    return int(any(rollout.error is not None for rollout in found.rollouts))


def show_references(
    named: Positional[Annotated[tuple[str, ...], arg(metavar="TASK")]] = (),
    episodes: int = 20,
    seed: int = 3000,
    data: Data = DATA,
    workers: int = 1,
    json: Json = False,
) -> int:
    """Evaluate every reference on some tasks, or on all: what a policy has to be measured against.

    Args:
        named: The tasks.
        episodes: How many of each; their seeds are seed, seed + 1, …
        seed: Of the first episode.
        workers: Processes that roll out side by side.
    """
    from studio import report as reports
    from studio import tasks
    from studio.api import Studio
    from studio.evaluate import Plan
    from studio.references import REFERENCES

    seeds = tuple(range(seed, seed + episodes))
    plans = [
        Plan(agent=agent, task=task, seeds=seeds) for task in named or tasks.names() for agent in REFERENCES
    ]
    with Studio(data) as studio, progress("references", len(plans) * episodes, quiet=json) as advance:
        found = [
            studio.evaluate(plan, workers=workers, on_rollout=lambda rollout: advance()) for plan in plans
        ]
    print_json([one.summary() for one in found]) if json else print(reports.table(found))
    return int(any(one.summary()["errors"] for one in found))


def report(
    agents: Positional[Annotated[tuple[str, ...], arg(metavar="RUN")]],
    task: str | None = None,
    out: Path = Path("report"),
    data: Data = DATA,
    json: Json = False,
) -> int:
    """Draw evaluations side by side: force, stiffness and drawings as figures, and a table.

    Args:
        agents: Evaluations by id or path, or runs and references whose newest one is meant.
        task: Where an agent was evaluated on several.
        out: Folder for figures and table.
    """
    from studio import report as reports
    from studio.api import Studio

    with Studio(data) as studio:
        evaluations = [studio.evaluation(name, task) for name in agents]
        written = reports.write(evaluations, studio.open, out)
    if json:
        print_json({"files": written, "evaluations": [found.summary() for found in evaluations]})
    else:
        print(reports.table(evaluations))
        for sentence in reports.pairs(evaluations):
            console.print(sentence)
        console.print(f"Written to {out}: {', '.join(path.name for path in written)}", soft_wrap=True)
    return 0


def probe(task: Positional[TaskName], episodes: int = 200, seed: int = 0, json: Json = False) -> int:
    """Show what images and forces tell of how a part lies in the hand, over many scenes.

    Args:
        episodes: How many scenes.
        seed: Of the first.
    """
    from studio import probes

    with progress(f"probe of {task}", episodes, quiet=json) as advance:
        found = probes.probe(task, range(seed, seed + episodes), on_seed=advance)
    if json:
        print_json(found)
        return 0
    table = table_of("part", ">offset mm", ">R² forces", ">R² images", "R² of each camera")
    for told in found:
        each = ", ".join(f"{camera} {r2:.2f}" for camera, r2 in told.from_each_camera.items())
        forces, images = f"{told.from_forces:.2f}", f"{told.from_images:.2f}"
        table.add_row(told.part, f"{told.spread_mm:.1f}", forces, images, each)
    console.print(table)
    return 0


def policy_server(
    agent: Positional[Annotated[str, arg(metavar="RUN")]],
    host: str = "127.0.0.1",
    port: int = 0,
    hide: tuple[Literal["images", "wrench"], ...] = (),
    device: str = "cpu",
    once: bool = False,
    data: Data = DATA,
) -> int:
    """Let other processes ask a policy, until Ctrl-C.

    They need the token: what $STUDIO_POLICY_TOKEN holds, or the one that is told.

    Args:
        agent: A run, or the folder of a run or checkpoint.
        host: Where to listen; only this machine by default.
        port: 0 takes a free one.
        hide: Replace images or wrenches by their training mean.
        device: cpu or cuda.
        once: End when the first client has left.
    """
    from studio import policy_link
    from studio.pilot import folder_of

    policy_link.serve_policy(
        folder_of(agent, data), host, port, hide=hide, device=device, once=once, tell=say
    )
    return 0


def seeds_of(text: str | None, first: int, count: int) -> tuple[int, ...]:
    """From 1000:1020 or 3,5,8; else `count` seeds from `first` on."""
    try:
        if text is None:
            return tuple(range(first, first + count))
        if ":" in text:
            return tuple(range(*map(int, text.split(":", 1))))
        return tuple(map(int, text.split(",")))
    except ValueError:
        raise ValueError(f"Seeds are told like 1000:1020 or 3,5,8, not {text!r}.") from None
