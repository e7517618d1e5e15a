"""The catalogue finds what the files say, whoever changes them, and never loses a take."""

import dataclasses
import math
import multiprocessing
import random
import shutil
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.stiffness import stiffness_of
from controller.types import (
    ARM_ROW,
    ARM_ROW_WIDTH,
    Action,
    Applied,
    ArmAction,
    ArmState,
    CartesianTarget,
    Hold,
    JointTarget,
    Observation,
    Pose,
    Release,
    Step,
    StiffnessMode,
)
from studio import collections
from studio.api import DemoReport
from studio.catalog import FACETS, SORTS, Catalog, EpisodeRow, Filters, Summary, summarise
from studio.cursor import Cursor
from studio.edits import FLAGS, OUTCOMES, Edit, Segment, append, edits_path, read
from studio.episode import Header, Outcome, open_episode, totals_of
from studio.episode_writer import EpisodeWriter
from studio.totals import StiffnessTally

OUTCOME_OF = {True: "success", False: "failure", None: "unmarked"}


def record(data: Path, episode_id: str, forces: tuple[float, ...] = (0.0,), **changes: object) -> Path:
    """A take of one arm that feels one force [N] after the other, 10 ms each."""
    success = changes.pop("success", True)
    header = Header(
        **{
            "episode_id": episode_id,
            "task": "wiping",
            "instruction": "wipe the mark off",
            "agent": "gizmo",
            "operator": "ann",
            "robot": "none",
            "arms": ("right",),
            "started": 1.7e9,
            "seed": 1,
            **changes,
        }
    )
    path = data / "episodes" / header.task / f"{episode_id}.mcap"
    writer = EpisodeWriter(path, header)
    row = np.zeros(ARM_ROW_WIDTH)
    row[ARM_ROW["base_from_tcp"]] = (0, 0, 0, 1, 0, 0, 0)
    action = Action((ArmAction(Hold(), 1.0),))
    for number, force in enumerate(forces):
        begin = row.copy()
        trace = np.tile(row, (1, 5, 1))
        trace[0, :, 0] = number * 0.01 + 0.002 * np.arange(1, 6)
        trace[0, :, ARM_ROW["wrench"].start] = force
        row = trace[0, -1]
        observation = Observation(float(begin[0]), (ArmState.from_row(begin),), {})
        writer.add(Step(observation, action, Applied(action, (), trace), b"", None, None), wall=1.7e9)
    return writer.finish(Outcome(success, "said so"))


def made_up(path: Path) -> Summary:
    """A summary for tests of thousands of rows: everything follows from the name, nothing is read."""
    rng = random.Random(path.stem)
    return Summary(
        episode_id=path.stem,
        task=path.parent.name,
        instruction="wipe the mark off" if path.parent.name == "wiping" else "insert the peg",
        operator=rng.choice(["ann", "bob", "eve"]),
        agent=rng.choice(["gizmo", "xr", "scripted"]),
        seed=rng.choice([None, 1, 2, 3]),
        started=1.7e9 + rng.randrange(1000),
        duration=rng.uniform(5, 60),
        arms=("right",),
        cameras=("front", "wrist"),
        recorded_success=rng.choice([True, False, None]),
        progress=rng.choice([None, 0.5, 1.0]),
        recovered=rng.random() < 0.1,
        peak_force=rng.uniform(0, 30),
        mean_force=rng.uniform(0, 5),
    )


def make_up(data: Path, n_episodes: int) -> list[Path]:
    """Files whose summary is made up."""
    paths = [
        data / "episodes" / ("wiping", "pick-insert")[number % 2] / f"take-{number:04d}.mcap"
        for number in range(n_episodes)
    ]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"recording of " + path.name.encode())
    return paths


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return tmp_path / "data"


@pytest.fixture
def catalog(data: Path) -> Iterator[Catalog]:
    with Catalog(data) as catalog:
        yield catalog


# What a row says.


