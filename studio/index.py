"""The rows of the catalogue in SQLite: filter, sort, search and count 100,000 takes in milliseconds.

Takes that agree on task, operator, agent, outcome, quality and flags share a *bucket*, which triggers keep
counted: facets and totals are sums over buckets, and a filter is a set of buckets that every sorted index
carries. The file can be deleted at any time: `studio.catalog` fills it from the takes.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import sqlite3
import threading
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from studio.edits import Outcome
from studio.filters import Filters, is_of_buckets, where, where_bucket

SCHEMA = 2  # user_version of the file; any other is discarded and built anew
BUSY = 30.0  # [s] to wait for another process that writes
PAGE_CACHE = 64 * 1024  # [kiB]
# Matches up to which collecting and sorting them beats walking a sorted index. `by_bucket` carries the start,
# for any other order the rows themselves are read.
FEW = {"started": 12_000}
FEW_OTHERWISE = 1_200

__all__ = ["FACETS", "SORTS", "Amount", "EpisodeRow", "Filters", "Index", "Stamps", "Summary"]

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """What the catalogue keeps of a recording; read once, since a recording never changes."""

    episode_id: str
    task: str
    instruction: str
    operator: str
    agent: str
    seed: int | None
    started: float  # [s] since 1970
    duration: float  # [s]
    arms: tuple[str, ...]
    cameras: tuple[str, ...]
    recorded_success: bool | None  # None: nobody judged
    progress: float | None  # 0..1, None where the task does not measure it
    recovered: bool  # put together again after a crash
    peak_force: float  # [N] largest norm over all arms
    mean_force: float  # [N] mean norm over the samples in contact, 0 without any
    # Of the time under each stiffness mode, over all arms; empty where that was not summed up yet.
    stiffness_share: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeRow(Summary):
    """A take in the catalogue: its recording and what people said about it."""

    outcome: Outcome  # as edited, else as recorded
    quality: int | None
    flags: tuple[str, ...]
    note: str
    trim: tuple[float, float] | None  # [s]
    edit_version: int
    path: Path
    size: int  # [bytes] of the recording


class Stamps(NamedTuple):
    """Change whenever a recording or its sidecar does; empty without a file."""

    recording: str
    sidecar: str


@dataclass(frozen=True, slots=True)
class Amount:
    """What some takes come to."""

    takes: int
    seconds: float  # [s] of recording
    successes: int
    failures: int


SORTS = (
    "started",
    "episode_id",
    "task",
    "operator",
    "agent",
    "outcome",
    "seed",
    "duration",
    "quality",
    "progress",
    "peak_force",
    "mean_force",
    "size",
)
FACETS = ("task", "operator", "agent", "outcome", "quality", "flags")

_COLUMNS = tuple(field.name for field in dataclasses.fields(EpisodeRow))
_TUPLES = ("arms", "cameras", "flags", "trim")
_AS_JSON = (*_TUPLES, "stiffness_share")
_BOOLS = ("recorded_success", "recovered")


class Index:
    """The rows of one data folder. Threads may share it, other processes may have it open, too."""

    def __init__(self, data_dir: Path) -> None:
        """Open or create the file. No other process may do so at the same time."""
        self._data_dir = data_dir
        self._lock = threading.RLock()  # sqlite3 mixes the transactions of threads otherwise
        self._db = _open(data_dir / "catalog.sqlite")

    def close(self) -> None:
        with self._lock:
            self._db.close()

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """All of the changes in it, or none; other writers wait."""
        with self._lock:
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
            except BaseException:
                self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")

    # Reading.

    def page(
        self, filters: Filters, sort: str, descending: bool, limit: int | None, offset: int
    ) -> list[EpisodeRow]:
        if sort not in SORTS:
            raise ValueError(f"Cannot sort by {sort!r}; possible are {', '.join(SORTS)}.")
        if offset < 0 or (limit is not None and limit < 0):
            raise ValueError(f"A page needs limit and offset of 0 or more, not {limit} and {offset}.")
        index = self._best_index(filters, sort)
        condition, values = where(filters, walks=index != "by_bucket")
        way = "DESC" if descending else "ASC"
        keys = dict.fromkeys((sort, "started", "bucket", "row"))  # the columns of the index, in its order
        order = ", ".join(f"{key} {way}" for key in keys)
        page = (
            f"SELECT row FROM episode INDEXED BY {index} WHERE {condition} ORDER BY {order} LIMIT ? OFFSET ?"
        )
        return self._select(
            f"row IN ({page}) ORDER BY {order}", [*values, -1 if limit is None else limit, offset]
        )

    def count(self, filters: Filters) -> int:
        if is_of_buckets(filters):
            condition, values = where_bucket(filters)
            query = f"SELECT coalesce(sum(n), 0) FROM bucket WHERE {condition}"
        else:
            condition, values = where(filters)
            query = f"SELECT count(*) FROM episode WHERE {condition}"
        return int(self._rows(query, values)[0][0])

    def facets(self, filters: Filters) -> dict[str, dict[str, int]]:
        if is_of_buckets(filters):
            condition, values = where_bucket(filters)
            counted = f"SELECT bucket_id, n FROM bucket WHERE {condition}"
        else:
            condition, values = where(filters)
            counted = (
                f"SELECT bucket AS bucket_id, count(*) AS n FROM episode WHERE {condition} GROUP BY bucket"
            )
        columns = ", ".join(FACETS)
        query = f"SELECT {columns}, counted.n FROM ({counted}) AS counted JOIN bucket USING (bucket_id)"
        return _count_facets(self._rows(query, values))

    def amount(self, filters: Filters) -> Amount:
        if is_of_buckets(filters):
            condition, values = where_bucket(filters)
            counted = f"SELECT outcome, n, ms FROM bucket WHERE {condition}"
        else:
            condition, values = where(filters)
            counted = f"SELECT outcome, 1 AS n, {_MS.format('duration')} AS ms FROM episode WHERE {condition}"
        query = f"SELECT outcome, sum(n), sum(ms) FROM ({counted}) GROUP BY outcome"
        found = {outcome: (n, ms) for outcome, n, ms in self._rows(query, values)}
        return Amount(
            takes=sum(n for n, _ in found.values()),
            seconds=sum(ms for _, ms in found.values()) / 1e3,
            successes=found.get("success", (0, 0))[0],
            failures=found.get("failure", (0, 0))[0],
        )

    def revision(self) -> str:
        """Another one after every change, whichever thread or process makes it."""
        with self._lock:
            (others,) = self._db.execute("PRAGMA data_version").fetchone()
            return f"{others}.{self._db.total_changes}"

    def by_id(self, episode_id: str) -> EpisodeRow | None:
        """The take of this id, also one in the trash."""
        return next(iter(self._select("episode_id = ?", [episode_id])), None)

    def by_path(self, path: Path) -> EpisodeRow | None:
        return next(iter(self._select("path = ?", [self._relative(path)])), None)

    def trash(self) -> list[EpisodeRow]:
        return self._select("bucket IS NULL ORDER BY started DESC", [])

    def ids(self) -> list[str]:
        """Of all takes but those in the trash, the oldest first."""
        query = "SELECT episode_id FROM episode WHERE bucket IS NOT NULL ORDER BY started"
        return [episode_id for (episode_id,) in self._rows(query, [])]

    def unreadable(self) -> dict[Path, str]:
        return {
            self._data_dir / path: why for path, why in self._rows("SELECT path, why FROM unreadable", [])
        }

    def stamps(self) -> dict[str, Stamps]:
        """Of every file in the index, by its path below the data folder."""
        query = "SELECT path, recording, sidecar FROM {}"
        return {
            path: Stamps(recording, sidecar)
            for table in ("episode", "unreadable")
            for path, recording, sidecar in self._rows(query.format(table), [])
        }

    def recording_stamp(self, path: Path) -> str | None:
        """Of the recording that the row at `path` was made of."""
        found = self._rows("SELECT recording FROM episode WHERE path = ?", [self._relative(path)])
        return found[0][0] if found else None

    # Changing, inside a transaction.

    def put(self, row: EpisodeRow, stamps: Stamps, labels: Sequence[str], *, in_trash: bool) -> None:
        """Insert a take, or replace the row of its id. `labels` are further words to find it by."""
        columns = self._encode(row)
        columns |= {"recording": stamps.recording, "sidecar": stamps.sidecar}
        columns["bucket"] = None if in_trash else self._bucket([columns[name] or 0 for name in FACETS])
        names, marks = ", ".join(columns), ", ".join("?" * len(columns))
        updates = ", ".join(f"{name} = excluded.{name}" for name in columns)
        (number,) = self._db.execute(
            f"INSERT INTO episode ({names}) VALUES ({marks}) "
            f"ON CONFLICT (episode_id) DO UPDATE SET {updates} RETURNING row",
            list(columns.values()),
        ).fetchone()
        words = (row.episode_id, row.task, row.operator, row.agent, row.instruction, row.note)
        text = " ".join((*words, *row.flags, *labels))
        self._db.execute("REPLACE INTO words (rowid, text) VALUES (?, ?)", [number, text])
        self._db.execute("DELETE FROM unreadable WHERE path = ?", [columns["path"]])

    def put_unreadable(self, path: Path, stamps: Stamps, why: str) -> None:
        relative = self._relative(path)
        self._db.execute("DELETE FROM episode WHERE path = ?", [relative])
        self._db.execute("REPLACE INTO unreadable VALUES (?, ?, ?, ?)", [relative, *stamps, why])

    def rename(self, source: Path, target: Path) -> None:
        paths = [self._relative(target), self._relative(source)]
        self._db.execute("UPDATE episode SET path = ? WHERE path = ?", paths)

    def remove(self, paths: Collection[str]) -> None:
        """The rows of files by their paths below the data folder."""
        for table in ("episode", "unreadable"):
            self._db.executemany(f"DELETE FROM {table} WHERE path = ?", [(path,) for path in paths])

    # Inside.

    def _best_index(self, filters: Filters, sort: str) -> str:
        if filters.get("seed") is not None:
            return "by_seed"
        if filters.get("text") or not where_bucket(filters)[1]:
            return f"by_{sort}"
        return "by_bucket" if self.count(filters) <= FEW.get(sort, FEW_OTHERWISE) else f"by_{sort}"

    def _bucket(self, values: list[Any]) -> int:
        names, marks = ", ".join(FACETS), ", ".join("?" * len(FACETS))
        self._db.execute(f"INSERT OR IGNORE INTO bucket ({names}) VALUES ({marks})", values)
        same = " AND ".join(f"{name} = ?" for name in FACETS)
        return int(self._db.execute(f"SELECT bucket_id FROM bucket WHERE {same}", values).fetchone()[0])

    def _select(self, condition: str, values: Sequence[Any]) -> list[EpisodeRow]:
        found = self._rows(f"SELECT {', '.join(_COLUMNS)} FROM episode WHERE {condition}", values)
        return [self._decode(dict(zip(_COLUMNS, columns, strict=True))) for columns in found]

    def _rows(self, query: str, values: Sequence[Any]) -> list[Any]:
        with self._lock:
            return self._db.execute(query, values).fetchall()

    def _encode(self, row: EpisodeRow) -> dict[str, Any]:
        columns = {name: getattr(row, name) for name in _COLUMNS}
        columns |= {name: json.dumps(columns[name]) for name in _AS_JSON}
        return columns | {"path": self._relative(row.path)}

    def _decode(self, columns: dict[str, Any]) -> EpisodeRow:
        for name in _AS_JSON:
            columns[name] = json.loads(columns[name])
        for name in _TUPLES:
            columns[name] = None if columns[name] is None else tuple(columns[name])
        for name in _BOOLS:
            columns[name] = None if columns[name] is None else bool(columns[name])
        return EpisodeRow(**columns | {"path": self._data_dir / columns["path"]})

    def _relative(self, path: Path) -> str:
        return path.relative_to(self._data_dir).as_posix()


def _open(path: Path) -> sqlite3.Connection:
    """Connect; a file of another schema, or that is none of SQLite's, is replaced by an empty index."""
    if path.exists():
        try:
            db = _connect(path)
        except sqlite3.OperationalError:  # no access, disk full: the file itself may be good
            raise
        except sqlite3.DatabaseError as error:
            log.warning("%s is damaged (%s); it is built anew from the takes.", path, error)
        else:
            if db.execute("PRAGMA user_version").fetchone()[0] == SCHEMA:
                return db
            db.close()
            log.warning("%s has another schema; it is built anew from the takes.", path)
    # A process that still has the old file open goes on with it, unlinked, and does no harm.
    for suffix in ("", "-wal", "-shm"):
        Path(f"{path}{suffix}").unlink(missing_ok=True)
    db = _connect(path)
    db.execute("PRAGMA journal_mode = WAL")
    db.executescript(f"BEGIN; {_TABLES} PRAGMA user_version = {SCHEMA}; COMMIT;")
    return db


