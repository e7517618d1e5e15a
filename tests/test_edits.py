"""Laws of the sidecar: nothing is lost, whoever writes, and everything can be taken back."""

import json
import multiprocessing
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from studio.edits import (
    FLAGS,
    Edit,
    Edits,
    Segment,
    append,
    edits_path,
    fold,
    merge,
    read,
)


@pytest.fixture
def sidecar(tmp_path: Path) -> Path:
    return edits_path(tmp_path / "take.mcap")


def test_a_take_without_sidecar_has_no_edits(sidecar: Path) -> None:
    assert read(sidecar) == Edits()
    assert not sidecar.exists()


def test_what_is_appended_is_read(sidecar: Path) -> None:
    edit = Edit(
        author="ann",
        outcome="success",
        quality=4,
        note="Überschwinger am Rand ✓",
        trim=(0.5, 12.0),
        add_flags=("jittery", "own_flag"),
        put_segments=(Segment(1.0, 2.0, "contact"),),
    )
    append(sidecar, edit)
    assert read(sidecar).history == (edit,)


def test_the_newest_scalar_wins_and_clearing_goes_back_to_what_was_recorded(sidecar: Path) -> None:
    append(sidecar, Edit(author="ann", outcome="success", quality=2, trim=(0, 3)))
    append(sidecar, Edit(author="bob", quality=5))
    append(sidecar, Edit(author="bob", clear=("outcome", "trim")))
    edits = read(sidecar)
    assert (edits.outcome, edits.quality, edits.trim) == (None, 5, None)


def test_flags_and_segments_of_two_people_survive_each_other(sidecar: Path) -> None:
    contact, lift = Segment(1.0, 2.0, "contact"), Segment(3.0, 4.0, "lift")
    append(sidecar, Edit(author="ann", add_flags=("jittery",), put_segments=(contact,)))
    append(sidecar, Edit(author="bob", add_flags=("collision",), put_segments=(lift,)))
    moved = Segment(1.5, 2.5, "contact", contact.segment_id)
    append(sidecar, Edit(author="ann", put_segments=(moved,), remove_flags=("jittery",)))
    edits = read(sidecar)
    assert edits.flags == ("collision",)
    assert edits.segments == (moved, lift)
    append(sidecar, Edit(author="bob", remove_segments=(lift.segment_id,)))
    assert read(sidecar).segments == (moved,)


def test_undo_takes_back_one_edit_and_leaves_those_of_others(sidecar: Path) -> None:
    first = Edit(author="ann", quality=2, add_flags=("jittery",))
    append(sidecar, first)
    append(sidecar, Edit(author="bob", note="slips", add_flags=("jittery",)))
    mine = read(sidecar).undoable("ann")
    assert mine == first
    append(sidecar, Edit(author="ann", undo=mine.edit_id))
    edits = read(sidecar)
    assert (edits.quality, edits.note, edits.flags) == (None, "slips", ("jittery",))  # bob said jittery, too
    assert edits.undoable("ann") is None


def test_undoing_an_undo_brings_the_edit_back(sidecar: Path) -> None:
    edit = Edit(author="ann", quality=2)
    undo = Edit(author="ann", undo=edit.edit_id)
    append(sidecar, edit)
    append(sidecar, undo)
    append(sidecar, Edit(author="ann", undo=undo.edit_id))
    assert read(sidecar).quality == 2


def test_undoing_what_is_not_there_is_refused(sidecar: Path) -> None:
    append(sidecar, Edit(author="ann", quality=2, edit_id="only"))
    with pytest.raises(KeyError, match=r"No edit 'other'.*\['only'\]"):
        append(sidecar, Edit(author="ann", undo="other"))
    assert read(sidecar).version == 1


def test_an_earlier_version_can_be_read_again(sidecar: Path) -> None:
    for quality in (1, 2, 3):
        append(sidecar, Edit(author="ann", quality=quality))
    assert [read(sidecar, version).quality for version in range(4)] == [None, 1, 2, 3]
    with pytest.raises(ValueError, match="no version 4; it has 0 to 3"):
        read(sidecar, version=4)


edits_of_anyone = st.builds(
    Edit,
    author=st.sampled_from(["ann", "bob"]),
    quality=st.none() | st.integers(1, 5),
    note=st.none() | st.text(max_size=5),
    add_flags=st.lists(st.sampled_from(FLAGS), max_size=2).map(tuple),
    remove_flags=st.lists(st.sampled_from(FLAGS), max_size=2).map(tuple),
)


@given(st.lists(edits_of_anyone, max_size=6), edits_of_anyone)
def test_an_edit_and_its_undo_leave_no_trace(history: list[Edit], edit: Edit) -> None:
    before = fold(history)
    after = fold([*history, edit, Edit(author="bob", undo=edit.edit_id)])
    assert (after.quality, after.note, after.flags) == (before.quality, before.note, before.flags)


