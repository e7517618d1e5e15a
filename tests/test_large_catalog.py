"""A large catalogue says what plain Python says of all its rows, also right after an edit."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from studio.benchmarks.catalog import FILTERS, ROWS, SORTS, TEXTS, fill, made_up_row
from studio.catalog import Catalog, EpisodeRow, Summary


def summary_of(data: Path) -> Callable[[Path], Summary]:
    return lambda path: made_up_row(data, int(path.stem.removeprefix("take-")))


def matches(row: EpisodeRow, filters: dict[str, Any]) -> bool:
    return (
        all(
            getattr(row, name) == value
            for name, value in filters.items()
            if name not in ("min_quality", "flags")
        )
        and (row.quality or 0) >= filters.get("min_quality", 0)
        and set(filters.get("flags", ())) <= set(row.flags)
    )


def says(row: EpisodeRow, text: str) -> bool:
    told = (row.episode_id, row.task, row.operator, row.agent, row.instruction, row.note, *row.flags)
    words = re.findall(r"[^\W_]+", " ".join(told).lower())
    return all(any(word.startswith(part) for word in words) for part in text.split())


def check(catalog: Catalog, rows: list[EpisodeRow]) -> None:
    for filters in FILTERS:
        wanted = [row for row in rows if matches(row, filters)]
        assert catalog.count(**filters) == len(wanted) > 0
        amount = catalog.amount(**filters)
        assert (amount.takes, amount.successes) == (len(wanted), sum(r.outcome == "success" for r in wanted))
        assert amount.seconds == pytest.approx(sum(row.duration for row in wanted), abs=5e-4 * len(wanted))
        facets = catalog.facets(**filters)
        for name in ("task", "operator", "agent", "outcome"):
            assert facets[name] == Counter(getattr(row, name) for row in wanted)
        assert facets["quality"] == Counter(str(row.quality) for row in wanted if row.quality)
        assert facets["flags"] == Counter(flag for row in wanted for flag in row.flags)
        for sort in SORTS:
            keys = [
                (value is not None, value or 0, row.started)
                for row in wanted
                for value in [getattr(row, sort)]
            ]
            ordered = [
                row for _, row in sorted(zip(keys, wanted, strict=True), key=lambda pair: pair[0])[::-1]
            ]
            page = catalog.episodes(sort=sort, limit=50, offset=7, **filters)
            assert [row.episode_id for row in page] == [row.episode_id for row in ordered[7:57]]
    for text in TEXTS:
        assert catalog.count(text=text) == sum(says(row, text) for row in rows)
        assert catalog.amount(text=text).takes == catalog.count(text=text)


@pytest.mark.parametrize(
    "n", [2_000, pytest.param(ROWS, marks=[pytest.mark.verify, pytest.mark.timeout(1200)])]
)
def test_a_large_catalogue_says_what_its_rows_say(tmp_path: Path, n: int) -> None:
    rows = fill(tmp_path, n)
    with Catalog(tmp_path, summary_of(tmp_path)) as catalog:
        check(catalog, rows)
        edited = rows[n // 2]
        edited.path.parent.mkdir(parents=True)
        edited.path.touch()
        told = catalog.annotate(
            edited.episode_id,
            author="ann",
            outcome="failure",
            quality=5,
            note="tilted",
            add_flags=("jittery",),
        )
        rows[n // 2] = dataclasses.replace(told, outcome="failure", quality=5, note="tilted")
        check(catalog, rows)
        catalog.delete(edited.episode_id)
        check(catalog, [row for row in rows if row.episode_id != edited.episode_id])
        assert catalog.restore(edited.episode_id) == told
        check(catalog, rows)
