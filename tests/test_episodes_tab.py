"""The Episodes tab without a browser: visitors that read, click and scrub."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from visitor import Visitor, wait_for

from studio.api import DemoReport
from studio.benchmarks.episodes import made_up_header, made_up_steps
from studio.catalog import Catalog
from studio.cursor import Mark, Span
from studio.episode import Outcome
from studio.episode_writer import EpisodeWriter
from studio.index import EpisodeRow
from studio.server import start_viser
from studio.ui import timeline
from studio.ui.episodes import ClientEpisodes, EpisodesTab
from studio.ui.playback import FRAME, SETTLE, Playback
from studio.ui.scene import LIVE, REVIEW, SceneModel, SceneView
from studio.ui.take_card import facts
from studio.ui.take_list import PAGE, label, words

# A client may leave while something is being sent to it; viser warns that this is never delivered.
pytestmark = pytest.mark.filterwarnings("ignore:Queued a:UserWarning")

EVIL = "<img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def scene_model() -> Callable[[str], SceneModel]:
    return cache(SceneModel)


@pytest.fixture
def data(recorded: tuple[Path, DemoReport], tmp_path: Path) -> Path:
    """Two takes of wiping, seeds 7 and 8, to do with as one likes."""
    shutil.copytree(recorded[0] / "episodes", tmp_path / "episodes")
    return tmp_path


class Rig:
    """A server with an Episodes tab and a live scene."""

    def __init__(self, data: Path, model: Callable[[str], SceneModel]) -> None:
        self.server = start_viser()
        self.catalog = Catalog(data)
        self.live = SceneView(self.server, model("wiping"), LIVE)
        tab = self.server.gui.add_tab_group().add_tab("Episodes")
        self.tab = EpisodesTab(self.server, tab, self.catalog, model=model, author=lambda _: "Ana")

    def close(self) -> None:
        self.tab.close()
        self.server.stop()
        self.catalog.close()


@pytest.fixture
def rig(data: Path, scene_model: Callable[[str], SceneModel]) -> Iterator[Rig]:
    rig = Rig(data, scene_model)
    yield rig
    rig.close()


class Watcher(Visitor):
    """Keeps what is told of the scene, too, and finds itself in the tab."""

    def __init__(self, rig: Rig) -> None:
        self.scene: list[dict[str, Any]] = []
        self._containers: dict[str, str] = {}  # of each widget
        known = set(rig.tab._clients)
        super().__init__(rig.server.get_port())
        (mine,) = wait_for(lambda: set(rig.tab._clients) - known)
        self.episodes: ClientEpisodes = rig.tab._clients[mine]

    def _take(self, message: dict[str, Any]) -> None:
        if "name" in message:
            self.scene.append(message)
        if "container_uuid" in message:
            self._containers[message["uuid"]] = message["container_uuid"]
        super()._take(message)

    def _find(self, kind: str, text: str, where: str = "label") -> dict[str, Any] | None:
        """Only what stands in a folder that is shown."""
        for props in list(self.widgets.values()):
            folder = self.widgets.get(self._containers.get(props["uuid"], ""), {})
            is_shown = props["visible"] and folder.get("visible", True)
            if props["type"] == kind and is_shown and text in (props[where] or ""):
                return props
        return None

    def takes(self) -> list[str]:
        """The labels in the list, where it is shown."""
        buttons = [w for w in list(self.widgets.values()) if w["type"] == "GuiButtonMessage" and w["visible"]]
        rows = [w for w in buttons if " N" in w["label"] and "·" in w["label"]]
        return [w["label"] for w in rows if self.widgets[self._containers[w["uuid"]]]["visible"]]

    def set(self, label: str, value: Any) -> None:
        """What a person enters in the widget of this label."""
        uuid = wait_for(
            lambda: next((w["uuid"] for w in list(self.widgets.values()) if w.get("label") == label), None)
        )
        self.send({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}})

    def open(self, text: str) -> None:
        self.click(text)
        wait_for(lambda: self.episodes.review)
        review = self.episodes.review
        assert review is not None
        assert review.shown.wait(20)
        wait_for(lambda: self.says("readout"))

    def scrub(self, at: float) -> None:
        self.set("Time [s]", at)
        wait_for(lambda: self.says(f"<b>{at:.2f}</b>"))

    def positions(self, below: str) -> list[dict[str, Any]]:
        return [m for m in list(self.scene) if m["name"].startswith(below) and "Position" in m["type"]]


@pytest.fixture
def watcher(rig: Rig) -> Iterator[Watcher]:
    with Watcher(rig) as watcher:
        yield watcher


def test_the_newest_take_stands_first(watcher: Watcher) -> None:
    wait_for(lambda: len(watcher.takes()) == 2)
    assert ["wiping 8" in label for label in watcher.takes()] == [True, False]
    assert watcher.says("2 takes, newest first")


def test_the_list_is_filtered_by_words_task_and_outcome(watcher: Watcher, rig: Rig) -> None:
    wait_for(lambda: len(watcher.takes()) == 2)
    first, _ = rig.catalog.episodes()
    rig.catalog.annotate(first.episode_id, author="Ana", outcome="failure", note="slipped off")
    watcher.set("Search", "slip")
    wait_for(lambda: len(watcher.takes()) == 1)
    assert "wiping 8" in watcher.takes()[0]
    watcher.set("Search", "nothing like it")
    assert "No take matches" in watcher.html("No take")
    watcher.set("Search", "")
    watcher.set("Outcome", "success")
    wait_for(lambda: len(watcher.takes()) == 1)
    assert "wiping 7" in watcher.takes()[0]


def test_an_empty_folder_says_what_to_do(tmp_path: Path, scene_model: Callable[[str], SceneModel]) -> None:
    rig = Rig(tmp_path, scene_model)
    with Watcher(rig) as watcher:
        assert "studio demo wiping" in watcher.html("No takes yet")
        assert watcher.takes() == []
    rig.close()


def test_a_take_that_was_recorded_meanwhile_appears(watcher: Watcher, rig: Rig, data: Path) -> None:
    wait_for(lambda: len(watcher.takes()) == 2)
    made_up_take(data)
    rig.tab.refresh()
    wait_for(lambda: len(watcher.takes()) == 3)


def test_pages_are_turned() -> None:
    assert "31 takes, page 2 of 3" in words(31, 1, 2, is_filtered=False)
    assert "1 take, newest first" in words(1, 0, 0, is_filtered=True)
    assert PAGE == 15


def test_a_take_opens_and_is_scrubbed(watcher: Watcher, rig: Rig) -> None:
    watcher.open("wiping 8")
    assert not watcher.takes()  # the card is in place of the list
    strip = watcher.html('class="strip"')
    assert 'class="contact"' in strip
    assert 'class="low"' in strip
    watcher.scrub(4.0)
    assert 'class="contact">contact' in watcher.html("readout")
    moved = len(watcher.positions(f"{REVIEW}/right_base/right_shoulder"))
    watcher.scrub(1.0)
    assert 'class="free">free' in watcher.html("readout")
    wait_for(lambda: len(watcher.scene) > moved)


def test_force_arrow_follows_the_playhead(watcher: Watcher) -> None:
    watcher.open("wiping 8")
    watcher.scrub(0.1)
    time.sleep(2 * SETTLE)
    before = len(watcher.scene)
    watcher.scrub(4.0)
    arrow = f"{REVIEW}/forces/right/force"
    wait_for(lambda: any(m["name"] == arrow and m.get("visible") for m in watcher.scene[before:]))
    wait_for(lambda: any(m["name"] == arrow and "updates" in m for m in watcher.scene[before:]))


def test_two_people_review_without_seeing_each_other(rig: Rig) -> None:
    with Watcher(rig) as ana, Watcher(rig) as ben, Watcher(rig) as bystander:
        ana.open("wiping 8")
        ben.open("wiping 7")
        ben.scrub(3.0)
        time.sleep(2 * SETTLE)  # the last drawing comes a little later
        ben_sees, bystander_sees = len(ben.scene), len(bystander.scene)
        ben_reads = ben.html("readout")
        for at in np.linspace(0.5, 6.0, 12):
            ana.scrub(round(float(at), 2))
        time.sleep(2 * SETTLE)
        assert ana.html("readout") != ben_reads
        assert ben.html("readout") == ben_reads
        assert len(ben.scene) == ben_sees
        assert len(bystander.scene) == bystander_sees
        # The live scene is hidden for those who review, and for nobody else.
        hidden = {m["name"] for m in ana.scene if m.get("visible") is False}
        assert LIVE in hidden
        assert LIVE not in {m["name"] for m in bystander.scene if m.get("visible") is False}
        assert not [m for m in bystander.scene if m["name"].startswith(REVIEW)]
        assert rig.live.visible


def test_back_brings_the_list_and_the_live_scene(watcher: Watcher) -> None:
    watcher.open("wiping 8")
    review = watcher.episodes.review
    watcher.click("All takes")
    wait_for(lambda: watcher.takes())
    assert watcher.episodes.review is None
    assert review is not None
    assert not review._thread.is_alive()
    removed = {m["name"] for m in watcher.scene if m["type"] == "RemoveSceneNodeMessage"}
    assert {LIVE, REVIEW} <= removed
    assert not watcher.says("readout")


def test_what_a_person_says_is_kept(watcher: Watcher, rig: Rig) -> None:
    watcher.open("wiping 8")
    (row,) = rig.catalog.episodes(seed=8)
    watcher.click("Failure")
    wait_for(lambda: rig.catalog.get(row.episode_id).outcome == "failure")
    watcher.set("Quality", "2")
    wait_for(lambda: rig.catalog.get(row.episode_id).quality == 2)
    watcher.set("Note", "pressed too hard")
    watcher.click("Save note")
    wait_for(lambda: rig.catalog.get(row.episode_id).note == "pressed too hard")
    watcher.click("Undo")
    wait_for(lambda: rig.catalog.get(row.episode_id).note == "")
    watcher.set("Quality", "not rated")
    wait_for(lambda: rig.catalog.get(row.episode_id).quality is None)


def test_a_typed_note_is_kept_on_leaving(watcher: Watcher, rig: Rig) -> None:
    watcher.open("wiping 8")
    (row,) = rig.catalog.episodes(seed=8)
    watcher.set("Note", "forgot to save")
    time.sleep(0.1)
    watcher.click("All takes")
    wait_for(lambda: rig.catalog.get(row.episode_id).note == "forgot to save")


def test_a_deleted_take_comes_back_by_undo(watcher: Watcher, rig: Rig) -> None:
    watcher.open("wiping 8")
    watcher.click("Delete")
    wait_for(lambda: len(watcher.takes()) == 1)
    assert len(rig.catalog.trash()) == 1
    watcher.click("bring back")
    wait_for(lambda: len(watcher.takes()) == 2)
    assert not rig.catalog.trash()


def test_one_goes_on_to_the_older_take(watcher: Watcher) -> None:
    watcher.open("wiping 8")
    watcher.click("Older")
    wait_for(lambda: watcher.says("seed 7"))
    wait_for(lambda: watcher.episodes.review and watcher.episodes.review.shown.is_set())
    watcher.click("Older")
    wait_for(lambda: watcher.notifications)
    assert "no older take" in watcher.notifications[-1][1]


def test_playing_moves_the_time_and_ends_at_the_end(watcher: Watcher, rig: Rig) -> None:
    watcher.open("wiping 8")
    end = rig.catalog.episodes(seed=8)[0].duration
    watcher.scrub(round(end - 0.5, 2))
    watcher.click("Play")
    wait_for(lambda: watcher.button("Pause"))
    wait_for(lambda: watcher.says(f"<b>{end:.2f}</b> / {end:.2f}"))
    assert watcher.button("Play")


def test_a_take_of_an_unknown_task_shows_plots_and_pictures(watcher: Watcher, rig: Rig, data: Path) -> None:
    made_up_take(data)
    rig.tab.refresh()
    watcher.open("made-up")
    assert ("No scene for this take", wait_for(lambda: watcher.notifications)[0][1]) == watcher.notifications[
        0
    ]
    assert watcher.says("contact, left")
    pictures = [w for w in watcher.widgets.values() if w["type"] == "GuiImageMessage"]
    assert [w["label"] for w in pictures] == ["front", "left wrist", "right wrist"]
    before = [bytes(w["_data"]) for w in pictures]
    watcher.scrub(0.5)
    wait_for(lambda: [bytes(w["_data"]) for w in pictures] != before)
    assert not [m for m in watcher.scene if m["name"].startswith(REVIEW)]


def test_a_damaged_take_says_so_and_the_list_goes_on(watcher: Watcher, rig: Rig) -> None:
    wait_for(lambda: len(watcher.takes()) == 2)
    (row,) = rig.catalog.episodes(seed=8)
    whole = row.path.read_bytes()
    row.path.write_bytes(whole[: len(whole) // 2])
    watcher.click("wiping 8")
    assert "torn" in watcher.html("cannot be shown")
    watcher.click("All takes")
    wait_for(lambda: len(watcher.takes()) == 2)


def test_the_review_of_a_client_that_left_ends(rig: Rig) -> None:
    with Watcher(rig) as watcher:
        watcher.open("wiping 8")
        review = watcher.episodes.review
    assert review is not None
    wait_for(lambda: not review._thread.is_alive())
    wait_for(lambda: not rig.tab._clients)


def made_up_take(data: Path) -> None:
    """Two arms, three cameras, half a second of noise."""
    header = made_up_header()
    writer = EpisodeWriter(data / "episodes/made-up" / f"{header.episode_id}.mcap", header)
    for step in made_up_steps(60, header):
        writer.add(step, time.time())
    writer.finish(Outcome(None, "made up"))


def row(**changes: Any) -> EpisodeRow:
    fields: dict[str, Any] = {
        "episode_id": "20261122-1",
        "task": "wiping",
        "instruction": "wipe",
        "operator": "Ana",
        "agent": "gizmo",
        "seed": 3,
        "started": 1.79e9,
        "duration": 9.04,
        "arms": ("right",),
        "cameras": (),
        "recorded_success": True,
        "progress": 1.0,
        "recovered": False,
        "peak_force": 7.6,
        "mean_force": 3.1,
        "outcome": "success",
        "quality": None,
        "flags": (),
        "note": "",
        "trim": None,
        "edit_version": 0,
        "path": Path("x.mcap"),
        "size": 1,
    }
    return EpisodeRow(**fields | changes)


def test_what_comes_from_files_is_escaped() -> None:
    assert "<img" not in facts(row(task=EVIL, operator=EVIL, agent=EVIL, episode_id=EVIL))
    marks = [Mark(0.0, 1.0, "event", f'{EVIL}" onmouseover="alert(1)', EVIL)]
    assert "<img" not in timeline.strip((), marks, 2.0)
    assert '" onmouseover' not in timeline.strip((), marks, 2.0)
    assert "<img" not in timeline.key(EVIL, "N", {EVIL: "red"})
    assert "<img" not in timeline._mode(Span(0.0, 1.0, EVIL), 2.0)


def test_a_take_is_one_line() -> None:
    assert label(row(quality=4, note="good")).endswith(" · wiping 3 · 9.0 s · 8 N · 4/5 · note")


class Hand:
    """A clock that only moves when told."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def drawn(playback: Playback, clock: Hand, seconds: float) -> list[float]:
    """The times drawn while the clock runs on."""
    end, times = clock.now + seconds, []
    while clock.now <= end:
        if playback._due is not None and playback._due <= clock.now:
            at = playback.wait()
            assert at is not None
            times.append(at)
        clock.now += FRAME / 4
    return times


