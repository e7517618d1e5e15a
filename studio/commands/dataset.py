"""Commands about takes as a dataset: their health, and collections of them."""

from __future__ import annotations

from typing import Annotated, Literal

from tyro.conf import Positional, arg

from studio.commands.terminal import DATA, Data, Json, console, plain, print_json, progress, table_of


def health(
    ids: Positional[tuple[Annotated[str, arg(metavar="ID")], ...]] = (),
    task: str | None = None,
    operator: str | None = None,
    agent: str | None = None,
    outcome: Literal["success", "failure", "unmarked"] | None = None,
    min_quality: int | None = None,
    flags: tuple[str, ...] = (),
    data: Data = DATA,
    json: Json = False,
) -> int:
    """Grade takes, with reasons: rates, gaps, sensors, cameras, spikes, duplicates; and their balance.

    Nothing is left out because of a grade.

    Args:
        ids: Only these; else all that match.
        flags: All of these must be set.
    """
    from studio.api import Studio

    with Studio(data) as studio:
        rows = (
            [studio.catalog.get(episode_id) for episode_id in ids]
            if ids
            else studio.episodes(
                task=task,
                operator=operator,
                agent=agent,
                outcome=outcome,
                min_quality=min_quality,
                flags=flags or None,
            )
        )
        with progress("health", len(rows), quiet=json) as advance:
            found = studio.health(rows, on_take=lambda told: advance())
    if json:
        grades = [told.grade for told in found.takes]
        takes = [{**plain(told), "grade": grade} for told, grade in zip(found.takes, grades, strict=True)]
        print_json({**plain(found), "takes": takes})
        return 0
    table = table_of("id", "grade", "why")
    for told in found.takes:
        table.add_row(told.episode_id, told.grade, " ".join(finding.text for finding in told.findings))
    console.print(table if rows else f"No such takes in {data}.")
    for name, counts in found.balance.items():
        console.print(f"{name}: {', '.join(f'{count} {value}' for value, count in counts.items())}")
    for finding in found.findings:
        console.print(f"{finding.severity}: {finding.text}")
    console.print(f"All together {found.grade}. {' '.join(found.reasons)}")
    return 0
