"""The link between processes: nothing told is lost, the newest wins, a sleeper disturbs nobody."""

import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Client, Listener
from pathlib import Path

import msgspec
import pytest

from studio import link
from studio import messages as m
from studio.link import Hub, Link


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Hub]:
    hub = Hub(tmp_path / "s.sock")
    yield hub
    hub.close()


def wait_for(condition: Callable[[], object], seconds: float = 5.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.005)


def image(n: int, size: int = 10) -> m.CameraImage:
    return m.CameraImage(camera="front", time=float(n), resets=0, jpeg=b"x" * size)


def notice(n: int) -> m.Notice:
    return m.Notice(kind="info", text=str(n))


def test_commands_arrive_in_order_and_typed(hub: Hub, tmp_path: Path) -> None:
    client = Link(tmp_path / "s.sock", lambda report: None)
    sent = [m.Reset(seed=n) for n in range(50)] + [m.MoveTo(arm=0, position=(0, 0, 1), wxyz=(1, 0, 0, 0))]
    assert all(client.send(command) for command in sent)
    got: list[m.Command] = []
    wait_for(lambda: got.extend(hub.commands.drain()) or len(got) == len(sent))
    assert got == sent
    client.close()


def test_notices_are_not_lost_and_frames_may_be(hub: Hub, tmp_path: Path) -> None:
    got: list[m.Report] = []
    client = Link(tmp_path / "s.sock", got.append)
    wait_for(lambda: hub.n_clients == 1)
    for n in range(200):
        hub.publish("image", image(n))
        hub.tell(notice(n))
    wait_for(lambda: notice(199) in got and image(199) in got)
    assert [r for r in got if isinstance(r, m.Notice)] == [notice(n) for n in range(200)]
    client.close()


def test_a_late_client_gets_the_newest_of_everything(hub: Hub, tmp_path: Path) -> None:
    hub.publish("image", image(1))
    hub.publish("image", image(2))
    got: list[m.Report] = []
    client = Link(tmp_path / "s.sock", got.append)
    wait_for(lambda: got)
    assert got == [image(2)]
    client.close()


def test_a_client_that_reads_nothing_costs_nobody_anything(hub: Hub, tmp_path: Path) -> None:
    sleeper = Client(str(tmp_path / "s.sock"), family="AF_UNIX")
    got: list[m.Report] = []
    client = Link(tmp_path / "s.sock", got.append)
    wait_for(lambda: hub.n_clients == 2)
    started = time.monotonic()
    for n in range(100):
        hub.publish("image", image(n, size=100_000))  # far beyond any socket buffer
    assert time.monotonic() - started < 1.0  # publishing never waits for a reader
    wait_for(lambda: image(99, size=100_000) in got)
    for n in range(2 * link.MAX_QUEUE):  # more than may wait, and than the socket's buffer holds
        hub.tell(notice(n))
        time.sleep(0.0005)
    wait_for(lambda: hub.n_clients == 1)  # the sleeper was dropped
    wait_for(lambda: notice(2 * link.MAX_QUEUE - 1) in got)
    sleeper.close()
    client.close()


def test_malformed_commands_are_refused_and_the_client_stays(hub: Hub, tmp_path: Path) -> None:
    raw = Client(str(tmp_path / "s.sock"), family="AF_UNIX")
    for data in (b"", b"\x00\x01", b"not msgpack at all", m.encode(image(1))):
        raw.send_bytes(data)
    raw.send_bytes(m.encode(m.Reset(seed=3)))
    got: list[m.Command] = []
    wait_for(lambda: got.extend(hub.commands.drain()) or got)
    assert got == [m.Reset(seed=3)]
    raw.close()


def test_the_client_hears_when_the_session_is_gone(hub: Hub, tmp_path: Path) -> None:
    gone = threading.Event()
    client = Link(tmp_path / "s.sock", lambda report: None, gone.set)
    wait_for(lambda: hub.n_clients == 1)
    hub.close()
    assert gone.wait(5.0)
    assert not client.send(m.Reset(seed=1))


def test_connecting_to_nobody_says_so(tmp_path: Path) -> None:
    with pytest.raises(TimeoutError, match="did not answer"):
        link.connect(tmp_path / "nobody.sock", lambda report: None, timeout=0.2)


def test_a_malformed_command_is_answered_and_goes_no_further(hub: Hub, tmp_path: Path) -> None:
    got: list[m.Report] = []
    client = Link(tmp_path / "s.sock", got.append)
    bad = [
        {"type": "MoveTo", "arm": 0, "position": [float("nan"), 0.0, 0.0], "wxyz": [1.0, 0.0, 0.0, 0.0]},
        {"type": "MoveTo", "arm": 0, "position": [0.0, 0.0, float("inf")], "wxyz": [1.0, 0.0, 0.0, 0.0]},
        {"type": "MoveTo", "arm": 0, "position": [0.0, 0.0], "wxyz": [1.0, 0.0, 0.0, 0.0]},
        {"type": "SetGripper", "arm": 0, "opening": 1.5},
        {"type": "Drive", "driver": "operator", "operator": "x" * 10_000},
        {"type": "Reset", "seed": -1},
        {"type": "Nonsense"},
        [1, 2, 3],
    ]
    for command in bad:
        client._connection.send_bytes(msgspec.msgpack.encode(command))
    client._connection.send_bytes(b"\xc1")
    client.send(m.Release())
    wait_for(lambda: len(got) == len(bad) + 1)
    assert all(isinstance(report, m.Notice) and report.kind == "error" for report in got)
    wait_for(lambda: hub.commands.drain() == [m.Release()])
    client.close()


def test_sending_at_once_never_waits_for_a_session_that_reads_nothing(tmp_path: Path) -> None:
    with Listener(str(tmp_path / "deaf"), family="AF_UNIX") as listener:
        client = Link(tmp_path / "deaf", lambda report: None)
        deaf = listener.accept()
        command = m.Drive(driver="nobody", operator="x" * 200)
        sent = 0
        while client.send_at_once(command):  # until the socket is full
            sent += 1
        assert sent > 10
        assert [m.decode_command(deaf.recv_bytes()) for _ in range(sent)] == [command] * sent
        assert client.send_at_once(command)
        client.close()
        assert not client.send_at_once(command)
        deaf.close()