def test_a_row_says_what_was_recorded(data: Path, catalog: Catalog) -> None:
    path = record(
        data, "take-1", forces=(0.0, 0.5, 3.0, 5.0), success=True, seed=7, cameras={"front": (8, 6)}
    )
    assert catalog.refresh().indexed == 1
    row = catalog.get("take-1")
    assert row == EpisodeRow(
        episode_id="take-1",
        task="wiping",
        instruction="wipe the mark off",
        operator="ann",
        agent="gizmo",
        seed=7,
        started=1.7e9,
        duration=row.duration,
        arms=("right",),
        cameras=("front",),
        recorded_success=True,
        progress=None,
        recovered=False,
        peak_force=5.0,
        mean_force=4.0,  # 1.7 with the samples under 1 N
        outcome="success",
        quality=None,
        flags=(),
        note="",
        trim=None,
        edit_version=0,
        path=path,
        size=path.stat().st_size,
    )
    assert math.isclose(row.duration, 0.04, abs_tol=1e-9)


def test_a_dead_force_sensor_counts_as_no_contact(data: Path) -> None:
    summary = summarise(record(data, "take-1", forces=(math.nan, math.nan)))
    assert (summary.peak_force, summary.mean_force) == (0.0, 0.0)


def test_what_people_say_wins_over_what_was_recorded(data: Path, catalog: Catalog) -> None:
    record(data, "take-1", success=True)
    row = catalog.annotate("take-1", author="ann", outcome="failure", quality=2, add_flags=["jittery"])
    assert (row.outcome, row.recorded_success, row.quality, row.flags) == ("failure", True, 2, ("jittery",))
    assert catalog.undo("take-1", author="ann").outcome == "success"
    with pytest.raises(KeyError, match="'ann' has no edit of take-1"):
        catalog.undo("take-1", author="ann")


def test_an_edit_never_touches_the_recording(data: Path, catalog: Catalog) -> None:
    path = record(data, "take-1")
    before = path.read_bytes()
    catalog.annotate("take-1", author="ann", trim=(0.0, 0.01), note="x")
    assert path.read_bytes() == before


# What the files say is what is found.


def test_refresh_follows_files_that_come_change_and_go(data: Path, catalog: Catalog) -> None:
    first, second = record(data, "take-1"), record(data, "take-2")
    assert (catalog.refresh().indexed, catalog.refresh().indexed) == (2, 0)
    append(edits_path(first), Edit(author="bob", note="slips"))
    second.unlink()
    refreshed = catalog.refresh()
    assert (refreshed.indexed, refreshed.removed, refreshed.unreadable) == (1, 1, {})
    assert [row.note for row in catalog.episodes()] == ["slips"]


def test_a_recording_is_read_once_however_often_it_is_annotated(data: Path) -> None:
    paths = make_up(data, 3)
    read_paths = []
    with Catalog(data, lambda path: read_paths.append(path) or made_up(path)) as catalog:
        catalog.refresh()
        for path in paths:
            catalog.annotate(path.stem, author="ann", quality=3)
            append(edits_path(path), Edit(author="bob", quality=4))
        catalog.refresh()
        assert [row.quality for row in catalog.episodes()] == [4, 4, 4]
    assert sorted(read_paths) == sorted(paths)


def test_a_take_that_was_just_recorded_is_found_without_a_refresh(data: Path, catalog: Catalog) -> None:
    path = record(data, "take-1")
    assert catalog.add(path) == catalog.get("take-1")
    record(data, "take-2")
    assert catalog.get("take-2").episode_id == "take-2"


def snapshot(catalog: Catalog) -> tuple[object, ...]:
    return catalog.episodes(limit=None), catalog.trash(), catalog.facets(), catalog.unreadable()


