"""Commands that show tasks and record demonstrations."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from studio.commands.terminal import (
    DATA,
    Data,
    Json,
    ProgressPath,
    TaskName,
    console,
    ends_orderly,
    plain,
    print_json,
    progress,
    table_of,
)
from studio.jobs.progress import ProgressFile


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
        print_json(
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
    table = table_of("task", "arms", "stiffness", "cameras", "instruction")
    for task in found:
        modes = ", ".join(
            f"{arm.name[0].upper()} {'/'.join(m.value for m in arm.modes)}" for arm in task.arms
        )
        cameras = ", ".join(view.name for view in task.cameras)
        table.add_row(task.name, str(len(task.arms)), modes, cameras, task.instruction)
    console.print(table)
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
    progress_file: ProgressPath = None,
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
    from studio.station import Take

    file, taken = ProgressFile(progress_file, episodes), 0

    def tell(take: Take) -> None:
        nonlocal taken
        taken += 1
        advance()
        file.tell(taken, take.episode_id)

    with Studio(data) as studio, progress(f"{task}", episodes, quiet=json) as advance, ends_orderly():
        report = studio.demo(
            task,
            episodes,
            seed,
            cameras=cameras,
            workers=workers,
            spread=spread,
            stiffness_table=stiffness_table,
            on_take=tell,
        )
    file.end(plain(report))
    if json:
        print_json(dataclasses.asdict(report))
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
