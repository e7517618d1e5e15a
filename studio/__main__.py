"""The command line: `studio …`. Each command is a thin skin of `studio.api`.

Exit status: 0 done, 1 a check or a task failed, 2 wrong use. With `--json` the last output is one JSON value.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional, arg

from policy.config import PRESETS, TrainConfig
from studio.index import Filters

Data = Annotated[Path, arg(metavar="DIR", help="The data folder.")]
Json = Annotated[bool, arg(name="json", help="Print one JSON value instead of text.")]
EpisodeId = Annotated[str, arg(metavar="ID", help="An episode; see `studio episodes`.")]
TaskName = Annotated[str, arg(metavar="TASK", help="A task; see `studio tasks`.")]

DATA = Path("data")
UNLIMITED = 10_000  # [columns] where nobody sees the edge of a terminal: one row, one line
console = Console(width=None if sys.stdout.isatty() else UNLIMITED, markup=False)
errors = Console(stderr=True, markup=False)


def show_tasks(pictures: Path | None = None, json: Json = False) -> int:
    """List the tasks.

    Args:
        pictures: Also write what each task's cameras see during a demonstration to this folder.
    """
    from studio import tasks

    if pictures:
        from studio.pictures import write_picture

        for name in tasks.names():
            write_picture(name, pictures / f"{name}.jpg")
    found = [tasks.load(name) for name in tasks.names()]
    if json:
        _print_json(
            [
                {
                    "task": task.name,
                    "instruction": task.instruction,
                    "arms": {arm.name: [mode.value for mode in arm.modes] for arm in task.arms},
                    "cameras": [view.name for view in task.cameras],
                    "time_limit_s": task.time_limit,
                }
                for task in found
            ]
        )
        return 0
    table = _table("task", "arms", "stiffness", "cameras", "instruction")
    for task in found:
        modes = ", ".join(
            f"{arm.name[0].upper()} {'/'.join(m.value for m in arm.modes)}" for arm in task.arms
        )
        cameras = ", ".join(view.name for view in task.cameras)
        table.add_row(task.name, str(len(task.arms)), modes, cameras, task.instruction)
    console.print(table)
    return 0


def doctor(json: Json = False) -> int:
    """Say what is missing on this machine, and what installs it."""
    from studio.doctor import as_json, as_text, diagnose

    findings = diagnose()
    print(as_json(findings) if json else as_text(findings))
    return 0


def demo(
    task: Positional[TaskName],
    episodes: int = 1,
    seed: int = 0,
    data: Data = DATA,
    workers: int = 1,
    cameras: bool = True,
    spread: float = 1.0,
    stiffness_table: Literal["tuned", "literal"] = "tuned",
    json: Json = False,
) -> int:
    """Record scripted demonstrations, headless.

    Args:
        episodes: How many; their seeds are seed, seed + 1, …
        seed: Of the first episode.
        workers: Processes that record side by side.
        cameras: Record images, too.
        spread: Above 1 widens the task's randomisation.
        stiffness_table: What low, medium and high mean: our values, or the paper's numbers on all diagonals.
    """
    from studio.api import Studio

    with Studio(data) as studio, _progress(f"{task}", episodes, quiet=json) as advance:
        report = studio.demo(
            task,
            episodes,
            seed,
            cameras=cameras,
            workers=workers,
            spread=spread,
            stiffness_table=stiffness_table,
            on_take=lambda take: advance(),
        )
    if json:
        _print_json(dataclasses.asdict(report))
    else:
        console.print(
            f"{report.successes} of {report.episodes} succeeded, contact force {report.mean_force_N:.1f} N "
            f"on average and {report.max_force_N:.1f} N at most, in {data}."
        )
        for failure in report.failures:
            console.print(f"  no success: {failure['id']} (seed {failure['seed']}, {failure['phase']})")
        for problem in (*report.errors, *([report.images] if report.images not in ("yes", "no") else [])):
            console.print(f"  {problem}", style="yellow")
    return int(bool(report.errors))


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
    data: Data = DATA,
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
    """
    from studio import training
    from studio.api import Studio

    if bool(task) == bool(resume):
        raise ValueError("Give a task to begin a run, or --resume RUN to go on with one.")
    if resume and config != PRESETS[config.preset]:
        raise ValueError("A run goes on with the settings that it was begun with; leave out all others.")
    quiet = json or not training.leads()
    with Studio(data) as studio:
        filters: Filters = {"agent": agent, "operator": operator, "min_quality": min_quality, "flags": flags}
        run = studio.run(resume) if resume else studio.begin_run(task, config, name, episodes, filters)
        total = run.config.steps - run.done
        with _progress(f"{run.folder.name}, {len(run.takes)} takes", total, quiet=quiet) as advance:

            def tell(metrics: Mapping[str, float]) -> None:
                advance()
                if "validation" in metrics and not quiet:
                    errors.print(_training_line(metrics))

            result = studio.train(run, on_step=tell)
    if json and training.leads():
        _print_json(result)
    elif training.leads():
        end = (
            "Finished" if result.is_finished else f"Stopped; studio train --resume {run.folder.name} goes on"
        )
        console.print(f"{end}: step {result.step} of {run.config.steps}, {run.folder}", soft_wrap=True)
    return 0


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
    """
    from studio.api import Studio
    from studio.evaluate import Plan
    from studio.evaluation import compare as compared

    plan = Plan.of(
        agent,
        task,
        _seeds(seeds, seed, episodes),
        data,
        hide=hide,
        execution=execution,
        replan_every=replan_every,
        latency=latency,
        device=device,
        spread=spread,
        cameras=cameras,
    )
    with Studio(data) as studio:
        other = studio.evaluation(compare, plan.task) if compare else None
        with _progress(f"{plan.run} on {plan.task}", len(plan.seeds), quiet=json) as advance:
            found = studio.evaluate(plan, workers=workers, on_rollout=lambda rollout: advance())
    comparison = compared(found, other) if other else None
    if json:
        paired = {"comparison": dataclasses.asdict(comparison)} if comparison else {}
        _print_json(found.summary() | paired)
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
    with Studio(data) as studio, _progress("references", len(plans) * episodes, quiet=json) as advance:
        found = [
            studio.evaluate(plan, workers=workers, on_rollout=lambda rollout: advance()) for plan in plans
        ]
    _print_json([one.summary() for one in found]) if json else print(reports.table(found))
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
        _print_json({"files": written, "evaluations": [found.summary() for found in evaluations]})
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

    with _progress(f"probe of {task}", episodes, quiet=json) as advance:
        found = probes.probe(task, range(seed, seed + episodes), on_seed=advance)
    if json:
        _print_json(found)
        return 0
    table = _table("part", ">offset mm", ">R² forces", ">R² images", "R² of each camera")
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
        folder_of(agent, data), host, port, hide=hide, device=device, once=once, tell=_say
    )
    return 0


def _seeds(text: str | None, first: int, count: int) -> tuple[int, ...]:
    """From 1000:1020 or 3,5,8; else `count` seeds from `first` on."""
    try:
        if text is None:
            return tuple(range(first, first + count))
        if ":" in text:
            return tuple(range(*map(int, text.split(":", 1))))
        return tuple(map(int, text.split(",")))
    except ValueError:
        raise ValueError(f"Seeds are told like 1000:1020 or 3,5,8, not {text!r}.") from None


def episodes(
    task: str | None = None,
    operator: str | None = None,
    agent: str | None = None,
    outcome: Literal["success", "failure", "unmarked"] | None = None,
    min_quality: int | None = None,
    flags: tuple[str, ...] = (),
    seed: int | None = None,
    text: str | None = None,
    trash: bool = False,
    data: Data = DATA,
    json: Json = False,
) -> int:
    """List episodes, newest first.

    Args:
        text: Words in id, note, instruction or people.
        flags: All of these must be set.
        trash: List deleted episodes instead.
    """
    from studio.api import Studio

    with Studio(data) as studio:
        if trash:
            studio.catalog.refresh()
            rows = studio.catalog.trash()
        else:
            rows = studio.episodes(
                task=task,
                operator=operator,
                agent=agent,
                outcome=outcome,
                min_quality=min_quality,
                flags=flags or None,
                seed=seed,
                text=text,
            )
        unreadable = studio.catalog.unreadable()
    if json:
        _print_json(rows)
        return 0
    table = _table("id", "outcome", ">s", ">N", ">peak", "rated", "flags")
    for row in rows:
        table.add_row(
            row.episode_id,
            row.outcome,
            f"{row.duration:.1f}",
            f"{row.mean_force:.1f}",
            f"{row.peak_force:.1f}",
            "" if row.quality is None else f"{row.quality}/5",
            ", ".join(row.flags),
        )
    console.print(table if rows else f"No episodes in {data}. Record some: studio demo wiping --episodes 3")
    for path, why in unreadable.items():
        console.print(f"Unreadable: {path.name}: {why}", style="yellow")
    return 0


def show(episode_id: Positional[EpisodeId], data: Data = DATA, json: Json = False) -> int:
    """Show everything that is known of one episode."""
    from studio import edits
    from studio.api import Studio

    with Studio(data) as studio:
        row = studio.catalog.get(episode_id)
        said = edits.read(edits.edits_path(row.path))
        with studio.open(episode_id) as episode:
            facts = {
                **dataclasses.asdict(row),
                "segments": [dataclasses.asdict(segment) for segment in said.segments],
                "header": {
                    field.name: getattr(episode.header, field.name)
                    for field in dataclasses.fields(episode.header)
                },
                "reason": episode.outcome.reason,
                "events": [dataclasses.asdict(event) for event in episode.events()],
                "ticks_with_limits": len(episode.limits()),
                "images": {camera: len(episode.image_times(camera)) for camera in episode.cameras},
            }
    if json:
        _print_json(facts)
    else:
        console.print_json(_encode(facts))
    return 0


def annotate(
    episode_id: Positional[EpisodeId],
    outcome: Literal["success", "failure", "unmarked"] | None = None,
    quality: int | None = None,
    note: str | None = None,
    add_flags: tuple[str, ...] = (),
    remove_flags: tuple[str, ...] = (),
    trim: tuple[float, float] | None = None,
    author: str | None = None,
    data: Data = DATA,
    json: Json = False,
) -> int:
    """Say something about an episode; what was said before is kept.

    Args:
        quality: 1 poor .. 5 excellent.
        trim: In and out point in seconds; the recording is not cut.
        author: Who says so; your user name if not given.
    """
    from studio.api import Studio

    changes: dict[str, Any] = {"outcome": outcome, "quality": quality, "note": note, "trim": trim}
    changes |= {"add_flags": add_flags, "remove_flags": remove_flags}
    with Studio(data) as studio:
        row = studio.annotate(
            episode_id, author=author, **{name: v for name, v in changes.items() if v not in (None, ())}
        )
    _print_json(row) if json else console.print(f"{row.episode_id}: {row.outcome}, quality {row.quality}")
    return 0


def delete(episode_id: Positional[EpisodeId], data: Data = DATA) -> int:
    """Move an episode to the trash; `studio restore` brings it back."""
    from studio.api import Studio

    with Studio(data) as studio:
        studio.delete(episode_id)
    console.print(f"{episode_id} is in the trash; `studio restore {episode_id}` brings it back.")
    return 0


def restore(episode_id: Positional[EpisodeId], data: Data = DATA) -> int:
    """Bring an episode back from the trash."""
    from studio.api import Studio

    with Studio(data) as studio:
        row = studio.restore(episode_id)
    console.print(f"{episode_id} is back at {row.path}.", soft_wrap=True)
    return 0


def recover(data: Data = DATA, json: Json = False) -> int:
    """Finish recordings that a crash cut off; those still being recorded are left alone."""
    from studio.api import Studio

    with Studio(data) as studio:
        found = studio.recover()
    if json:
        _print_json(found)
    else:
        for recovery in found:
            console.print(recovery.what)
        if not found:
            console.print("Nothing to recover.")
    return int(any(recovery.state == "failed" for recovery in found))


def replay(
    episode_id: Positional[EpisodeId], check: bool = False, data: Data = DATA, json: Json = False
) -> int:
    """Simulate an episode again from its requested actions and compare every tick.

    Args:
        check: Exit with 1 where a state or an applied action differs, unless the take was recorded with
            another version or on another machine.
    """
    from studio.api import Studio

    with Studio(data) as studio:
        result = studio.replay(episode_id)
    if json:
        _print_json({**dataclasses.asdict(result), "is_exact": result.is_exact})
    else:
        console.print(str(result), soft_wrap=True)
    return int(check and not result.is_exact and not result.other_versions)


def serve(
    data: Data = DATA,
    host: str = "127.0.0.1",
    port: int = 8080,
    task: str = "wiping",
    cameras: bool = True,
    stiffness_table: Literal["tuned", "literal"] = "tuned",
    cert: Path | None = None,
    key: Path | None = None,
    tls: bool = True,
    new_token: bool = False,
    open: bool = False,
) -> int:
    """Serve the page: drive, record and review in the browser, until Ctrl-C.

    Args:
        host: Where to listen; only this machine by default. Elsewhere a token is needed, and TLS is spoken.
        port: 0 takes a free one.
        task: What is on the stage first.
        cameras: Render images.
        stiffness_table: What low, medium and high mean: our values, or the paper's numbers on all diagonals.
        cert: A certificate that browsers trust, instead of this installation's own; see `studio cert`.
        key: Its key.
        tls: Encrypt what goes to other machines; only a proxy that does so itself makes this needless.
        new_token: Shut out everybody who came in by the link so far.
        open: Open the page in this machine's browser.
    """
    from studio import serve as server
    from studio.cert import Certificate, read

    if (cert is None) != (key is None):
        raise ValueError("--cert and --key belong together; give both or none.")
    certificate = Certificate(cert, key) if cert and key else None
    if certificate:
        read(certificate)  # refuses what is none
    server.serve(
        data,
        host,
        port,
        task,
        cameras=cameras,
        stiffness_table=stiffness_table,
        certificate=certificate,
        tls=tls,
        new_token=new_token,
        open_page=open,
        tell=_say,
    )
    return 0


def make_certificate(names: tuple[str, ...] = (), json: Json = False) -> int:
    """Make a new certificate of this installation, for the pages that other machines open.

    Args:
        names: Further host names and addresses of this machine, e.g. of a DNS server.
    """
    from studio import cert, invitation

    certificate = cert.make(invitation.folder(), (*names, *cert.names_of_this_machine()))
    facts = cert.read(certificate)
    if json:
        _print_json({**dataclasses.asdict(facts), "cert": certificate.path, "key": certificate.key})
        return 0
    console.print(f"{certificate.path}, with a key that only you can read, until {facts.expires:%d %b %Y}.")
    console.print(
        f"For {', '.join(facts.names)}. Browsers warn once; its SHA-256 fingerprint is", soft_wrap=True
    )
    console.print(f"  {facts.fingerprint}", soft_wrap=True)
    return 0


def steamvr(
    data: Data = DATA,
    scale: float = 1.0,
    view: float | None = None,
    grip_as_clutch: bool = False,
    one_arm: Literal["left", "right"] = "right",
    dead_band: float = 3.0,
    full: float = 50.0,
    strength: float = 1.0,
    countdown: float = 3.0,
    operator: str = "",
) -> int:
    """Drive the running session of a data folder with Vive wands through SteamVR, until Ctrl-C.

    Args:
        scale: An arm's way to the hand's; rotations are never scaled.
        view: Degrees by which you stand turned from the robot: 0 behind it, 90 on its right, 180 facing it;
            by default behind two arms and to the right of one.
        grip_as_clutch: An arm follows while the grip is held; the menu button switches stiffness.
        one_arm: The hand that leads where there is one arm.
        dead_band: Contact force in newtons from which on it vibrates.
        full: Contact force in newtons at which it vibrates fully.
        strength: Of the vibration, 0 to 1.
        countdown: Seconds before recording.
        operator: Your name, kept with each take.
    """
    from studio.inputs.controllers import GRIP_AS_CLUTCH, PAPER, Settings
    from studio.inputs.haptics import Haptics
    from studio.inputs.steamvr import drive
    from studio.link import socket_path

    settings = Settings(
        mapping=GRIP_AS_CLUTCH if grip_as_clutch else PAPER,
        haptics=Haptics(dead_band, full, strength),
        scale=scale,
        view=None if view is None else math.radians(view),
        one_arm=one_arm,
        countdown=countdown,
        operator=operator,
    )
    drive(socket_path(data), settings, tell=_say)
    return 0


def bench(only: tuple[str, ...] = (), json: Json = False) -> int:
    """Measure speed and contact on this machine: medians, with the load average beside them.

    Args:
        only: Run only these parts.
    """
    from studio.benchmarks import PARTS, run

    results = run(only, tell=None if json else lambda name: console.print(f"… {name}", style="dim"))
    if json:
        _print_json(results)
        return 0
    table = _table("part", "what", ">measured", "goal", "met")
    for goal in results["goals"]:
        verdict = "yes" if goal["met"] else "NO"
        table.add_row(goal["part"], goal["what"], f"{goal['measured']:.3g}", goal["goal"], verdict)
    console.print(table)
    loads = ", ".join(f"{part} {results[part]['load_average']:.1f}" for part in PARTS if part in results)
    console.print(f"Load average: {loads}. Everything measured: studio bench --json")
    return 0


COMMANDS: dict[str, Callable[..., int]] = {
    "serve": serve,
    "cert": make_certificate,
    "tasks": show_tasks,
    "doctor": doctor,
    "demo": demo,
    "train": train,
    "evaluate": evaluate,
    "references": show_references,
    "report": report,
    "probe": probe,
    "policy-server": policy_server,
    "episodes": episodes,
    "show": show,
    "annotate": annotate,
    "delete": delete,
    "restore": restore,
    "recover": recover,
    "replay": replay,
    "steamvr": steamvr,
    "bench": bench,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit."""
    status: int = 2
    try:
        commands = COMMANDS | {"train": _train_with(sys.argv[1:] if arguments is None else arguments)}
        status = tyro.extras.subcommand_cli_from_dict(commands, prog="studio", args=arguments)
    except KeyboardInterrupt:
        _complain("Interrupted.")
        status = 130
    except (KeyError, ValueError) as error:
        _complain(error.args[0] if error.args else repr(error))
    except (OSError, RuntimeError) as error:
        _complain(str(error))
        status = 1
    sys.exit(status)


