"""What a selection of takes may ask for, and how the index asks SQLite for it."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Any, TypedDict

from studio.edits import OUTCOMES, Outcome, check_quality


class Filters(TypedDict, total=False):
    """What a selection of takes may ask for; None asks for nothing."""

    task: str | None
    operator: str | None
    agent: str | None
    outcome: Outcome | None
    min_quality: int | None
    flags: Sequence[str] | None  # all of them
    seed: int | None
    text: str | None  # every word of it begins a word of the id, task, people, instruction, note or segments


# Filters as SQL: a condition, and values for its question marks.


def where(filters: Filters, *, walks: bool = False) -> tuple[str, list[Any]]:
    """Of table episode: the buckets that match, or with `walks` a look at the bucket of each row."""
    bucket, values = where_bucket(filters)
    parts = ["bucket IS NOT NULL"]
    if values and walks:
        parts = [f"EXISTS (SELECT 1 FROM bucket WHERE bucket_id = episode.bucket AND {bucket})"]
    elif values:
        parts = [f"bucket IN (SELECT bucket_id FROM bucket WHERE {bucket})"]
    if (seed := filters.get("seed")) is not None:
        parts.append("seed = ?")
        values.append(seed)
    if text := filters.get("text"):
        parts.append("row IN (SELECT rowid FROM words WHERE words MATCH ?)")
        values.append(_match(text))
    return " AND ".join(parts), values


def where_bucket(filters: Filters) -> tuple[str, list[Any]]:
    """Of table bucket: all filters but seed and text."""
    _check(filters)
    parts, values = ["TRUE"], []
    for name in ("task", "operator", "agent", "outcome"):
        if (value := filters.get(name)) is not None:
            parts.append(f"{name} = ?")
            values.append(value)
    if (quality := filters.get("min_quality")) is not None:
        parts.append("quality >= ?")
        values.append(quality)
    for flag in filters.get("flags") or ():
        parts.append("flags IN (SELECT flags FROM flag_set WHERE instr(flags, ?))")
        values.append(json.dumps(flag))
    return " AND ".join(parts), values


def is_of_buckets(filters: Filters) -> bool:
    return not filters.get("text") and filters.get("seed") is None


def _check(filters: Filters) -> None:
    possible = Filters.__annotations__
    unknown = filters.keys() - possible.keys()
    if unknown:
        raise TypeError(f"Unknown filter {min(unknown)!r}; possible are {', '.join(possible)}.")
    outcome, quality = filters.get("outcome"), filters.get("min_quality")
    if outcome is not None and outcome not in OUTCOMES:
        raise ValueError(f"Unknown outcome {outcome!r}; possible are {', '.join(OUTCOMES)}.")
    if quality is not None:
        check_quality(quality)
    if isinstance(filters.get("flags"), str):
        raise ValueError(f"Flags are given as a list of words, not {filters['flags']!r}.")


def _match(text: str) -> str:
    """The FTS5 query for every word of `text`, each as the beginning of a word."""
    words = re.findall(r"[^\W_]+", text)
    if not words:
        raise ValueError(f"Nothing to search for in {text!r}: give letters or digits.")
    return " ".join(f'"{word}"*' for word in words)
