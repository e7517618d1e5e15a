"""How fast a large catalogue answers, also right after an edit, and how fast its index is built anew."""

from __future__ import annotations

import random
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from statistics import median
from typing import Any

from studio.benchmarks.episodes import made_up_header, write_take
from studio.catalog import Catalog
from studio.edits import FLAGS, OUTCOMES
from studio.index import EpisodeRow, Index, Stamps, Summary

ROWS, TAKES = 100_000, 1_000
REPEATS = 7
TASKS = ("bimanual-wiping", "drawing", "peg-cuboid", "peg-cylinder", "pick-insert", "wiping")
WORDS = ("slips", "clean", "stroke", "late", "contact", "edge", "tilted", "slow", "again", "perfect")
HEAD, TAIL = 64 * 1024, 1024 * 1024  # [bytes] of a take in which its header and its index are
FILTERS: tuple[dict[str, Any], ...] = (
    {},
    {"task": "wiping"},
    {"operator": "person 3", "outcome": "failure"},
    {"task": "drawing", "min_quality": 4, "flags": ["jittery"]},
    {"seed": 17},
)
TEXTS = ("slips", "clean stroke", "person 7", "tilt", "perfect wiping")
SORTS = ("started", "peak_force", "quality", "episode_id")


def measure(rows: int = ROWS, takes: int = TAKES) -> dict[str, float]:
    """[ms] of what a page asks of `rows` takes, also right after an edit: the median of the slowest question.

    And [s] to index `takes`.
    """
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder)
        begin = time.perf_counter()
        fill(data, rows)
        results = {"fill_s": time.perf_counter() - begin}
        results |= _answers(data)
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder)
        _make_takes(data, takes)
        with Catalog(data) as catalog:
            catalog.refresh()
            results["rebuild_s"] = _seconds(catalog.rebuild)
            found = catalog.refresh()
            assert catalog.count() == takes, found.unreadable
    return results


def fill(data_dir: Path, n: int) -> list[EpisodeRow]:
    """An index of `n` made-up takes without any files; everything follows from their numbers."""
    made = [made_up_row(data_dir, number) for number in range(n)]
    index = Index(data_dir)
    with index.transaction():
        for row in made:
            index.put(row, Stamps("made up", ""), (), in_trash=False)
    index.close()
    return made


def made_up_row(data_dir: Path, number: int) -> EpisodeRow:
    """What people of a large lab may have recorded: most takes succeed, and few are remarkable."""
    rng = random.Random(number)
    episode_id, task = f"take-{number:06d}", rng.choice(TASKS)
    outcome = rng.choices(OUTCOMES, (75, 20, 5))[0]
    n_flags = rng.choices((0, 1, 2), (85, 13, 2))[0]
    return EpisodeRow(
        episode_id=episode_id,
        task=task,
        instruction=f"do the {task}",
        operator=f"person {rng.randrange(12)}",
        agent=rng.choices(("gizmo", "xr", "scripted"), (30, 50, 20))[0],
        seed=rng.randrange(1000),
        started=1.7e9 + 40.0 * number,
        duration=rng.uniform(5, 60),
        arms=("right",),
        cameras=("front", "right_wrist"),
        recorded_success={"success": True, "failure": False}.get(outcome),
        progress=rng.random(),
        recovered=False,
        peak_force=rng.uniform(0, 40),
        mean_force=rng.uniform(0, 8),
        stiffness_share=_made_up_shares(number),
        outcome=outcome,
        quality=rng.choices((None, 1, 2, 3, 4, 5), (50, 2, 5, 13, 20, 10))[0],
        flags=tuple(sorted(rng.sample(FLAGS, n_flags))),
        note=" ".join(rng.sample(WORDS, rng.randrange(4))),
        trim=None,
        edit_version=1,
        path=data_dir / "episodes" / task / f"{episode_id}.mcap",
        size=rng.randrange(10**6, 10**8),
    )


def _made_up_shares(number: int) -> dict[str, float]:
    """Of a number; an early take has none."""
    low = number % 10 / 10
    return {"low": low, "medium": round(1 - low, 1)} if number >= 100 else {}


def _answers(data: Path) -> dict[str, float]:
    def summary_of(path: Path) -> Summary:
        return made_up_row(data, int(path.stem.removeprefix("take-")))

    with Catalog(data, summary_of) as catalog:
        asked: dict[str, list[Callable[[], object]]] = {
            "page_ms": [
                partial(catalog.episodes, sort=sort, limit=50, **filters)
                for filters in FILTERS
                for sort in SORTS
            ],
            "search_ms": [partial(catalog.episodes, text=text, limit=50) for text in TEXTS],
            "facets_ms": [partial(catalog.facets, **filters) for filters in FILTERS],
            "amount_ms": [partial(catalog.amount, **filters) for filters in FILTERS],
        }
        numbers = count()
        results: dict[str, float] = {}
        for name, questions in asked.items():
            before, after = [], []
            for ask in questions:
                ask()
                before.append(median(_seconds(ask) for _ in range(REPEATS)))
                after.append(median(_seconds_after_edit(catalog, ask, numbers) for _ in range(REPEATS)))
            results |= {name: max(before) * 1e3, f"{name}_after_edit": max(after) * 1e3}
        return results


def _seconds_after_edit(catalog: Catalog, ask: Callable[[], object], numbers: Iterator[int]) -> float:
    _edit(catalog, next(numbers))
    return _seconds(ask)


def _edit(catalog: Catalog, number: int) -> None:
    """Annotate one take, whose file is made for that."""
    (row,) = catalog.episodes(limit=1, offset=37 * number)
    row.path.parent.mkdir(parents=True, exist_ok=True)
    row.path.touch()
    catalog.annotate(row.episode_id, author="bench", quality=1 + number % 5, note=f"slips {number}")


def _seconds(ask: Callable[[], object]) -> float:
    """[s] of CPU time: others use the machine, too, and nothing waits for a disk here."""
    begin = time.process_time()
    ask()
    return time.process_time() - begin


def _make_takes(data: Path, n: int) -> None:
    """Like takes of 60 s with two arms and three cameras, as far as an index reads them: both their ends."""
    header = made_up_header()
    original = data / "original.mcap"
    write_take(original, header, 60.0)
    size, old = original.stat().st_size, header.episode_id
    folder = data / "episodes" / header.task
    folder.mkdir(parents=True)
    with original.open("rb") as file:
        head = file.read(HEAD)
        file.seek(size - TAIL)
        tail = file.read()
    for number in range(n):
        new = f"{number:0{len(old)}d}"
        with (folder / f"{new}.mcap").open("wb") as file:
            file.write(head.replace(old.encode(), new.encode()))
            file.truncate(size)
            file.seek(size - TAIL)
            file.write(tail)
    original.unlink()