def test_no_move_of_the_playhead_is_lost_when_keys_come_at_once() -> None:
    playback = Playback(1000.0)
    together = threading.Barrier(8)

    def press() -> None:
        together.wait()
        for _ in range(100):
            playback.move(lambda at: at + 0.125)

    threads = [threading.Thread(target=press) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert playback.time == 100.0


def test_playback_runs_at_its_speed_and_stops_at_the_end() -> None:
    clock = Hand()
    playback = Playback(2.0, now=clock)
    playback.set_speed(0.5)
    playback.play()
    times = drawn(playback, clock, 1.0)
    assert times[-1] == pytest.approx(0.5, abs=FRAME)
    assert len(times) == pytest.approx(1.0 / FRAME, abs=2)
    playback.set_speed(4.0)
    assert drawn(playback, clock, 1.0)[-1] == 2.0
    assert not playback.is_playing
    playback.play()
    assert drawn(playback, clock, 0.1)[0] < 0.1  # from the start again


def test_scrubbing_pauses_and_is_drawn_twice() -> None:
    clock = Hand()
    playback = Playback(2.0, now=clock)
    playback.play()
    drawn(playback, clock, 0.2)
    playback.scrub(1.5)
    assert drawn(playback, clock, 1.0) == [1.5, 1.5]  # the second one for the ink
    assert drawn(playback, clock, 1.0) == []
    playback.scrub(9.0)
    assert drawn(playback, clock, 0.1) == [2.0]


def test_a_playback_follows_another_clock_without_jerks() -> None:
    clock = Hand()
    playback = Playback(9.0, now=clock)
    playback.follow(1.0, 2.0)
    times = drawn(playback, clock, 1.0)
    assert (times[0], times[-1]) == (1.0, pytest.approx(3.0, abs=2 * FRAME))
    playback.follow(3.03, 2.0)  # about where it is: it goes on as it went
    assert playback.time == times[-1]
    playback.follow(6.0, 2.0)
    assert playback.time == 6.0
    playback.follow(5.0, 0.0)
    assert drawn(playback, clock, 1.0) == [5.0, 5.0]
    playback.follow(99.0, 0.0)
    assert playback.time == 9.0


def test_a_closed_playback_lets_go() -> None:
    playback = Playback(2.0)
    assert playback.wait() == 0.0
    threading.Timer(0.05, playback.close).start()
    while playback.wait() is not None:
        pass
