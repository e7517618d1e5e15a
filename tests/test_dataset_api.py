"""What the dataset page lives on: pictures, sums, grades, revisions, edits of many takes, undone too."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from http_site import Site, record
from test_catalog import record as record_forces
from visitor import wait_for

from studio.__main__ import main
from studio.client import Client, Refused
from studio.episode import open_episode
from studio.thumbnails import telling_moment


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """With three takes of a second that have images."""
    data = tmp_path_factory.mktemp("dataset")
    record(data, 1.0, 1.0, 1.0)
    site = Site(data)
    yield site
    site.close()


def test_the_page_loads_nothing_from_elsewhere(site: Site) -> None:
    answer = httpx.get(f"{site.front.url}/dataset")
    assert "default-src 'self'" in answer.headers["content-security-policy"]
    assert "http" not in answer.text


def test_a_thumbnail_is_small_and_sent_once(site: Site, client: Client, ids: list[str]) -> None:
    picture = client.thumbnail(ids[0])
    assert cv2.imdecode(np.frombuffer(picture, np.uint8), 1).shape == (144, 192, 3)
    address = f"{site.front.url}/api/v1/episodes/{ids[0]}/thumbnail"
    answer = httpx.get(address)
    assert (answer.content, answer.headers["content-type"]) == (picture, "image/jpeg")
    again = httpx.get(address, headers={"If-None-Match": answer.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert httpx.get(f"{site.front.url}/api/v1/episodes/{ids[1]}/thumbnail").content != b""
    with pytest.raises(Refused, match="No episode"):
        client.thumbnail("nothing")


def test_a_take_without_images_has_no_thumbnail(tmp_path: Path) -> None:
    path = record_forces(tmp_path, "blind")
    site = Site(tmp_path)
    try:
        address = f"{site.front.url}/api/v1/episodes/{path.stem}/thumbnail"
        answer = httpx.get(address, timeout=60.0)  # a process that reads is started first
        assert (answer.status_code, answer.json()["detail"]) == (404, "blind has no images.")
    finally:
        site.close()


def test_the_telling_moment_is_the_middle_of_the_first_contact(tmp_path: Path) -> None:
    forces = (0.0,) * 20 + (5.0,) * 40 + (0.0,) * 20 + (9.0,) * 10
    with open_episode(record_forces(tmp_path, "touches", forces)) as episode:
        assert telling_moment(episode) == pytest.approx(0.4, abs=0.01)  # 0.55 would be the middle of both
    with open_episode(record_forces(tmp_path, "floats", (0.0,) * 50)) as episode:
        assert telling_moment(episode) == pytest.approx(0.25, abs=0.01)


def test_revision_and_amount_follow_an_edit(client: Client, ids: list[str]) -> None:
    before, amount = client.revision(), client.amount(task="made-up")
    assert (amount.takes, amount.successes, amount.seconds) == (3, 0, pytest.approx(3.0, abs=0.02))
    assert client.revision() == before
    client.annotate(ids[0], outcome="success")
    assert client.amount().successes == 1
    assert client.revision() != before
    client.undo(ids[0])
    assert client.amount() == amount


def test_an_edit_of_many_takes_is_taken_back_in_one(client: Client, ids: list[str]) -> None:
    with Client(client._http.base_url.__str__(), author="bob") as bob:
        rows = client.annotate_all(ids, quality=2, add_flags=["jittery"], edit_id="mine")
        assert {row.quality for row in rows} == {2}
        bob.annotate(ids[0], quality=5)  # survives, as it is not ann's
        rows = client.annotate_all(ids, undo="mine")
        assert [(row.quality, row.flags) for row in rows] == [(5, ()), (None, ()), (None, ())]
        with pytest.raises(Refused, match="No edit 'other'"):
            client.annotate_all(ids, undo="other")
        bob.undo(ids[0])


def test_grades_are_known_of_those_that_were_examined(client: Client, ids: list[str]) -> None:
    assert client.grades(*ids) == {}
    client.health_of(ids[1])
    (graded,) = client.grades(*ids).values()
    assert graded.grade == "fair"
    assert graded.findings
    assert client._post("/dataset-health", dict, {"episode_ids": ids[:2]})["unexamined"] == 0
    assert client.grades(*ids).keys() == set(ids[:2])


def test_a_person_is_known_by_the_name_of_their_session(client: Client) -> None:
    assert client.name() == ""
    with client.session("Ana"):
        assert wait_for(client.name) == "Ana"


def studio(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    printed = capsys.readouterr()
    return int(ended.value.code or 0), printed.out, printed.err


def test_the_command_annotates_several_takes_or_those_that_match(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in range(3):
        record_forces(tmp_path, f"take-{number}", operator="ann" if number else "bob")
    data = ("--data", tmp_path, "--json")
    rows = json.loads(studio(capsys, "annotate", "take-0", "take-1", "--quality", 2, *data)[1])
    assert [row["quality"] for row in rows] == [2, 2]
    rows = json.loads(studio(capsys, "annotate", "--of-operator", "ann", "--outcome", "failure", *data)[1])
    assert sorted(row["episode_id"] for row in rows) == ["take-1", "take-2"]
    assert json.loads(studio(capsys, "annotate", "--of-operator", "eve", "--quality", 1, *data)[1]) == []
    code, _, told = studio(capsys, "annotate", "--quality", 1, "--data", tmp_path)
    assert code == 2
    assert "Name some episodes" in told
    assert studio(capsys, "annotate", "take-0", "--of-task", "wiping", "--quality", 1, *data)[0] == 2