@pytest.mark.parametrize("spoil", ["delete", "garbage", "other schema", "empty"])
def test_the_index_can_be_lost_and_comes_back_from_the_files(data: Path, spoil: str) -> None:
    paths = make_up(data, 30)
    (paths[0].parent / "foreign.mcap").write_bytes(b"not a take")
    with Catalog(data, lambda path: made_up(path) if path.stem != "foreign" else fail()) as catalog:
        catalog.refresh()
        catalog.annotate("take-0003", author="ann", quality=3, add_flags=("jittery",))
        catalog.delete("take-0004")
        before = snapshot(catalog)
        assert len(catalog.unreadable()) == 1
    index = data / "catalog.sqlite"
    if spoil == "delete":
        index.unlink()
    elif spoil == "garbage":
        index.write_bytes(b"garbage" * 1000)
    elif spoil == "empty":
        index.write_bytes(b"")
    else:
        db = sqlite3.connect(index)
        db.execute("PRAGMA user_version = 999")
        db.close()
    with Catalog(data, lambda path: made_up(path) if path.stem != "foreign" else fail()) as catalog:
        catalog.refresh()
        assert snapshot(catalog) == before
        catalog.rebuild()
        assert snapshot(catalog) == before


def fail() -> Summary:
    raise ValueError("this is no take")


def test_a_catalogue_whose_index_is_deleted_goes_on_and_harms_no_newer_one(data: Path) -> None:
    make_up(data, 5)
    old = Catalog(data, made_up)
    old.refresh()
    for file in data.glob("catalog.sqlite*"):
        file.unlink()
    with Catalog(data, made_up) as new:
        new.refresh()
        old.annotate("take-0001", author="ann", quality=3)
        assert old.get("take-0001").quality == 3
        old.close()
        new.refresh()
        new.annotate("take-0002", author="ann", quality=4)
        assert (new.get("take-0001").quality, new.get("take-0002").quality) == (3, 4)
    with Catalog(data, made_up) as again:
        assert again.refresh().indexed == 0  # nothing of the new index was lost when the old one closed
        assert again.get("take-0002").quality == 4


# Filters, sorting, text and counts, against plain Python over all rows.


@pytest.fixture(scope="module")
def crowd(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Catalog]:
    """400 takes, half of them annotated, a few in the trash."""
    data = tmp_path_factory.mktemp("crowd")
    rng = random.Random(0)
    for path in make_up(data, 400):
        if rng.random() < 0.5:
            outcome, quality = rng.choice([None, *OUTCOMES]), rng.choice([None, 1, 3, 5])
            note, flags = (
                rng.choice(["", "slips off", "slip-stick"]),
                tuple(rng.sample(FLAGS, rng.randrange(3))),
            )
            edit = Edit(author="ann", outcome=outcome, quality=quality, note=note, add_flags=flags)
            append(edits_path(path), edit)
    with Catalog(data, made_up) as catalog:
        catalog.refresh()
        for number in range(0, 400, 50):
            catalog.delete(f"take-{number:04d}")
        yield catalog


some_filters = st.fixed_dictionaries(
    {},
    optional={
        "task": st.sampled_from(["wiping", "pick-insert", "none such"]),
        "operator": st.sampled_from(["ann", "bob", "eve"]),
        "agent": st.sampled_from(["gizmo", "xr", "scripted"]),
        "outcome": st.sampled_from(OUTCOMES),
        "min_quality": st.integers(1, 5),
        "flags": st.lists(st.sampled_from(FLAGS), max_size=2),
        "seed": st.sampled_from([1, 2, 3]),
        "text": st.sampled_from(["slip", "Slips OFF", "take-000", "insert bob", "wipe", "jitt", "nothing"]),
    },
)


def matches(row: EpisodeRow, filters: Filters) -> bool:
    words = " ".join(
        (row.episode_id, row.task, row.operator, row.agent, row.instruction, row.note, *row.flags)
    )
    known = words.lower().replace("-", " ").replace("_", " ").split()
    wanted = (filters.get("text") or "").lower().replace("-", " ").split()
    return (
        all(getattr(row, name) == filters[name] for name in ("task", "operator", "agent") if name in filters)
        and filters.get("outcome", row.outcome) == row.outcome
        and filters.get("seed", row.seed) == row.seed
        and (row.quality or 0) >= filters.get("min_quality", 0)
        and set(filters.get("flags") or ()) <= set(row.flags)
        and all(any(word.startswith(part) for word in known) for part in wanted)
    )