def _connect(path: Path) -> sqlite3.Connection:
    db = sqlite3.connect(path, timeout=BUSY, isolation_level=None, check_same_thread=False)
    try:
        db.execute("PRAGMA synchronous = NORMAL")
        db.execute(f"PRAGMA cache_size = -{PAGE_CACHE}")
        db.execute("SELECT count(*) FROM sqlite_schema")
    except BaseException:
        db.close()
        raise
    return db


_MS = "CAST(round(1000 * {}) AS INTEGER)"  # [ms] of a duration: integers add up exactly
_TABLES = f"""
CREATE TABLE bucket (
    bucket_id INTEGER PRIMARY KEY,
    task TEXT NOT NULL, operator TEXT NOT NULL, agent TEXT NOT NULL,
    outcome TEXT NOT NULL, quality INTEGER NOT NULL, flags TEXT NOT NULL,  -- 0: no quality given
    n INTEGER NOT NULL DEFAULT 0, ms INTEGER NOT NULL DEFAULT 0,
    UNIQUE ({", ".join(FACETS)})
);
CREATE INDEX by_flags ON bucket (flags, n);
CREATE TABLE flag_set (flags TEXT PRIMARY KEY) WITHOUT ROWID;  -- every one that ever was
CREATE TRIGGER flagged AFTER INSERT ON bucket BEGIN
    INSERT OR IGNORE INTO flag_set VALUES (new.flags);
END;
CREATE TABLE episode (
    row INTEGER PRIMARY KEY,
    bucket INTEGER REFERENCES bucket,  -- NULL in the trash
    {", ".join(f"{name} UNIQUE" if name in ("episode_id", "path") else name for name in _COLUMNS)},
    recording TEXT NOT NULL, sidecar TEXT NOT NULL  -- stamps of the two files
);
CREATE TABLE unreadable (path TEXT PRIMARY KEY, recording TEXT, sidecar TEXT, why TEXT);
CREATE VIRTUAL TABLE words
    USING fts5 (text, tokenize = 'unicode61 remove_diacritics 2', prefix = '2 3', detail = none);
CREATE INDEX by_started ON episode (started, bucket);
CREATE INDEX by_bucket ON episode (bucket, started);
{" ".join(f"CREATE INDEX by_{name} ON episode ({name}, started, bucket);" for name in SORTS[1:])}
CREATE TRIGGER entered AFTER INSERT ON episode BEGIN
    UPDATE bucket SET n = n + 1, ms = ms + {_MS.format("new.duration")} WHERE bucket_id = new.bucket;
END;
CREATE TRIGGER changed AFTER UPDATE OF bucket, duration ON episode
WHEN old.bucket IS NOT new.bucket OR old.duration IS NOT new.duration BEGIN
    UPDATE bucket SET n = n + 1, ms = ms + {_MS.format("new.duration")} WHERE bucket_id = new.bucket;
    UPDATE bucket SET n = n - 1, ms = ms - {_MS.format("old.duration")} WHERE bucket_id = old.bucket;
    DELETE FROM bucket WHERE bucket_id = old.bucket AND n = 0;
END;
CREATE TRIGGER removed AFTER DELETE ON episode BEGIN
    UPDATE bucket SET n = n - 1, ms = ms - {_MS.format("old.duration")} WHERE bucket_id = old.bucket;
    DELETE FROM bucket WHERE bucket_id = old.bucket AND n = 0;
    DELETE FROM words WHERE rowid = old.row;
END;
"""


def _count_facets(buckets: Sequence[Any]) -> dict[str, dict[str, int]]:
    counters: dict[str, Counter[Any]] = {name: Counter() for name in FACETS}
    for *values, n in buckets:
        for counter, value in zip(counters.values(), values, strict=True):
            counter[value] += n
    flags: Counter[str] = Counter()
    for together, n in counters["flags"].items():
        flags.update(dict.fromkeys(json.loads(together), n))
    counters["flags"] = flags
    counters["quality"].pop(0, None)  # of takes without a quality
    return {name: {str(value): n for value, n in counter.most_common()} for name, counter in counters.items()}
