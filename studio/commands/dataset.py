"""Commands about takes as a dataset: their health, and collections of them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from studio.commands.terminal import DATA, Data, Json, console, plain, print_json, progress, table_of
from studio.index import Filters


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


def show_collections(data: Data = DATA, json: Json = False) -> int:
    """List the collections, the newest first."""
    from studio.api import Studio

    with Studio(data) as studio:
        found = studio.collections()
    if json:
        print_json(found)
        return 0
    table = table_of("name", ">takes", "made", "by", "of", "note")
    for told in found:
        asked = ", ".join(f"{name} {value}" for name, value in told.filters.items())
        made = datetime.fromtimestamp(told.created).strftime("%d %b %Y %H:%M")
        table.add_row(
            told.name, str(len(told.members)), made, told.author, asked or "chosen takes", told.note
        )
    console.print(
        table if found else f"No collections in {data}. Make one: studio collection NAME --task wiping"
    )
    return 0


def collection(
    name: Positional[Annotated[str, arg(metavar="NAME")]],
    ids: tuple[Annotated[str, arg(metavar="ID")], ...] = (),
    task: str | None = None,
    operator: str | None = None,
    agent: str | None = None,
    outcome: Literal["success", "failure", "unmarked"] | None = None,
    min_quality: int | None = None,
    flags: tuple[str, ...] = (),
    seed: int | None = None,
    text: str | None = None,
    note: str = "",
    delete: bool = False,
    restore: bool = False,
    data: Data = DATA,
    json: Json = False,
) -> int:
    """Name some takes as they are now, or show a collection and what became of its takes since.

    With ids or filters a new collection is made; without any, an old one is shown.

    Args:
        ids: These takes.
        flags: All of these must be set.
        text: Words in id, note, instruction or people.
        note: What the collection is for.
        delete: Move the collection to the trash; its takes stay.
        restore: Bring the collection back from the trash.
    """
    from studio.api import Studio

    filters: Filters = {"task": task, "operator": operator, "agent": agent, "outcome": outcome}
    filters |= {"min_quality": min_quality, "flags": flags or None, "seed": seed, "text": text}
    is_asked = any(value is not None for value in filters.values())
    if bool(ids or is_asked) + delete + restore > 1:
        raise ValueError("Make, delete or restore a collection: one at a time.")
    with Studio(data) as studio:
        if delete:
            studio.delete_collection(name)
            console.print(f"{name} is in the trash; `studio collection {name} --restore` brings it back.")
            return 0
        if ids or is_asked:
            asked = filters if is_asked else None
            told = studio.make_collection(name, episode_ids=ids or None, filters=asked, note=note)
        else:
            told = studio.restore_collection(name) if restore else studio.collection(name)
        changes = studio.collection_changes(name)
    if json:
        print_json({**plain(told), "changes": plain(changes)})
        return 0
    console.print(f"{name}: {len(told.members)} takes, by {told.author}. {told.note}")
    for change in changes:
        console.print(f"  {change.kind}: {change.episode_id}: {change.text}")
    return 0