@settings(deadline=None)
@given(filters=some_filters, sort=st.sampled_from(SORTS), descending=st.booleans(), offset=st.integers(0, 60))
def test_pages_counts_and_facets_are_those_of_all_rows(
    crowd: Catalog, filters: Filters, sort: str, descending: bool, offset: int
) -> None:
    everything = crowd.episodes(limit=None)
    assert len(everything) == 392
    wanted = {row.episode_id for row in everything if matches(row, filters)}
    found = crowd.episodes(sort=sort, descending=descending, limit=None, **filters)
    assert {row.episode_id for row in found} == wanted
    assert crowd.count(**filters) == len(found) == len(wanted)
    keys = [(value is not None, value) for row in found for value in [getattr(row, sort)]]
    assert keys == sorted(keys, reverse=descending)
    page = crowd.episodes(sort=sort, descending=descending, limit=20, offset=offset, **filters)
    assert page == found[offset : offset + 20]
    facets = crowd.facets(**filters)
    for name in FACETS[:4]:
        assert facets[name] == Counter(getattr(row, name) for row in found)
    assert facets["quality"] == Counter(str(row.quality) for row in found if row.quality)
    assert facets["flags"] == Counter(flag for row in found for flag in row.flags)


@given(st.data())
@settings(deadline=None, max_examples=20)
def test_counts_stay_right_after_edits_deletions_and_restorations(
    crowd: Catalog, data: st.DataObject
) -> None:
    episode_id = data.draw(st.sampled_from([row.episode_id for row in crowd.episodes(limit=5)]))
    match data.draw(st.sampled_from(["annotate", "undo", "delete and restore"])):
        case "annotate":
            outcome = data.draw(st.sampled_from(OUTCOMES))
            crowd.annotate(episode_id, author="eve", outcome=outcome, add_flags=["own"])
        case "undo" if read(edits_path(crowd.get(episode_id).path)).undoable("eve"):
            crowd.undo(episode_id, author="eve")
        case _:
            crowd.delete(episode_id)
            assert crowd.count() == 391
            crowd.restore(episode_id)
    rows = crowd.episodes(limit=None)
    assert crowd.facets()["outcome"] == Counter(row.outcome for row in rows)
    assert crowd.facets()["flags"] == Counter(flag for row in rows for flag in row.flags)
    assert crowd.count() == len(rows) == 392


def test_text_finds_notes_and_segment_labels_as_soon_as_they_are_written(
    data: Path, catalog: Catalog
) -> None:
    record(data, "take-1")
    catalog.annotate(
        "take-1", author="ann", note="Überschwinger", put_segments=(Segment(0.0, 0.01, "Kontakt"),)
    )
    for text in ("uber", "Überschwinger", "konta wipe", "TAKE 1", 'take"1*'):
        assert [row.episode_id for row in catalog.episodes(text=text)] == ["take-1"], text
    catalog.annotate("take-1", author="ann", note="nothing")
    assert catalog.episodes(text="uber") == []


# Deleting.


def files(data: Path) -> dict[str, bytes]:
    """All takes and sidecars, by name."""
    return {
        path.name: path.read_bytes() for place in ("episodes", "trash") for path in data.glob(f"{place}/*/*")
    }


def test_delete_and_restore_are_inverse(data: Path, catalog: Catalog) -> None:
    path = record(data, "take-1")
    before = catalog.annotate("take-1", author="ann", note="keep me")
    kept = files(data)
    deleted = catalog.delete("take-1")
    assert deleted.path == data / "trash" / "wiping" / "take-1.mcap"
    assert deleted.path.exists()
    assert edits_path(deleted.path).exists()
    assert not path.exists()
    assert (catalog.episodes(), catalog.trash()) == ([], [deleted])
    with pytest.raises(KeyError, match=r"in the trash; `studio restore take-1`"):
        catalog.get("take-1")
    assert catalog.restore("take-1") == before
    assert catalog.trash() == []
    assert files(data) == kept


