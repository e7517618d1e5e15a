"""The two kinds of channel, between threads."""

from __future__ import annotations

import threading
from collections.abc import Callable

from studio.channels import Latest, Mailbox

N = 2000


def side_by_side(*works: Callable[[], None]) -> None:
    threads = [threading.Thread(target=work) for work in works]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def test_latest_keeps_the_newest_and_counts() -> None:
    latest: Latest[str] = Latest()
    assert latest.get() == (None, 0)
    latest.set("old")
    latest.set("new")
    assert latest.get() == ("new", 2)
    assert latest.get() == ("new", 2)  # reading takes nothing away


def test_latest_never_goes_back_or_loses_count() -> None:
    latest: Latest[int] = Latest()
    seen: list[tuple[int | None, int]] = []

    def write() -> None:
        for value in range(1, N + 1):
            latest.set(value)

    def read() -> None:
        while latest.get()[1] < N:
            seen.append(latest.get())

    side_by_side(write, read)
    assert latest.get() == (N, N)
    assert all(value == count or (value, count) == (None, 0) for value, count in seen)
    assert [count for _, count in seen] == sorted(count for _, count in seen)


def test_a_mailbox_loses_nothing_and_keeps_each_senders_order() -> None:
    mailbox: Mailbox[tuple[str, int]] = Mailbox()
    drained: list[tuple[str, int]] = []

    def send(name: str) -> Callable[[], None]:
        return lambda: [mailbox.post((name, number)) for number in range(N)] and None

    def drain() -> None:
        while len(drained) < 3 * N:
            drained.extend(mailbox.drain())

    side_by_side(send("a"), send("b"), send("c"), drain)
    for name in "abc":
        assert [number for sender, number in drained if sender == name] == list(range(N))


def test_draining_an_empty_mailbox_does_not_wait() -> None:
    assert Mailbox[int]().drain() == []