def _train_with(arguments: Sequence[str]) -> Callable[..., int]:
    """`train` with the settings of the preset that is asked for as its defaults, which `--help` shows."""
    asked = [value for name, value in itertools.pairwise(arguments) if name == "--preset"]
    asked += [name.partition("=")[2] for name in arguments if name.startswith("--preset=")]
    chosen = next((config for preset, config in PRESETS.items() if preset in asked), PRESETS["small"])
    return functools.partial(train, config=chosen)


def _say(text: str) -> None:
    """At once, also where the output is a pipe."""
    print(text, flush=True)


def _complain(text: object) -> None:
    errors.print(f"studio: {text}", style="red", soft_wrap=True)


def _print_json(value: Any) -> None:
    print(_encode(value))


def _encode(value: Any) -> str:
    return json.dumps(_plain(value), ensure_ascii=False)


def _plain(value: Any) -> Any:
    """What JSON can hold: dataclasses as objects, paths as text, NaN as null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: _plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def _table(*columns: str) -> Table:
    """The first column is never folded; those that begin with ">" hold numbers."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    for number, column in enumerate(columns):
        justify: Literal["left", "right"] = "right" if column.startswith(">") else "left"
        table.add_column(column.lstrip(">"), justify=justify, no_wrap=number == 0, overflow="fold")
    return table


@contextmanager
def _progress(what: str, total: int, quiet: bool) -> Iterator[Callable[[], None]]:
    """A progress bar on standard error; call what it yields once for each thing done."""
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=errors, disable=quiet or not errors.is_terminal, transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda: bar.advance(task)


if __name__ == "__main__":
    main()
