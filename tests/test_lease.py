"""The lease: one drives, nobody else; it is taken, handed over and lost, and the arms hold meanwhile."""

from __future__ import annotations

import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from studio import messages as m
from studio.lease import GRACE, PATIENCE, Lease, NotDriving, PersonId, Seat

ANA, BEN, EVE = PersonId("ana"), PersonId("ben"), PersonId("eve")
MOVE = m.MoveTo(arm=0, position=(0.4, 0.0, 0.2), wxyz=(1.0, 0.0, 0.0, 0.0))
ENGAGE = m.Engage(arm=0, engaged=True)
EVENTS = ("ask", "give", "keep", "post", "move", "leave", "sit", "wait")


class Room:
    """A lease with a clock that stands until somebody turns it."""

    def __init__(self) -> None:
        self.time = 0.0
        self.posted: list[m.Command] = []
        self.told: list[str] = []
        self.lease = Lease(
            self.posted.append,
            lambda notice: self.told.append(notice.text),
            now=lambda: self.time,
            call_later=lambda seconds, action: None,
        )

    def sit(self, person: PersonId, name: str = "") -> Seat:
        return self.lease.sit(person, name=name or str(person).capitalize())

    def pass_time(self, seconds: float) -> None:
        self.time += seconds
        self.lease.settle()


@pytest.fixture
def room() -> Room:
    return Room()


def test_the_first_to_act_drives_and_the_other_hears_who(room: Room) -> None:
    ana, ben = room.sit(ANA), room.sit(BEN)
    start = m.StartTake(countdown=0.0)
    ana.post(start)
    with pytest.raises(NotDriving, match=r"Ana has control; you can ask for it"):
        ben.post(start)
    assert room.posted == [start]
    assert ana.may_drive
    assert not ben.may_drive


def test_one_of_many_that_press_at_once_wins() -> None:
    room, refused = Room(), []
    seats = [room.sit(PersonId(str(n))) for n in range(8)]
    together = threading.Barrier(len(seats))

    def press(seat: Seat) -> None:
        together.wait()
        try:
            seat.post(ENGAGE)
        except NotDriving:
            refused.append(seat)

    threads = [threading.Thread(target=press, args=(seat,)) for seat in seats]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(room.posted) == 1
    assert len(refused) == 7


def test_targets_alone_never_take_a_free_lease(room: Room) -> None:
    ana = room.sit(ANA)
    for command in (MOVE, m.Nudge(arm=0)):
        with pytest.raises(NotDriving, match="Take it first"):
            ana.post(command)
    assert room.posted == []
    ana.post(ENGAGE)
    ana.post(MOVE)
    assert room.posted == [ENGAGE, MOVE]


def test_all_pages_of_one_person_drive(room: Room) -> None:
    page, headset = room.sit(ANA), room.sit(ANA)
    page.post(ENGAGE)
    headset.post(MOVE)
    headset.leave()
    room.pass_time(GRACE)
    assert page.may_drive
    assert m.OperatorLeft() not in room.posted


def test_half_a_second_after_the_holder_has_gone_the_arms_hold_and_the_lease_is_free(room: Room) -> None:
    ana, ben = room.sit(ANA), room.sit(BEN)
    ana.post(ENGAGE)
    ana.leave()
    ana.leave()
    room.pass_time(GRACE - 0.01)
    with pytest.raises(NotDriving):
        ben.post(ENGAGE)
    room.pass_time(0.01)
    assert room.posted == [ENGAGE, m.OperatorLeft()]
    assert room.told == ["Ana has left; the arms hold."]
    with pytest.raises(NotDriving):
        ana.post(ENGAGE)  # its connection is closed
    ben.post(ENGAGE)
    assert room.posted[2:] == [ENGAGE]


def test_who_comes_back_in_time_still_drives(room: Room) -> None:
    room.sit(BEN)
    seat = room.sit(ANA)
    seat.post(ENGAGE)
    seat.leave()
    room.pass_time(GRACE / 2)
    again = room.sit(ANA)
    room.pass_time(GRACE)
    again.post(MOVE)
    assert m.OperatorLeft() not in room.posted


