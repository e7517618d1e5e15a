"""Makes finished takes of what a crash left behind."""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Literal

from mcap import records

from studio.episode import HEADER_TOPIC, METADATA, PART, Event, Outcome, log_zero
from studio.episode_writer import (
    add_message,
    event_message,
    is_at,
    lock,
    outcome_message,
    put_in_place,
    start_file,
)
from studio.mcap_file import McapWriter, read_until_torn


@dataclass(frozen=True, slots=True)
class Recovery:
    """What became of a `.part`."""

    part: Path
    state: Literal["recovered", "live", "unreadable", "failed"]
    what: str  # a sentence
    episode: Path | None = None  # the finished take, where there is one


def recover_all(data_dir: Path) -> list[Recovery]:
    """Recover every `.part` below `data_dir`/episodes; takes that are being recorded stay as they are."""
    return [recover(part) for part in sorted((data_dir / "episodes").glob(f"*/*.mcap{PART}"))]


def recover(part: Path) -> Recovery:
    """Make a finished take of what a torn `.part` holds.

    The torn file goes only when the new one is on the disk. One that holds no take is put aside as
    `.unreadable`, one that its writer still has open is left alone.
    """
    episode = part.with_name(part.name.removesuffix(PART))
    try:
        with part.open("r+b") as file:
            if not lock(file) or not is_at(file, part):
                return Recovery(part, "live", f"{part.name} is being recorded.")
            if episode.exists():
                aside = _put_aside(part, ".duplicate")
                return Recovery(
                    part, "recovered", f"{episode.name} was there; moved to {aside.name}.", episode
                )
            seconds = _copy_readable(file, episode)
            if seconds is None:
                aside = _put_aside(part, ".unreadable")
                return Recovery(part, "unreadable", f"{part.name} holds no take; moved to {aside.name}.")
            part.unlink()
            return Recovery(part, "recovered", f"Recovered {seconds:.1f} s of {episode.name}.", episode)
    except FileNotFoundError:
        return Recovery(part, "live", f"{part.name} was finished meanwhile.")
    except OSError as error:
        return Recovery(part, "failed", f"{part.name} is kept as it is: {error}.")


def _copy_readable(torn: IO[bytes], episode: Path) -> float | None:
    """Copy what comes before the tear into a finished `episode`; return its seconds, None without header."""
    found = read_until_torn(torn)
    header = next(filter(None, map(_header_in, found)), None)
    if header is None:
        return None
    zero = log_zero(json.loads(header).get("started", 0.0))  # whatever version wrote it
    copy = episode.with_name(episode.name + ".recovering")
    with copy.open("wb") as file:
        mcap = start_file(file, header, zero)
        end = _copy_messages(found, mcap, zero)
        seconds = (end - zero) * 1e-9
        event = Event(seconds, "recovered", "The recording was cut off; this is what had reached the disk.")
        add_message(mcap, event_message(event, end), time.time_ns())
        if not mcap.has_topic("/outcome"):
            outcome = Outcome(None, "recovered after the recording was cut off")
            add_message(mcap, outcome_message(outcome, seconds, end), time.time_ns())
        mcap.finish()
        put_in_place(file, copy, episode)
    return seconds


def _copy_messages(found: Iterator[records.McapRecord], mcap: McapWriter, end: int) -> int:
    """Copy whole steps, each up to its tick, and events; return the newest log time, or `end`."""
    schemas: dict[int, records.Schema] = {}
    channels: dict[int, records.Channel] = {}
    step: list[tuple[str, records.Message]] = []
    for record in found:
        match record:
            case records.Schema():
                schemas[record.id] = record
            case records.Channel():
                channels[record.id] = record
            case records.Message() if channels[record.channel_id].topic != HEADER_TOPIC:
                topic = channels[record.channel_id].topic
                if not mcap.has_topic(topic):
                    described = schemas[channels[record.channel_id].schema_id]
                    mcap.add_topic(topic, described.name, described.data)
                step.append((topic, record))
                if topic in ("/tick", "/events", "/outcome"):
                    for where, message in step:
                        mcap.add(where, message.data, message.log_time, message.publish_time)
                        end = max(end, message.log_time)
                    step.clear()
    return end


def _header_in(record: records.McapRecord) -> str | None:
    if isinstance(record, records.Metadata) and record.name == METADATA:
        return record.metadata["header"]
    return None


def _put_aside(path: Path, suffix: str) -> Path:
    """Rename `path` to a free name that ends in `suffix`."""
    for number in itertools.count():
        aside = path.with_name(f"{path.name}{f'.{number}' if number else ''}{suffix}")
        if not aside.exists():
            return path.rename(aside)
    raise AssertionError("unreachable")
