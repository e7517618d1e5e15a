"""The HTTP API, through the typed client, the door and a real server; with a real session where it drives."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
import schemathesis
from http_site import Site, record
from hypothesis import HealthCheck, given, settings
from visitor import wait_for

from studio.client import Client, Refused
from studio.door import Access, Door
from studio.edits import edits_path, read
from studio.index import Filters
from studio.lease import GRACE
from studio.link import socket_path
from studio.messages import Drive, Reset, SetGripper, Shutdown, StartTake, builtins

TOKEN = "a-token-that-is-secret"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """With three takes of a second; tests leave them as they were."""
    data = tmp_path_factory.mktemp("api")
    record(data, 1.0, 1.0, 1.0)
    site = Site(data)
    yield site
    site.close()


# Takes


def test_what_is_found_is_what_the_catalogue_finds(site: Site, client: Client, ids: list[str]) -> None:
    rows = site.studio.episodes()
    assert client.episodes().episodes == rows
    page = client.episodes(sort="episode_id", descending=False, limit=1, offset=1, task="made-up")
    assert (page.total, [row.episode_id for row in page.episodes]) == (3, [sorted(ids)[1]])
    assert client.episodes(task="wiping").total == 0
    assert client.facets() == site.studio.catalog.facets()
    client.annotate(ids[0], note="slips off", add_flags=["jittery"], quality=2)
    asked: Filters = {"text": "slip", "flags": ["jittery"], "min_quality": 2}
    assert [row.episode_id for row in client.episodes(**asked).episodes] == [ids[0]]
    client.undo(ids[0])
    assert client.episodes(**asked).total == 0


def test_columns_and_images_are_those_of_the_take(
    site: Site, client: Client, ids: list[str], tmp_path: Path
) -> None:
    with site.studio.open(ids[0]) as episode:
        columns = episode.columns("left/state", "tick")
        given = client.columns(ids[0], "left/state", "tick")
        assert given.keys() == columns.keys()
        assert all(np.array_equal(given[name], columns[name], equal_nan=True) for name in columns)
        assert client.columns(ids[0]).keys() == episode.columns().keys()
        thin = client.columns(ids[0], "left/applied", every=10)["left/applied/kind"]
        assert np.array_equal(thin, episode.columns("left/applied")["left/applied/kind"][::10])
        address = f"{site.front.url}/api/v1/episodes/{ids[0]}/columns"
        told = httpx.get(address, params={"group": ["left/applied"]}).json()
        assert told["left/applied/q"][0] == [None] * 6  # NaN, as it goes by Cartesian targets
        assert client.image_times(ids[0])["front"] == episode.image_times("front").tolist()
        assert client.jpeg(ids[0], "front", 3) == episode.jpeg("front", 3)
        assert client.jpeg_at(ids[0], "front", 0.2499) == episode.jpeg("front", 4)
        assert cv2.imdecode(np.frombuffer(client.jpeg(ids[0], "front", 0), np.uint8), 1).shape == (
            240,
            320,
            3,
        )
        details = client.episode(ids[0])
        assert details.row == site.studio.catalog.get(ids[0])
        assert details.header["arms"] == ["left", "right"]
        assert details.images == {"front": 20, "left_wrist": 20, "right_wrist": 20}
        client.download(ids[0], tmp_path / "take.mcap")
        assert (tmp_path / "take.mcap").read_bytes() == episode.path.read_bytes()


def test_two_authors_annotate_and_each_takes_back_their_own(
    site: Site, client: Client, ids: list[str]
) -> None:
    segment = {"start": 0.1, "end": 0.4, "label": "lift", "segment_id": "s"}
    with Client(site.front.url, author="bob") as other:
        client.annotate(ids[1], quality=4, trim=(0.1, 0.9), put_segments=[segment])
        assert other.annotate(ids[1], outcome="failure").edit_version == 2
        row = client.undo(ids[1])
        assert (row.quality, row.outcome) == (None, "failure")
        assert other.undo(ids[1]).outcome == "unmarked"
        history = client.episode(ids[1]).history
        assert [edit.author for edit in history] == ["ann", "bob", "ann", "bob"]
    rows = client.annotate_all(ids[:2], quality=3)
    assert [row.quality for row in rows] == [3, 3]
    for episode_id in ids[:2]:
        client.undo(episode_id)


def test_deleting_and_restoring_are_inverse(client: Client, ids: list[str]) -> None:
    before = client.episodes()
    deleted = client.delete(ids[2])
    assert client.trash() == [deleted]
    assert client.episodes().total == 2
    client.restore(ids[2])
    assert client.episodes() == before


def test_collections_name_takes_as_they_are(client: Client, ids: list[str]) -> None:
    made = client.make_collection("first", episode_ids=ids[:2], note="x")
    asked = client.make_collection("second", filters={"task": "made-up"})
    assert (len(asked.members), asked.filters) == (3, {"task": "made-up"})
    assert [found.name for found in client.collections()] == ["second", "first"]
    client.annotate(ids[0], quality=5)
    details = client.collection("first")
    assert details.collection == made
    assert [(change.episode_id, change.kind) for change in details.changes] == [(ids[0], "edited")]
    assert [row.quality for row in client.collection_episodes("first")] == [None, None]
    client.undo(ids[0])
    with pytest.raises(Refused, match="is in first, second: a collection names") as refused:
        client.delete(ids[0])
    assert refused.value.status == 409
    client.delete_collection("first")
    client.delete_collection("second")
    client.delete(client.restore(client.delete(ids[0]).episode_id).episode_id)
    client.restore(ids[0])
    assert client.restore_collection("first") == made
    client.delete_collection("first")


def test_health_is_told_for_one_and_for_all(site: Site, client: Client, ids: list[str]) -> None:
    told = client.health_of(ids[0])
    assert told.grades == {ids[0]: "fair"}  # it is made of noise
    assert {finding.kind for finding in told.together.takes[0].findings} >= {"velocity_spike"}
    found = client.health(task="made-up")
    assert (found.unexamined, sorted(found.grades)) == (0, sorted(ids))
    assert found.together == site.studio.health()


def test_tasks_runs_and_evaluations_are_listed(client: Client) -> None:
    assert {task.task for task in client.tasks()} > {"wiping", "peg-cylinder"}
    assert client.tasks()[0].arms
    assert client.runs() == []
    assert client.evaluations() == []


# Bad input


def test_what_is_refused_says_why_and_touches_nothing(site: Site, client: Client, ids: list[str]) -> None:
    part = site.studio.data_dir / "episodes" / "made-up" / "running.mcap.part"
    part.write_bytes(b"")
    paths = [site.studio.catalog.get(i).path for i in ids]
    before = [(read(edits_path(path)).version, path.stat()) for path in paths]
    cases = [
        (lambda: client.annotate("running", quality=3), 409, "'running' is still being recorded"),
        (lambda: client.delete("running"), 409, "still being recorded"),
        (lambda: client.annotate(ids[0] + "x", quality=3), 404, "No episode"),
        (lambda: client.annotate_all([*ids, "nothing"], quality=3), 404, "No episode 'nothing'"),
        (lambda: client.annotate("../../etc/passwd", quality=3), 404, "No"),
        (lambda: client.annotate(ids[0], quality=9), 422, "less than or equal to 5"),
        (lambda: client.annotate(ids[0], colour="red"), 422, "colour"),
        (lambda: client.annotate(ids[0]), 422, "changes nothing"),
        (lambda: client.annotate(ids[0], trim=(0.0, 99.0)), 422, "The trim ends at 99.00 s"),
        (lambda: client.annotate(ids[0], undo="x"), 404, "No edit 'x'"),
        (lambda: client.annotate(ids[0], author=" ", quality=1), 422, "needs an author"),
        (lambda: client.undo(ids[0] + "x"), 404, "No episode"),
        (lambda: client.delete("nothing"), 404, "No episode 'nothing'"),
        (lambda: client.restore(ids[0]), 404, "in the trash; it has none"),
        (lambda: client.columns(ids[0], "middle/state"), 404, "No columns 'middle/state'"),
        (lambda: client.jpeg(ids[0], "front", 99), 404, "No image 99"),
        (lambda: client.jpeg(ids[0], "back", 0), 404, "No camera 'back'"),
        (lambda: client.episodes(sort="beauty"), 422, "sort"),
        (lambda: client.episodes(text="!?"), 422, "Nothing to search for"),
        (lambda: client.episodes(limit=10**6), 422, "limit"),
        (lambda: client.episodes(seed=2**80), 422, "seed"),
        (lambda: client.episodes(colour="red"), 422, "colour"),  # type: ignore[call-arg]
        (lambda: client.make_collection("../x", episode_ids=ids), 422, "cannot name a collection"),
        (lambda: client.make_collection("x"), 422, "give one of them"),
        (lambda: client.collection("../x"), 404, "No"),
        (lambda: client.delete_collection("x"), 404, "No collection 'x'"),
    ]
    try:
        for act, status, why in cases:
            with pytest.raises(Refused) as refused:
                act()
            assert refused.value.status == status, refused.value
            assert why in str(refused.value)
    finally:
        part.unlink()
    assert [(read(edits_path(path)).version, path.stat()) for path in paths] == before


def test_without_the_token_there_is_no_api(tmp_path: Path) -> None:
    site = Site(tmp_path, host="0.0.0.0", token=TOKEN)
    try:
        for path in ("/api/v1/episodes", "/api/docs", "/api/v1/session/events", "/api/v1/openapi.json"):
            assert httpx.get(site.front.url + path).status_code == 401
        with pytest.raises(Refused, match="lets nobody in without its token"):
            Client(site.front.url, "wrong")
        with Client(site.front.url, TOKEN) as client:
            assert client.episodes().total == 0
        elsewhere = {"Origin": "http://elsewhere", "Authorization": f"Bearer {TOKEN}"}
        answer = httpx.post(f"{site.front.url}/api/v1/refresh", headers=elsewhere)
        assert answer.status_code == 403
    finally:
        site.close()


def test_the_description_can_be_looked_at_without_the_internet(site: Site) -> None:
    page = httpx.get(f"{site.front.url}/api/docs").text
    assert "swagger-ui-bundle.js" in page
    assert "https://" not in page
    paths = httpx.get(f"{site.front.url}/api/v1/openapi.json").json()["paths"]
    command = paths["/api/v1/session/commands"]["post"]["requestBody"]["content"]["application/json"][
        "schema"
    ]
    named = {told["title"] for told in command["anyOf"]}
    assert {"Reset", "StartTake", "MoveTo"} <= named
    assert not {"Shutdown", "Hands"} & named


def test_a_reader_that_dies_is_started_again(site: Site, client: Client, ids: list[str]) -> None:
    client.columns(ids[0], "tick")
    pool = site.reader._pool
    assert pool is not None
    for process in pool._processes.values():
        process.kill()
    assert "tick/time" in client.columns(ids[0], "tick")


# The live session


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """With a session process on the task with two pegs."""
    data = tmp_path_factory.mktemp("live")
    command = [sys.executable, "-m", "studio.live", "--data", str(data), "--no-cameras", "--task", "wiping"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    site = Site(data)
    site.remote.connect(socket_path(data))
    yield site
    site.close()
    process.kill()
    process.wait()


def test_a_program_drives_as_long_as_its_stream_is_open(live: Site) -> None:
    with Client(live.front.url) as client:
        with pytest.raises(Refused, match="session/events first") as refused:
            client._post("/session/commands", dict, builtins(Reset(seed=3)))
        assert refused.value.status == 409
        with client.session("ana") as session:
            wait_for(lambda: session.status.get()[0])
            assert live.lease.holder == ""
            session.post(Reset(seed=41))
            wait_for(lambda: session.status.get()[0].seed == 41)
            assert live.lease.holder == "ana"
            session.post(Drive(driver="operator"))
            status = wait_for(lambda: (s := session.status.get()[0]).driver == "operator" and s)
            assert status.operator == "ana"
            assert session.wait_for(session.frame).arms[0].base_from_tcp
            assert client.status()["status"]["driver"] == "operator"
        wait_for(lambda: not live.lease.holder, GRACE + 5)
        wait_for(lambda: client.status()["status"]["driver"] == "nobody")


def test_who_does_not_drive_is_refused_and_may_ask(live: Site) -> None:
    with (
        Client(live.front.url) as one,
        Client(live.front.url) as other,
        one.session("ana") as first,
        other.session("bob") as second,
    ):
        assert first.control("ask").is_mine
        for command in (Reset(seed=5), SetGripper(arm=0, opening=0.5), StartTake()):
            with pytest.raises(Refused, match="ana has control") as refused:
                second.post(command)
            assert refused.value.status == 409
        assert second.control("ask").is_asked_by_me
        assert not first.control("give up").is_mine
        second.post(Reset(seed=6))
        wait_for(lambda: second.status.get()[0].seed == 6)
    wait_for(lambda: not live.lease.holder, GRACE + 5)


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"{",
        b"[]",
        b'{"type": "Dance"}',
        b'{"type": "Reset"}',
        b'{"type": "Reset", "seed": -1}',
        b"\xff\xfe",
    ],
)
def test_what_is_no_command_is_refused(live: Site, body: bytes) -> None:
    answer = httpx.post(f"{live.front.url}/api/v1/session/commands", content=body)
    assert answer.status_code == 422
    answer = httpx.post(f"{live.front.url}/api/v1/session/commands", content=json.dumps(builtins(Shutdown())))
    assert answer.status_code == 422


def test_a_stream_tells_at_the_rate_that_was_asked_for(live: Site) -> None:
    with Client(live.front.url) as client:
        with client.session(rate=5.0) as session:
            wait_for(lambda: session.frame.get()[0])
            begin, (_, before) = time.monotonic(), session.frame.get()
            time.sleep(1.0)
            rate = (session.frame.get()[1] - before) / (time.monotonic() - begin)
            assert rate <= 5.5
        with client.session(rate=0.0) as session:
            wait_for(lambda: session.status.get()[0])
            assert session.frame.get()[0] is None
    wait_for(lambda: not [t for t in threading.enumerate() if t.name == "session events"])


# The whole description


@pytest.mark.parametrize("examples", [3, pytest.param(150, marks=pytest.mark.verify)])
def test_nothing_that_the_description_allows_breaks_the_server(tmp_path: Path, examples: int) -> None:
    """Half of the requests are about a take, a camera and a collection that exist."""
    record(tmp_path, 1.0, 1.0)
    site = Site(tmp_path)
    site.studio.jobs.slots = 0  # what is asked for waits
    rows = site.studio.episodes()
    real = {"episode_id": rows[0].episode_id, "camera": "front", "name": "known", "number": 3, "at": 0.2}
    site.studio.make_collection("known", episode_ids=[rows[1].episode_id])
    app = Door(site.app, [], Access.of_everybody())
    schema = schemathesis.openapi.from_asgi("/api/v1/openapi.json", app)
    schema = schema.exclude(path_regex="/session/events")  # it does not end
    quiet = settings(max_examples=examples, deadline=None, database=None, suppress_health_check=HealthCheck)
    asked = Counter[str]()
    for result in schema.get_all_operations():
        operation = result.ok()

        @quiet
        @given(case=operation.as_strategy())
        def check(case: schemathesis.Case) -> None:
            if asked.total() % 2:
                known = case.path_parameters.keys() & real.keys()
                case.path_parameters |= {name: real[name] for name in known}
            answer = case.call()
            asked[case.operation.label] += 1
            assert answer.status_code < 500, (case.as_curl_command(), answer.text)

        check()
    assert len(asked) > 25
    site.close()