def test_a_crash_in_mid_deletion_loses_nothing(data: Path, catalog: Catalog) -> None:
    path = record(data, "take-1")
    catalog.annotate("take-1", author="ann", note="keep me")
    trashed = data / "trash" / "wiping" / path.name
    trashed.parent.mkdir(parents=True)
    path.rename(trashed)  # the first of the two renames
    catalog.refresh()
    assert catalog.episodes() == []
    assert [row.episode_id for row in catalog.trash()] == ["take-1"]
    assert catalog.restore("take-1").note == "keep me"


def test_restoring_keeps_what_was_said_in_both_places(data: Path, catalog: Catalog) -> None:
    path = record(data, "take-1")
    catalog.annotate("take-1", author="ann", note="before")
    catalog.delete("take-1")
    append(edits_path(path), Edit(author="bob", quality=4))  # a process that knew nothing of the deletion
    row = catalog.restore("take-1")
    assert (row.note, row.quality) == ("before", 4)


def test_a_restored_take_overwrites_nothing(data: Path, catalog: Catalog) -> None:
    path = record(data, "take-1")
    catalog.delete("take-1")
    path.write_bytes(b"something else")
    with pytest.raises(FileExistsError, match="exists already; move it away first"):
        catalog.restore("take-1")
    assert path.read_bytes() == b"something else"
    assert (data / "trash" / "wiping" / path.name).exists()


# Bad input.


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89MCAP0\r\n" + bytes(100)])
def test_a_foreign_file_is_named_and_hides_no_take(data: Path, catalog: Catalog, content: bytes) -> None:
    good = record(data, "take-1")
    bad = good.with_name("bad.mcap")
    bad.write_bytes(content)
    refreshed = catalog.refresh()
    assert (refreshed.indexed, list(refreshed.unreadable)) == (1, [bad])
    with pytest.raises(KeyError, match=r"bad\.mcap cannot be read"):
        catalog.get("bad")
    with pytest.raises(ValueError, match=r"bad\.mcap cannot be read"):
        catalog.add(bad)
    bad.unlink()
    assert catalog.refresh().unreadable == {}


def test_a_copy_under_another_name_is_refused_and_the_take_stays(data: Path, catalog: Catalog) -> None:
    path = record(data, "take-1")
    shutil.copy(path, path.with_name("take-2.mcap"))
    other = data / "episodes" / "drawing" / "take-1.mcap"
    other.parent.mkdir()
    catalog.refresh()
    shutil.copy(path, other)
    (why_other, why_copy) = catalog.refresh().unreadable.values()
    assert "take-2.mcap says that it is episode 'take-1'" in why_copy + why_other
    assert "ids must differ" in why_copy + why_other
    assert [row.path for row in catalog.episodes()] == [path]


def test_unknown_episodes_are_refused_with_those_near(data: Path, catalog: Catalog) -> None:
    with pytest.raises(KeyError, match="there are none in"):
        catalog.get("take-1")
    record(data, "take-1")
    for call in (catalog.get, catalog.delete, lambda i: catalog.annotate(i, author="ann", quality=3)):
        with pytest.raises(
            KeyError, match=r"No episode 'take-2'; near are take-1; `studio episodes` lists all 1"
        ):
            call("take-2")
    with pytest.raises(KeyError, match=r"No episode 'take-1' in the trash; it has none"):
        catalog.restore("take-1")
    with pytest.raises(KeyError, match="No episode"):
        catalog.get("../../etc/passwd")


