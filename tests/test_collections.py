"""A collection names takes as they were, whatever is edited, deleted or recorded after it."""

from __future__ import annotations

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from policy.config import TrainConfig
from studio import collections
from studio.__main__ import main
from studio.api import DemoReport, Studio
from studio.catalog import InUseError
from studio.collections import Member
from studio.edits import Segment, read
from studio.training import Chosen


@pytest.fixture
def data(tmp_path: Path, recorded: tuple[Path, DemoReport]) -> Path:
    """A copy of the data folder with two takes of seeds 7 and 8, to write to."""
    return Path(shutil.copytree(recorded[0], tmp_path / "data"))


@pytest.fixture
def ids(recorded: tuple[Path, DemoReport]) -> list[str]:
    return recorded[1].ids


def told(studio: Studio, name: str) -> list[tuple[str, str, str]]:
    return [(change.episode_id, change.kind, change.text) for change in studio.collection_changes(name)]


def test_a_collection_keeps_takes_as_they_were(data: Path, ids: list[str]) -> None:
    with Studio(data) as studio:
        studio.annotate(ids[0], quality=4, trim=(0.5, 2.0))
        before = studio.catalog.get(ids[0])
        made = studio.make_collection("clean", episode_ids=ids[::-1], author="ann", note="for the paper")
        assert made.members == (Member(ids[1], 0), Member(ids[0], 1))
        assert (made.author, made.note, made.filters) == ("ann", "for the paper", {})
        assert told(studio, "clean") == []
        studio.annotate(ids[0], quality=2, trim=(1.0, 3.0), outcome="failure", add_flags=("jittery",))
        studio.annotate(ids[0], put_segments=(Segment(0.1, 0.2, "lift"),))
        assert told(studio, "clean") == [
            (
                ids[0],
                "edited",
                "outcome as recorded → failure; quality 4 → 2; flags none → jittery; "
                "trim 0.5, 2.0 → 1.0, 3.0; segments none → lift",
            )
        ]
        assert studio.collection("clean") == made
        assert studio.collection_rows("clean") == [studio.catalog.get(ids[1]), before]


def test_a_collection_made_of_filters_tells_what_matches_since(data: Path, ids: list[str]) -> None:
    with Studio(data) as studio:
        studio.annotate(ids[1], outcome="failure")
        made = studio.make_collection("good", filters={"outcome": "success", "task": "wiping", "flags": None})
        assert [member.episode_id for member in made.members] == [ids[0]]
        assert made.filters == {"outcome": "success", "task": "wiping"}
        studio.annotate(ids[1], outcome="success")
        assert told(studio, "good") == [(ids[1], "new", "It matches by now.")]
        studio.delete(ids[0], even_if_used=True)
        assert told(studio, "good")[0][:2] == (ids[0], "deleted")
        with pytest.raises(KeyError, match="is in the trash"):
            studio.collection_rows("good")
        for file in data.glob(f"trash/*/{ids[0]}*"):
            file.unlink()
        assert told(studio, "good")[0][:2] == (ids[0], "gone")


def test_a_take_in_a_collection_is_deleted_only_by_who_insists(data: Path, ids: list[str]) -> None:
    with Studio(data) as studio:
        for name in ("one", "two"):
            studio.make_collection(name, episode_ids=ids[:1])
        with pytest.raises(InUseError, match=f"{ids[0]} is in one, two: a collection names"):
            studio.delete(ids[0])
        assert studio.catalog.get(ids[0]).path.exists()
        studio.delete(ids[1])
        for name in ("one", "two"):
            studio.delete_collection(name)
        studio.delete(ids[0])
        assert studio.episodes() == []


def test_deleting_a_collection_and_restoring_it_are_inverse(data: Path, ids: list[str]) -> None:
    with Studio(data) as studio:
        made = studio.make_collection("one", episode_ids=ids)
        studio.delete_collection("one")
        assert studio.collections() == []
        assert len(studio.episodes()) == 2  # its takes stay
        with pytest.raises(KeyError, match="No collection 'one'; there are none"):
            studio.collection("one")
        assert studio.restore_collection("one") == made
        assert studio.collections() == [made]
        studio.delete_collection("one")
        studio.make_collection("one", episode_ids=ids[:1])
        with pytest.raises(ValueError, match="There is a collection one by now"):
            studio.restore_collection("one")


def test_a_name_is_given_once_however_many_ask_for_it(data: Path, ids: list[str]) -> None:
    with Studio(data) as studio, ThreadPoolExecutor(4) as pool:

        def make(number: int) -> bool:
            try:
                studio.make_collection("one", episode_ids=ids, author=f"person {number}")
            except ValueError:
                return False
            return True

        assert sum(pool.map(make, range(8))) == 1
        assert [path.name for path in (data / "collections").iterdir()] == ["one.json"]
        with pytest.raises(ValueError, match="There is a collection one already"):
            studio.make_collection("one", episode_ids=ids)