def test_it_is_handed_over_to_who_asked_and_the_arms_hold(room: Room) -> None:
    ana, ben, eve = room.sit(ANA), room.sit(BEN), room.sit(EVE)
    ana.post(ENGAGE)
    ben.ask()
    assert ana.standing.asker == "Ben"
    assert ben.standing.is_asked_by_me
    with pytest.raises(NotDriving, match="Ben has asked already"):
        eve.ask()
    eve.give_up()  # not hers to give
    assert ana.may_drive
    ana.give_up()
    assert ben.may_drive
    assert room.posted == [ENGAGE, m.OperatorLeft()]
    assert room.told == [
        "Ben asks Ana for control.",
        "Ana gave up control; the arms hold. Ben has control.",
    ]


def test_who_goes_on_driving_keeps_it_and_who_does_nothing_loses_it(room: Room) -> None:
    ana, ben = room.sit(ANA), room.sit(BEN)
    ana.post(ENGAGE)
    room.pass_time(100.0)  # nobody has asked
    ben.ask()
    for _ in range(10):
        room.pass_time(0.9 * PATIENCE)
        ana.post(MOVE)
    room.pass_time(0.9 * PATIENCE)
    assert ana.may_drive
    room.pass_time(0.2 * PATIENCE)
    assert ben.may_drive
    assert room.posted[-1] == m.OperatorLeft()


def test_a_request_is_turned_down_or_forgotten(room: Room) -> None:
    ana, ben = room.sit(ANA), room.sit(BEN)
    ana.ask()  # free: taken
    ben.ask()
    ana.keep()
    assert room.told[-1] == "Ana keeps control."
    room.pass_time(2 * PATIENCE)
    assert ana.may_drive
    ben.ask()
    ben.leave()
    room.pass_time(2 * PATIENCE)
    assert ana.may_drive
    assert ana.standing.asker == ""


def test_names_are_what_people_typed_in_one_line(room: Room) -> None:
    guest = room.lease.sit(ANA, "headset")
    guest.post(ENGAGE)
    assert guest.standing.holder == "headset 1"
    assert room.lease.holder_name == ""
    guest.rename("  Ana\n\x1b[31m  B. " + 200 * "x")
    assert room.lease.holder_name.startswith("Ana [31m B. xxx")
    assert len(room.lease.holder_name) == 60
    ben = room.sit(BEN, "Ben\n\x1b[31m" + 200 * "x")  # a program gives its name as it comes
    assert ben.words.startswith("Ben [31mxxx")
    assert len(ben.words) == 60


def test_time_passes_by_itself() -> None:
    posted: list[m.Command] = []
    lease = Lease(posted.append)
    seat = lease.sit(ANA)
    seat.post(ENGAGE)
    seat.leave()
    begin = time.monotonic()
    while m.OperatorLeft() not in posted:
        assert time.monotonic() < begin + 5.0
        time.sleep(0.01)
    assert time.monotonic() - begin > 0.9 * GRACE


@given(st.lists(st.tuples(st.sampled_from(EVENTS), st.integers(0, 2))))
def test_whatever_happens_at_most_one_person_drives_and_no_change_of_hands_goes_without_a_hold(
    events: list[tuple[str, int]],
) -> None:
    room, people = Room(), (ANA, BEN, EVE)
    seats = [room.sit(person) for person in people]
    for what, who in events:
        before, may = room.lease.holder, seats[who].may_drive
        holds = room.posted.count(m.OperatorLeft())
        seat = seats[who]
        try:
            match what:
                case "ask":
                    seat.ask()
                case "give":
                    seat.give_up()
                case "keep":
                    seat.keep()
                case "post":
                    seat.post(ENGAGE)
                case "move":
                    seat.post(MOVE)
                case "leave":
                    seat.leave()
                case "sit":
                    seats[who] = room.sit(people[who])
                case "wait":
                    room.pass_time(0.3 * PATIENCE)
        except NotDriving:
            assert not may
        assert len({seat.person for seat in seats if seat.may_drive}) <= 1
        if before and room.lease.holder != before:
            assert room.posted.count(m.OperatorLeft()) == holds + 1