def test_a_take_that_is_being_recorded_is_not_annotated(data: Path, catalog: Catalog) -> None:
    record(data, "take-1")
    part = data / "episodes" / "wiping" / "take-2.mcap.part"
    part.write_bytes(b"")
    with pytest.raises(KeyError, match="'take-2' is still being recorded"):
        catalog.annotate("take-2", author="ann", quality=3)
    assert not edits_path(part.with_suffix("")).exists()


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"quality": 7}, ValueError, "Quality 7"),
        ({"qualty": 3}, TypeError, "Unknown field 'qualty'; an edit has time, edit_id, outcome, quality"),
        ({"outcome": "won"}, ValueError, "possible are success, failure, unmarked"),
        ({"trim": [0.0, 99.0]}, ValueError, r"The trim ends at 99.00 s, but take-1 at 0.01 s"),
        ({"put_segments": [Segment(0.0, 9.0, "lift")]}, ValueError, "segment 'lift' ends at 9.00 s"),
        ({"undo": "nothing"}, KeyError, "No edit 'nothing' to take back"),
    ],
)
def test_a_refused_edit_leaves_no_trace(
    data: Path, catalog: Catalog, changes: dict[str, object], error: type[Exception], message: str
) -> None:
    path = record(data, "take-1")
    with pytest.raises(error, match=message):
        catalog.annotate("take-1", author="ann", **changes)
    assert read(edits_path(path)).version == 0


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda c: c.episodes(sort="beauty"), ValueError, "Cannot sort by 'beauty'; possible are started"),
        (lambda c: c.episodes(limit=-1), ValueError, "limit and offset of 0 or more, not -1 and 0"),
        (lambda c: c.episodes(outcome="won"), ValueError, "possible are success, failure, unmarked"),
        (lambda c: c.count(min_quality=7), ValueError, "Quality 7"),
        (lambda c: c.facets(flags="jittery"), ValueError, "list of words, not 'jittery'"),
        (lambda c: c.episodes(text="!?"), ValueError, r"Nothing to search for in '!\?'"),
        (lambda c: c.episodes(colour="red"), TypeError, "Unknown filter 'colour'; possible are task"),
    ],
)
def test_a_bad_question_is_refused_with_what_is_possible(
    catalog: Catalog, call: Callable[[Catalog], object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        call(catalog)


def test_a_data_folder_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "data").write_text("")
    with pytest.raises(NotADirectoryError, match="is a file; a data folder is needed"):
        Catalog(tmp_path / "data")


# Several threads and processes.


def test_threads_that_share_a_catalogue_lose_nothing(data: Path) -> None:
    make_up(data, 4)
    with Catalog(data, made_up) as catalog, ThreadPoolExecutor(4) as pool:

        def annotate(number: int) -> None:
            catalog.annotate(f"take-{number % 4:04d}", author="ann", add_flags=(f"flag{number}",))
            catalog.refresh()
            catalog.facets()

        list(pool.map(annotate, range(40)))
        assert catalog.facets()["flags"] == {f"flag{number}": 1 for number in range(40)}


def _work(data: Path, author: str, n_edits: int) -> None:
    """Annotates some takes over and over, deletes and restores others, and looks around meanwhile."""
    rng = random.Random(author)
    with Catalog(data, made_up) as catalog:
        for number in range(n_edits):
            episode_id = f"take-{number % 10:04d}"
            catalog.annotate(episode_id, author=author, add_flags=(f"{author}{number}",))
            other = f"take-{rng.randrange(10, 20):04d}"
            move = catalog.delete if rng.random() < 0.5 else catalog.restore
            with suppress(KeyError):  # it is there already
                move(other)
            catalog.refresh()


def test_processes_that_share_a_folder_lose_nothing_and_agree(data: Path) -> None:
    make_up(data, 20)
    authors, n_edits = ("ann", "bob"), 30
    spawn = multiprocessing.get_context("spawn")
    workers = [spawn.Process(target=_work, args=(data, author, n_edits)) for author in authors]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert [worker.exitcode for worker in workers] == [0, 0]
    with Catalog(data, made_up) as catalog:
        rows = [*catalog.episodes(limit=None), *catalog.trash()]
        said = {flag for row in rows for flag in row.flags}
        assert said == {f"{author}{number}" for author in authors for number in range(n_edits)}
        assert len(rows) == 20
        assert catalog.refresh().indexed == 0  # the index was up to date
        before = [dataclasses.asdict(row) for row in catalog.episodes(limit=None)]
        catalog.rebuild()
        assert [dataclasses.asdict(row) for row in catalog.episodes(limit=None)] == before


# What the recorder sums up while it writes.


def test_what_is_summed_up_while_recording_is_what_is_counted_afterwards(data: Path) -> None:
    forces = (0.0, 0.5, 3.0, 5.0, math.nan, 2.0)
    for path in (
        record(data, "take-1", forces, cameras={"front": (8, 6)}),
        record(data, "take-2", (math.nan,), success=None),
        record(data, "take-3", ()),
    ):
        summed = totals_of(path)
        assert summed is not None
        with open_episode(path) as episode:
            counted = episode.totals
            assert summed[0] == episode.header
        assert summed[1] == dataclasses.replace(
            counted,
            mean_force=pytest.approx(counted.mean_force, rel=1e-12),
            duration=pytest.approx(counted.duration, abs=1e-9),
        )


def test_an_older_take_without_sums_is_read_whole(data: Path) -> None:
    path = record(data, "take-1", (3.0, 5.0))
    summed = summarise(path)
    old = path.read_bytes().replace(b'{"duration"', b'{"durat1on"')
    assert old != path.read_bytes()
    path.write_bytes(old)
    assert totals_of(path) is None
    assert dataclasses.replace(summarise(path), duration=summed.duration) == summed


# What changes are heard of.


def test_a_revision_tells_every_change_whoever_makes_it(data: Path, catalog: Catalog) -> None:
    seen = [catalog.revision()]

    def has_changed() -> bool:
        seen.append(catalog.revision())
        return seen[-1] not in seen[:-1]

    record(data, "take-1")
    catalog.refresh()
    assert has_changed()
    assert not has_changed()
    catalog.episodes()
    assert not has_changed()
    catalog.annotate("take-1", author="ann", quality=3)
    assert has_changed()
    with Catalog(data) as of_another_process:
        of_another_process.annotate("take-1", author="bob", quality=4)
    assert has_changed()
    collections.create(catalog, "some", author="ann", episode_ids=["take-1"])
    assert has_changed()


def test_how_long_each_stiffness_was_used_adds_up_to_the_whole(data: Path) -> None:
    tally = StiffnessTally({})
    pose = Pose.identity()
    soft, stiff = (
        CartesianTarget(pose, stiffness_of(mode)) for mode in (StiffnessMode.LOW, StiffnessMode.HIGH)
    )
    for targets in ((Hold(), soft), (Hold(), Hold()), (JointTarget(np.zeros(6)), stiff), (stiff, Release())):
        tally.add(Action(tuple(ArmAction(target, 1.0) for target in targets)))
    # The first arm was told nothing for two ticks; held arms stay as stiff as they were.
    assert tally.shares == {"high": 0.5, "low": 0.3333, "joint control": 0.1667}
    assert StiffnessTally({}).shares == {}


def test_shares_of_stiffness_are_the_same_summed_up_and_counted_anew(
    recorded: tuple[Path, DemoReport],
) -> None:
    with Catalog(recorded[0]) as catalog:
        for row in catalog.episodes():
            with open_episode(row.path) as episode:
                assert episode.totals.stiffness_share == row.stiffness_share
                (arm,) = Cursor(episode).arms
                spans = {span.label: 0.0 for span in arm.modes}
                for span in arm.modes:
                    spans[span.label] += (span.end - span.start) / episode.duration
            assert row.stiffness_share == pytest.approx(spans, abs=0.02)
            assert sum(row.stiffness_share.values()) == pytest.approx(1.0, abs=1e-3)
