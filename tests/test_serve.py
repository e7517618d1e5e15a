"""`studio serve` with real processes: locks, orderly ends, and kills of each process."""

from __future__ import annotations

import json
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from served import Site, start_take
from visitor import Visitor, wait_for

from studio.api import Studio
from studio.link import socket_path
from studio.messages import Status
from studio.serve import LOCK, SessionProcess
from studio.server import start_viser
from studio.ui.app import Page
from studio.ui.gate import Gate
from studio.ui.remote import Remote


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    site = Site(tmp_path)
    yield site
    site.close()


def alive(pid: int) -> bool:
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rsplit(")", 1)[1].split()[0] != "Z"


def test_a_second_server_and_a_busy_port_are_refused_and_the_first_ends_in_order(
    site: Site, tmp_path_factory: pytest.TempPathFactory
) -> None:
    data, served = site.data, site.serve()
    url = served.url()
    health = served.health(url)
    assert (health["session"], health["phase"], health["take"]) == ("open", "idle", None)
    assert json.loads((data / LOCK).read_text()) == {"pid": served.process.pid, "url": url}

    second = site.serve()
    _, complaint = second.process.communicate(timeout=30)
    assert second.process.returncode == 1
    assert complaint.strip().splitlines() == [
        f"studio: {data} is served already at {url} (process {served.process.pid})."
    ]
    other = site.serve("--port", url.rpartition(":")[2], data=tmp_path_factory.mktemp("other"))
    _, complaint = other.process.communicate(timeout=30)
    assert other.process.returncode == 1
    assert len(complaint.strip().splitlines()) == 1
    assert "in use" in complaint

    remote = start_take(data)
    session = health["session_pid"]
    assert served.end(signal.SIGINT) == 0
    assert not alive(session)
    assert wait_for(lambda: remote.state == "closed")
    assert [path.suffix for path in data.glob("episodes/wiping/*")] == [".mcap"]  # kept, not torn
    assert not (data / LOCK).read_text()


def test_a_take_goes_on_while_the_web_process_is_killed_and_comes_back(site: Site) -> None:
    first = site.serve()
    health = first.health(first.url())
    remote = start_take(site.data)
    first.end(signal.SIGKILL)
    status, _ = remote.status.get()
    assert status is not None
    before = status.take_seconds
    second = site.serve()
    again = second.health(second.url())
    assert any(f"process {health['session_pid']}" in line for line in second.said)
    assert (again["session_pid"], again["take"]) == (health["session_pid"], status.take_id)
    assert wait_for(lambda: (now := remote.status.get()[0]) and now.take_seconds > before + 0.5)
    assert second.end() == 0


def test_a_session_killed_while_recording_is_restarted_and_its_take_recovered(site: Site) -> None:
    data = site.data
    gate = Gate()
    viewer = start_viser(arrive=gate.arrive)
    process = SessionProcess(data, "wiping", cameras=False)
    with Studio(data) as studio:
        page = Page(viewer, studio, process, gate)
        process.start()
        process.connect(page.remote)
        page.start()
        assert process.pid is not None
        killed = process.pid
        remote = start_take(data)
        wait_for(lambda: (now := remote.status.get()[0]) and now.take_seconds > 1.0)
        os.kill(killed, signal.SIGKILL)
        wait_for(lambda: page.remote.state == "closed")
        (torn,) = data.glob("episodes/wiping/*.part")
        page.restart_session()
        wait_for(lambda: page.remote.state == "open" and process.pid not in (None, killed))
        (recovered,) = data.glob("episodes/wiping/*.mcap")
        assert recovered.name == torn.name.removesuffix(".part")
        (row,) = studio.episodes()
        assert row.duration > 1.0 - 0.5  # a crash costs half a second at most
        remote.close()
        page.close()
    viewer.stop()
    process.end()
    assert process.find() is None


LINK = re.compile(r"http://\S+:(\d+)/\?token=(\S+)")


def cookie(port: str, token: str) -> dict[str, str]:
    """Of a browser that has opened the link."""
    answer = httpx.get(f"http://127.0.0.1:{port}/", params={"token": token})
    return {"Cookie": answer.headers["Set-Cookie"].partition(";")[0]}


def test_others_come_in_by_the_link_and_only_one_of_them_moves_the_arm(
    site: Site, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("config")))
    served = site.serve("--host", "0.0.0.0", "--no-tls")
    assert served.process.stdout is not None
    while not (link := LINK.search("".join(served.said))):
        served.said.append(served.process.stdout.readline())
        assert served.said[-1], served.process.communicate()
    port, token = link.groups()
    assert httpx.get(f"http://127.0.0.1:{port}/api/v1/health").status_code == 401

    remote = Remote()
    remote.connect(socket_path(site.data))

    def status() -> Status:
        found, _ = remote.status.get()
        assert found is not None
        return found

    def target() -> tuple[float, ...]:
        frame, _ = remote.frame.get()
        assert frame is not None
        return frame.arms[0].base_from_target

    ben = Visitor(int(port), headers=cookie(port, token))
    with Visitor(int(port), headers=cookie(port, token)) as ana:
        ana.click("Gizmo")
        wait_for(lambda: status().driver == "operator" and status().arms[0].engaged)
        before = target()
        ben.click("Next seed")
        ben.click("Nobody")
        drag = {"type": "TransformControlsUpdateMessage", "name": "/live/gizmo/right"}
        ben.send(drag | {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.4, 0.1, 0.3)})
        wait_for(lambda: any(title == "You are watching" for title, _ in ben.notifications))
        ana.send(drag | {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.4, 0.1, float("nan"))})
        wait_for(lambda: status().driver == "nobody")  # thrown out: the arms hold
        assert (target(), status().seed) == (before, 0)
    wait_for(lambda: ben.says("nobody drives, the arms hold"))
    ben.click("Gizmo")
    wait_for(lambda: status().driver == "operator")
    ben.__exit__()
    wait_for(lambda: status().driver == "nobody", seconds=3.0)
    assert target() == before
    remote.close()

    served.process.send_signal(signal.SIGTERM)
    said, complained = served.process.communicate(timeout=30)
    assert ("".join(served.said) + said).count(token) == 1
    assert token not in complained
    files = [path for path in site.data.rglob("*") if path.is_file()]
    assert any(path.suffix == ".log" for path in files)
    assert not [path for path in files if token.encode() in path.read_bytes()]


def test_a_session_that_does_not_answer_is_killed_at_the_end(site: Site) -> None:
    process, remote = SessionProcess(site.data, "wiping", cameras=False), Remote()
    process.start()
    process.connect(remote)
    pid = process.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    wait_for(lambda: remote.state == "stuck")
    process.end()
    assert not alive(pid)


def test_a_session_that_cannot_start_says_why_and_another_can(site: Site) -> None:
    process, remote = SessionProcess(site.data, "no-such-task", cameras=False), Remote()
    process.start()
    with pytest.raises(RuntimeError, match="no-such-task"):
        process.connect(remote)
    assert process.has_ended
    process.start("wiping")
    process.connect(remote)
    assert not process.has_ended
    remote.close()
    process.end()
