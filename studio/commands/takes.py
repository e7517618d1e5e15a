"""Commands about recorded takes."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from studio.commands.terminal import DATA, Data, EpisodeId, Json, console, encode, print_json, table_of
from studio.index import Filters


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
        print_json(rows)
        return 0
    table = table_of("id", "outcome", ">s", ">N", ">peak", "rated", "flags")
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
        print_json(facts)
    else:
        console.print_json(encode(facts))
    return 0


def annotate(
    ids: Positional[tuple[Annotated[str, arg(metavar="ID")], ...]] = (),
    outcome: Literal["success", "failure", "unmarked"] | None = None,
    quality: int | None = None,
    note: str | None = None,
    add_flags: tuple[str, ...] = (),
    remove_flags: tuple[str, ...] = (),
    trim: tuple[float, float] | None = None,
    of_task: str | None = None,
    of_operator: str | None = None,
    of_agent: str | None = None,
    of_outcome: Literal["success", "failure", "unmarked"] | None = None,
    of_min_quality: int | None = None,
    of_flags: tuple[str, ...] = (),
    of_text: str | None = None,
    author: str | None = None,
    data: Data = DATA,
    json: Json = False,
) -> int:
    """Say something about episodes, about all of them or none; what was said before is kept.

    Args:
        ids: These episodes; else all that the options of-... ask for.
        quality: 1 poor .. 5 excellent.
        trim: In and out point in seconds; the recording is not cut.
        of_text: Words in id, note, instruction or people.
        author: Who says so; your user name if not given.
    """
    from studio.api import Studio

    given: dict[str, Any] = {"outcome": outcome, "quality": quality, "note": note, "trim": trim}
    given |= {"add_flags": add_flags, "remove_flags": remove_flags}
    changes = {name: value for name, value in given.items() if value not in (None, ())}
    filters: Filters = {
        "task": of_task,
        "operator": of_operator,
        "agent": of_agent,
        "outcome": of_outcome,
        "min_quality": of_min_quality,
        "flags": of_flags or None,
        "text": of_text,
    }
    if bool(ids) == any(filters.values()):
        raise ValueError("Name some episodes, or ask for them by --of-task and the like: one of the two.")
    with Studio(data) as studio:
        chosen = ids or [row.episode_id for row in studio.episodes(**filters)]
        rows = studio.annotate_all(chosen, author=author, **changes)
    if json:
        print_json(rows[0] if len(ids) == 1 else rows)
        return 0
    for row in rows:
        console.print(f"{row.episode_id}: {row.outcome}, quality {row.quality}")
    if not rows:
        console.print("No episode matches; nothing was changed.")
    return 0


def delete(episode_id: Positional[EpisodeId], even_if_used: bool = False, data: Data = DATA) -> int:
    """Move an episode to the trash; `studio restore` brings it back.

    Args:
        even_if_used: Also one that a collection names.
    """
    from studio.api import Studio

    with Studio(data) as studio:
        studio.delete(episode_id, even_if_used=even_if_used)
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
        print_json(found)
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
        print_json({**dataclasses.asdict(result), "is_exact": result.is_exact})
    else:
        console.print(str(result), soft_wrap=True)
    return int(check and not result.is_exact and not result.other_versions)