@pytest.mark.parametrize("cut", range(1, 40))
def test_a_torn_last_line_is_ignored_and_the_next_edit_starts_on_a_new_line(sidecar: Path, cut: int) -> None:
    append(sidecar, Edit(author="ann", quality=2))
    append(sidecar, Edit(author="bob", quality=5))
    sidecar.write_bytes(sidecar.read_bytes()[:-cut])
    torn = read(sidecar)
    assert torn.quality == (5 if cut == 1 else 2)  # a cut of 1 takes the newline only: the line is whole
    append(sidecar, Edit(author="bob", note="after"))
    assert (read(sidecar).quality, read(sidecar).note) == (torn.quality, "after")
    assert read(sidecar).version == torn.version + 1


def test_unknown_fields_and_values_are_kept(sidecar: Path) -> None:
    sidecar.write_text(
        '{"id": "x", "author": "ann", "time": 1.0, "mood": "good", "quality": 9, "note": "n"}\n'
    )
    edits = read(sidecar)
    assert (edits.note, edits.quality) == ("n", None)
    assert edits.more == {"mood": "good", "quality": 9}


@pytest.mark.parametrize("line", ["5", "[]", '"text"', "{", "\x00\x00", "", '{"flags": ["a"]}', '{"id": 3}'])
def test_a_foreign_line_stops_nobody(sidecar: Path, line: str) -> None:
    sidecar.write_text(f"{line}\n")
    append(sidecar, Edit(author="ann", quality=3))
    assert read(sidecar).quality == 3


def test_equal_lines_without_an_id_all_count(sidecar: Path) -> None:
    sidecar.write_text('{"quality": 3}\n{"quality": 4}\n{"quality": 3}\n')
    assert read(sidecar).quality == 3
    assert read(sidecar).version == 3


def test_merging_twice_adds_each_edit_once(tmp_path: Path) -> None:
    ours, theirs = tmp_path / "ours.edits.jsonl", tmp_path / "theirs.edits.jsonl"
    append(ours, Edit(author="ann", quality=3))
    append(theirs, Edit(author="bob", note="hi"))
    for _ in range(2):
        merge(theirs, ours)
    edits = read(ours)
    assert (edits.quality, edits.note, edits.version) == (3, "hi", 2)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"quality": 7}, "Quality 7 is not a whole number from 1"),
        ({"quality": 3.5}, "Quality 3.5"),
        ({"quality": True}, "Quality True"),
        ({"outcome": "won"}, "Unknown outcome 'won'; possible are success, failure, unmarked"),
        ({"trim": (3.0, 1.0)}, "0 <= in < out"),
        ({"trim": (0.0, float("nan"))}, "0 <= in < out"),
        ({"add_flags": "jittery"}, "tuple of words, not 'jittery'"),
        ({"add_flags": ("too hard",)}, "'too hard' has spaces"),
        ({"clear": ("history",)}, "possible are outcome, quality, note, trim"),
        ({"clear": ("quality",), "quality": 3}, "cannot set and clear quality"),
        ({"author": " "}, "author"),
    ],
)
def test_bad_values_are_refused_with_what_is_possible(fields: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Edit(**{"author": "ann", **fields})  # type: ignore[arg-type]


def test_a_segment_has_a_positive_length() -> None:
    with pytest.raises(ValueError, match=r"0 <= start < end in seconds, not 2.0 to 2.0"):
        Segment(2.0, 2.0, "contact")


def test_an_edit_that_says_nothing_is_refused(sidecar: Path) -> None:
    with pytest.raises(ValueError, match="changes nothing"):
        append(sidecar, Edit(author="ann"))
    assert not sidecar.exists()


def test_each_edit_is_one_json_line(sidecar: Path) -> None:
    append(sidecar, Edit(author="ann", note="first line\nsecond line"))
    (line,) = sidecar.read_text().splitlines()
    assert json.loads(line)["note"] == "first line\nsecond line"


def _write_many(sidecar: Path, author: str, n_edits: int) -> None:
    for number in range(n_edits):
        append(
            sidecar,
            Edit(author=author, note=f"{author} {number} " + "x" * 5000, add_flags=(f"{author}{number}",)),
        )


def test_edits_of_several_processes_survive_each_other(sidecar: Path) -> None:
    authors, n_edits = ("ann", "bob", "eve"), 20
    spawn = multiprocessing.get_context("spawn")
    writers = [spawn.Process(target=_write_many, args=(sidecar, author, n_edits)) for author in authors]
    for writer in writers:
        writer.start()
    versions = []
    while any(writer.is_alive() for writer in writers):
        versions.append(read(sidecar).version)
    for writer in writers:
        writer.join()
    assert [writer.exitcode for writer in writers] == [0, 0, 0]
    edits = read(sidecar)
    assert edits.version == len(authors) * n_edits
    assert set(edits.flags) == {f"{author}{number}" for author in authors for number in range(n_edits)}
    assert versions == sorted(versions)  # a reader never sees an edit vanish