@pytest.mark.parametrize(
    ("name", "given", "error", "message"),
    [
        ("../evil", {"episode_ids": []}, ValueError, "cannot name a collection; use at most 100 letters"),
        ("a" * 101, {"episode_ids": []}, ValueError, "cannot name a collection"),
        ("", {"episode_ids": []}, ValueError, "cannot name a collection"),
        ("one", {}, ValueError, "made of episode ids, or of filters: give one"),
        ("one", {"episode_ids": ["x"], "filters": {"task": "wiping"}}, ValueError, "give one"),
        ("one", {"episode_ids": []}, ValueError, "at least one take"),
        ("one", {"filters": {"task": "drawing"}}, ValueError, "No take matches {'task': 'drawing'}"),
        ("one", {"filters": {"colour": "red"}}, TypeError, "Unknown filter 'colour'"),
        ("one", {"episode_ids": ["x"]}, KeyError, "No episode 'x'"),
    ],
)
def test_what_cannot_be_a_collection_leaves_no_file(
    data: Path, name: str, given: dict[str, object], error: type[Exception], message: str
) -> None:
    with Studio(data) as studio:
        with pytest.raises(error, match=message):
            studio.make_collection(name, **given)  # type: ignore[arg-type]
        assert studio.collections() == []
        assert not list(data.glob("collections/*"))


def test_an_unknown_or_damaged_collection_is_named_and_hides_no_other(
    data: Path, ids: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    with Studio(data) as studio:
        made = studio.make_collection("one", episode_ids=ids)
        (data / "collections" / "bad.json").write_text("{")
        assert studio.collections() == [made]
        assert "bad.json is no collection" in caplog.text
        with pytest.raises(ValueError, match=r"bad\.json is no collection"):
            studio.collection("bad")
        for name in ("nothing", "../one", "", "x/../one"):
            with pytest.raises(KeyError, match="No collection"):
                studio.collection(name)


def test_a_run_learns_from_exactly_what_a_collection_names(data: Path, ids: list[str]) -> None:
    config = TrainConfig(images=False, device="cpu")
    with Studio(data) as studio:
        studio.annotate(ids[0], trim=(0.5, 2.0))
        studio.annotate(ids[1], outcome="failure")
        studio.make_collection("both", episode_ids=ids)
        studio.annotate(ids[0], trim=(1.0, 3.0))
        run = studio.begin_run("wiping", config, "run", collection="both")
        assert run.takes == (Chosen(ids[0], (0.5, 2.0), 1), Chosen(ids[1], None, 1))
        with pytest.raises(ValueError, match="leave out all filters"):
            studio.begin_run("wiping", config, "a", filters={"agent": "xr"}, collection="both")
        with pytest.raises(ValueError, match="has takes of wiping, too, not only of drawing"):
            studio.begin_run("drawing", config, "b", collection="both")
        with pytest.raises(KeyError, match="No collection 'neither'; there are both"):
            studio.begin_run("wiping", config, "c", collection="neither")


def test_one_edit_goes_to_all_takes_or_to_none(data: Path, ids: list[str]) -> None:
    with Studio(data) as studio:
        rows = studio.annotate_all([*ids, ids[0]], author="ann", quality=3, add_flags=("jittery",))
        assert [(row.episode_id, row.quality, row.edit_version) for row in rows] == [(i, 3, 1) for i in ids]
        assert studio.catalog.facets()["flags"] == {"jittery": 2}
        assert studio.catalog.undo(ids[0], author="ann").quality is None
        for given, changes, error in (
            ([*ids, "nothing"], {"quality": 1}, KeyError),
            (ids, {"quality": 9}, ValueError),
            (ids, {"trim": (0.0, studio.catalog.get(ids[0]).duration)}, ValueError),  # the other is shorter
            (ids, {"undo": "x"}, KeyError),
            (ids, {}, ValueError),
        ):
            versions = [read(row.path.with_suffix(".edits.jsonl")).version for row in rows]
            longest_first = sorted(given, key=lambda i: i != ids[0])
            with pytest.raises(error):
                studio.annotate_all(longest_first, author="ann", **changes)  # type: ignore[arg-type]
            assert [read(row.path.with_suffix(".edits.jsonl")).version for row in rows] == versions
        studio.annotate_all(ids, author="ann", edit_id="both", quality=5)
        assert {row.quality for row in studio.annotate_all(ids, author="ann", undo="both")} == {None, 3}


def run_studio(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    said = capsys.readouterr()
    return int(ended.value.code or 0), said.out, said.err


def test_the_commands_make_show_delete_and_restore(
    data: Path, ids: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    where = ("--data", str(data))
    assert "No collections in" in run_studio(capsys, "collections", *where)[1]
    assert run_studio(capsys, "collection", "one", "--ids", *ids, "--note", "x", *where)[0] == 0
    assert run_studio(capsys, "collection", "two", "--task", "wiping", *where)[0] == 0
    listed = json.loads(run_studio(capsys, "collections", *where, "--json")[1])
    assert {told["name"]: len(told["members"]) for told in listed} == {"one": 2, "two": 2}
    status, _, said = run_studio(capsys, "delete", ids[0], *where)
    assert (status, "is in one, two" in said) == (2, True)
    assert run_studio(capsys, "delete", ids[0], "--even-if-used", *where)[0] == 0
    shown = run_studio(capsys, "collection", "one", *where)[1]
    assert f"deleted: {ids[0]}: It is in the trash." in shown
    assert run_studio(capsys, "collection", "one", "--delete", *where)[0] == 0
    assert run_studio(capsys, "collection", "one", *where)[0] == 2
    assert run_studio(capsys, "collection", "one", "--restore", *where)[0] == 0
    assert [told.name for told in collections.load_all(data)] == ["two", "one"]
    assert run_studio(capsys, "collection", "one", "--restore", "--delete", *where)[0] == 2
