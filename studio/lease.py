"""Who drives: one person holds the lease, everybody else watches. People's commands enter here.

    seat = lease.sit(person_of(socket), "headset")   # one for each open connection
    try:
        ...
        seat.post(MoveTo(...))                       # NotDriving, with words, where somebody else drives
    finally:
        seat.leave()

A person is whoever holds one cookie (`studio.door.person_of`): all pages of a browser are one person, a
headset is another. A free lease is taken by the first command that means to act; a stream of targets never
takes it. It passes when its holder hands it over, or does nothing for `PATIENCE` after being asked; it is
lost when the holder's last connection has been gone for `GRACE`. Whenever it changes hands the arms hold.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NewType

from studio.messages import Command, Hands, LoseHand, MoveTo, Notice, Nudge, OperatorLeft

PersonId = NewType("PersonId", str)

GRACE = 0.5  # [s] without a connection after which the holder has left
PATIENCE = 10.0  # [s] without a command after which who was asked has let go
LONGEST_NAME = 60  # characters
STREAMED = (MoveTo, Nudge, Hands, LoseHand)  # they go on with what somebody began

Timer = Callable[[float, Callable[[], None]], object]


class NotDriving(RuntimeError):
    """Somebody else holds the lease; the text says who, and what to do."""


@dataclass(frozen=True, slots=True)
class Standing:
    """How things are, seen from one seat."""

    holder: str  # who may drive, in words; empty while nobody does
    is_mine: bool
    asker: str  # who wants to; empty while nobody does
    is_asked_by_me: bool
    n_people: int  # who are connected


class Lease:
    """The one lease of a studio. Any thread may call it."""

    def __init__(
        self,
        post: Callable[[Command], None],
        tell: Callable[[Notice], None] = lambda _: None,
        now: Callable[[], float] = time.monotonic,
        call_later: Timer | None = None,
    ) -> None:
        """`post` takes commands to the session, `tell` tells everybody. Both must not wait."""
        self._post, self._tell = post, tell
        self._now, self._call_later = now, call_later or _call_later
        self._lock = threading.RLock()
        self._seats: list[Seat] = []
        self._names: dict[PersonId, str] = {}  # as they typed them
        self._numbers: dict[PersonId, str] = {}  # "guest 2"
        self._holder: PersonId | None = None
        self._acted = 0.0  # [s] when the holder last did something
        self._left: float | None = None  # [s] when the holder's last connection closed
        self._asker: PersonId | None = None

    @property
    def holder_name(self) -> str:
        """As the holder typed it; empty where nobody holds the lease, or somebody without a name."""
        with self._lock:
            return self._names.get(self._holder, "") if self._holder else ""

    @property
    def holder(self) -> str:
        """Who may drive, in words: a name or "guest 2"; empty while nobody does."""
        with self._lock:
            return self._words(self._holder)

    def name_of(self, person: PersonId) -> str:
        """As this person typed it, or as the studio knew; empty where neither."""
        with self._lock:
            return self._names.get(person, "")

    def sit(self, person: PersonId, kind: str = "guest", name: str = "") -> Seat:
        """A connection of this person, until it leaves. `kind` and a number name who gives no `name`."""
        with self._lock:
            seat = Seat(self, person)
            self._seats.append(seat)
            self._numbers.setdefault(person, f"{kind} {len(self._numbers) + 1}")
            if name := _clean(name):
                self._names.setdefault(person, name)
            if person == self._holder:
                self._left = None
        return seat

    def settle(self) -> None:
        """What time alone brings about: the lease is lost or passes. Called when something is due."""
        with self._lock:
            now = self._now()
            if self._left is not None and now >= self._left + GRACE:
                gone = self._words(self._holder)
                self._pass_to(self._asker, f"{gone} has left; the arms hold.")
            elif self._asker and now >= self._acted + PATIENCE:
                self._pass_to(self._asker, f"{self._words(self._holder)} did not answer.")
            elif self._asker:
                self._call_later(self._acted + PATIENCE - now, self.settle)

    # For seats

    def _admit(self, seat: Seat, takes: bool) -> None:
        with self._lock:
            if self._holder is None and takes and seat in self._seats:
                self._pass_to(seat.person, "")
            if seat.person == self._holder and seat in self._seats:
                self._acted = self._now()
                return
            if self._holder is None:
                raise NotDriving("Nobody has control. Take it first.")
            raise NotDriving(f"{self._words(self._holder)} has control; you can ask for it under Teleop.")

    def _send(self, seat: Seat, command: Command) -> None:
        with self._lock:  # so that nothing is sent after the lease has passed
            self._admit(seat, takes=not isinstance(command, STREAMED))
            self._post(command)

    def _leave(self, seat: Seat) -> None:
        with self._lock:
            if seat not in self._seats:
                return
            self._seats.remove(seat)
            if any(other.person == seat.person for other in self._seats):
                return
            if seat.person == self._asker:
                self._asker = None
            if seat.person == self._holder:
                self._left = self._now()
                self._call_later(GRACE, self.settle)

    def _ask(self, seat: Seat) -> None:
        with self._lock:
            if self._holder is None:
                self._pass_to(seat.person, "")
            elif seat.person not in (self._holder, self._asker):
                if self._asker is not None:
                    raise NotDriving(f"{self._words(self._asker)} has asked already.")
                self._asker, self._acted = seat.person, self._now()
                self._call_later(PATIENCE, self.settle)
                words = f"{self._words(seat.person)} asks {self._words(self._holder)} for control."
                self._tell(Notice(kind="info", text=words))

    def _answer(self, seat: Seat, yes: bool) -> None:
        with self._lock:
            if seat.person != self._holder:
                return
            asker = self._asker
            if yes:
                self._pass_to(asker, f"{self._words(seat.person)} gave up control; the arms hold.")
            elif asker:
                self._asker = None
                self._tell(Notice(kind="info", text=f"{self._words(seat.person)} keeps control."))

    def _rename(self, seat: Seat, name: str) -> None:
        with self._lock:
            self._names[seat.person] = _clean(name)

    def _standing(self, seat: Seat) -> Standing:
        with self._lock:
            return Standing(
                holder=self._words(self._holder),
                is_mine=seat.person == self._holder and seat in self._seats,
                asker=self._words(self._asker),
                is_asked_by_me=seat.person == self._asker,
                n_people=len({seat.person for seat in self._seats}),
            )

    # With the lock held

    def _words(self, person: PersonId | None) -> str:
        return "" if person is None else self._names.get(person) or self._numbers[person]

    def _pass_to(self, person: PersonId | None, why: str) -> None:
        was_held = self._holder is not None
        self._holder, self._asker, self._left, self._acted = person, None, None, self._now()
        if was_held:
            self._post(OperatorLeft())
            now = f" {self._words(person)} has control." if person else ""
            self._tell(Notice(kind="info", text=why + now))


class Seat:
    """One open connection of a person."""

    def __init__(self, lease: Lease, person: PersonId) -> None:
        self._lease, self.person = lease, person

    @property
    def standing(self) -> Standing:
        """Who drives and who wants to, seen from here."""
        return self._lease._standing(self)

    @property
    def may_drive(self) -> bool:
        """Whether a target sent now would be obeyed."""
        return self.standing.is_mine

    @property
    def name(self) -> str:
        """As the person typed it, or empty."""
        with self._lease._lock:
            return self._lease._names.get(self.person, "")

    @property
    def words(self) -> str:
        """The name, or something like "guest 2"."""
        with self._lease._lock:
            return self._lease._words(self.person)

    def admit(self, *, takes: bool = True) -> None:
        """Raise `NotDriving` unless this person may command; a free lease is taken if `takes`."""
        self._lease._admit(self, takes)

    def post(self, command: Command) -> None:
        """Send a command to the session. Raises `NotDriving`."""
        self._lease._send(self, command)

    def ask(self) -> None:
        """Take a free lease, or ask its holder. Raises `NotDriving` where somebody else has asked."""
        self._lease._ask(self)

    def give_up(self) -> None:
        """Hand the lease to whoever has asked for it, or to nobody."""
        self._lease._answer(self, yes=True)

    def keep(self) -> None:
        """Turn down whoever has asked."""
        self._lease._answer(self, yes=False)

    def rename(self, name: str) -> None:
        self._lease._rename(self, name)

    def leave(self) -> None:
        """The connection is closed; safe to call twice."""
        self._lease._leave(self)


def _clean(name: str) -> str:
    return " ".join("".join(c if c.isprintable() else " " for c in name).split())[:LONGEST_NAME]


def _call_later(seconds: float, action: Callable[[], None]) -> None:
    timer = threading.Timer(seconds, action)
    timer.daemon = True
    timer.start()
