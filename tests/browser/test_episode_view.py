"""A person looks at takes on the dataset page: segments, trim, marks, two at once, and in 3-D beside it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from playwright.sync_api import Browser, Error, Frame, Locator, Page, expect
from visitor import wait_for

from studio.api import DemoReport, Studio
from studio.benchmarks.episodes import made_up_header, write_take
from studio.cursor import Cursor
from studio.edits import Edits, edits_path, read
from studio.export.lerobot import DATA_PATH
from studio.http import add_api
from studio.lease import PersonId
from studio.server import FrontServer, make_app, start_viser
from studio.ui import scene
from studio.ui.episodes import ClientEpisodes, EpisodesTab
from studio.ui.gate import Gate
from studio.ui.scene import SceneModel, SceneView

pytestmark = [
    pytest.mark.browser,
    # A page may close while something is being sent to it; viser warns that this is never delivered.
    pytest.mark.filterwarnings("ignore:Queued a:UserWarning"),
]
SIZE = {"width": 1280, "height": 800}


class Rig:
    """The studio's page with its Episodes tab, and the dataset page, over two wipes and a take of noise."""

    def __init__(self, data: Path) -> None:
        self.studio, self.gate = Studio(data), Gate("ana")
        self.server = start_viser(arrive=self.gate.arrive)
        self.gate.attach(self.server)
        self.server.gui.main_panel.dock_right()
        model = SceneModel("wiping")
        scene.set_stage(self.server, model)
        SceneView(self.server, model, scene.LIVE)
        tab = self.server.gui.add_tab_group().add_tab("Episodes")
        self.episodes = EpisodesTab(
            self.server, tab, self.studio.catalog, model=lambda _: model, person=self._person
        )
        app = make_app(self.server.get_port(), reception=self.gate.receive)
        self.reader = add_api(app, self.studio, self.gate.remote, self.gate.lease, self.episodes)
        self.front = FrontServer(app, port=0)
        self.front.start()
        self.studio.catalog.refresh()
        rows = self.studio.catalog.episodes(sort="started")
        self.noise = next(row.episode_id for row in rows if row.task == "made-up")
        self.wipes = [row.episode_id for row in rows if row.task == "wiping"]

    def _person(self, client_id: int) -> PersonId | None:
        seat = self.gate.seat(client_id)
        return seat.person if seat else None

    @property
    def client(self) -> ClientEpisodes:
        (client_id,) = self.server.get_clients()
        found = self.episodes.of(client_id)
        assert found is not None
        return found

    def said(self, episode_id: str) -> Edits:
        return read(edits_path(self.studio.catalog.get(episode_id).path))

    def close(self) -> None:
        self.front.stop()
        self.episodes.close()
        self.reader.close()
        self.server.stop()
        self.gate.remote.close()
        self.studio.close()


@pytest.fixture(scope="module")
def rig(recorded: tuple[Path, DemoReport], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    data = tmp_path_factory.mktemp("view")
    shutil.copytree(recorded[0] / "episodes", data / "episodes")
    header = made_up_header()
    write_take(data / "episodes" / header.task / f"{header.episode_id}.mcap", header, 2.0)
    rig = Rig(data)
    yield rig
    rig.close()


@pytest.fixture(scope="module")
def looking(chromium: Browser) -> Iterator[Page]:
    """One page for all; the tests fail where its scripts do."""
    page = chromium.new_page(viewport=SIZE)
    page.set_default_timeout(60_000)
    errors: list[Error] = []
    page.on("pageerror", lambda error: errors.append(error))
    yield page
    page.close()
    assert not errors


def open_take(page: Page, rig: Rig, episode_id: str) -> None:
    page.goto(f"{rig.front.url}/dataset?episode={episode_id}")
    expect(page.locator(f'#episode[data-drawn="{episode_id}"]')).to_be_visible()


def time_of(page: Page | Frame) -> float:
    return float(page.locator(".clock").inner_text())


def drag(page: Page, lane: Locator, start: float, end: float) -> None:
    """From one share of a lane's width to another."""
    box = lane.bounding_box()
    assert box is not None
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + start * box["width"], y)
    page.mouse.down()
    page.mouse.move(box["x"] + (start + end) / 2 * box["width"], y)
    page.mouse.move(box["x"] + end * box["width"], y)
    page.mouse.up()


def test_a_segment_is_drawn_moved_resized_and_deleted(rig: Rig, looking: Page) -> None:
    open_take(looking, rig, wipe := rig.wipes[0])
    duration = rig.studio.catalog.get(wipe).duration
    lane = looking.locator(".lane.segments .rail")
    drag(looking, lane, 0.3, 0.6)
    looking.get_by_label("Label of the segment").fill("wipe it")
    looking.keyboard.press("Enter")
    (segment,) = wait_for(lambda: rig.said(wipe).segments)
    assert segment.label == "wipe it"
    assert segment.start == pytest.approx(0.3 * duration, abs=0.02)
    assert segment.end == pytest.approx(0.6 * duration, abs=0.02)
    expect(looking.locator(".segment")).to_have_text("wipe it")
    drag(looking, lane, 0.45, 0.55)  # its body: moves
    moved = wait_for(lambda: (s := rig.said(wipe).segments[0]).start > segment.start + 0.1 and s)
    assert moved.end - moved.start == pytest.approx(segment.end - segment.start, abs=0.01)
    drag(looking, lane, 0.7 - 0.002, 0.9)  # its edge: grows
    grown = wait_for(lambda: (s := rig.said(wipe).segments[0]).end > moved.end + 0.1 and s)
    assert (grown.start, grown.segment_id) == (moved.start, segment.segment_id)
    looking.keyboard.press("Delete")
    wait_for(lambda: not rig.said(wipe).segments)
    # Somebody else's edit stays when this one is taken back.
    rig.studio.annotate(wipe, author="bob", add_flags=["jittery"])
    looking.keyboard.press("u")
    wait_for(lambda: rig.said(wipe).segments == (grown,))
    assert rig.said(wipe).flags == ("jittery",)
    expect(looking.locator(".segment")).to_have_text("wipe it")


def test_a_trim_leaves_out_what_an_export_leaves_out(rig: Rig, looking: Page, tmp_path: Path) -> None:
    open_take(looking, rig, wipe := rig.wipes[1])
    duration = rig.studio.catalog.get(wipe).duration
    ruler = looking.locator(".lane.ruler .rail")
    box = ruler.bounding_box()
    assert box is not None
    looking.mouse.click(box["x"] + 0.25 * box["width"], box["y"] + 5)
    assert time_of(looking) == pytest.approx(0.25 * duration, abs=0.02)
    looking.keyboard.press("i")
    wait_for(lambda: rig.said(wipe).trim)
    drag(looking, ruler, 1.0 - 3 / box["width"], 0.75)  # the handle at the end
    trim = wait_for(lambda: (t := rig.said(wipe).trim) and t[1] < duration - 0.1 and t)
    assert trim == pytest.approx((0.25 * duration, 0.75 * duration), abs=0.05)

    def shaded() -> list[float]:
        shades = [shade.bounding_box() for shade in looking.locator(".shade").all()]
        return [shade["width"] / box["width"] for shade in shades if shade]

    wait_for(lambda: shaded() == pytest.approx([0.25] * 2, abs=0.01))  # the page hears of it after the studio
    rig.studio.export([wipe], tmp_path / "out", "lerobot")
    rows = pq.read_table(tmp_path / "out" / DATA_PATH.format(chunk_index=0, file_index=0)).num_rows
    assert rows == int((trim[1] - trim[0]) * 20 + 1e-6) + 1
    assert json.loads((tmp_path / "out" / "meta" / "info.json").read_text())["total_frames"] == rows


def test_a_click_on_a_mark_and_keys_move_the_playhead(rig: Rig, looking: Page) -> None:
    open_take(looking, rig, wipe := rig.wipes[0])
    with rig.studio.open(wipe) as episode:
        switch = next(mark for mark in Cursor(episode).marks if mark.kind == "mode")
    looking.locator(".mark").first.click()
    assert time_of(looking) == pytest.approx(switch.start, abs=0.006)
    line, lane = looking.locator(".over .line").bounding_box(), looking.locator(".rail").first.bounding_box()
    assert line is not None
    assert lane is not None
    share = (line["x"] + line["width"] / 2 - lane["x"]) / lane["width"]
    assert share == pytest.approx(switch.start / rig.studio.catalog.get(wipe).duration, abs=0.003)
    looking.keyboard.press("Home")
    looking.keyboard.press("Shift+ArrowRight")
    assert time_of(looking) == 0.5
    looking.keyboard.press("Space")
    wait_for(lambda: looking.wait_for_timeout(100) or time_of(looking) > 0.6)
    looking.keyboard.press("Space")
    stopped = time_of(looking)
    looking.keyboard.press("ArrowLeft")
    assert stopped - 0.051 <= time_of(looking) < stopped


def test_all_cameras_show_the_image_of_the_time(rig: Rig, looking: Page) -> None:
    open_take(looking, rig, rig.noise)
    cameras = looking.locator(".cameras canvas")
    expect(cameras).to_have_count(3)
    for steps, number in ((0, 0), (7, 7), (-2, 5)):
        for _ in range(abs(steps)):
            looking.keyboard.press("ArrowRight" if steps > 0 else "ArrowLeft")
        for camera in cameras.all():
            expect(camera).to_have_attribute("data-number", str(number))


def test_two_takes_are_laid_over_each_other(rig: Rig, looking: Page) -> None:
    looking.goto(f"{rig.front.url}/dataset?task=wiping")
    for place in (0, 1):
        looking.locator(".row .check input").nth(place).click()
    looking.get_by_role("button", name="Compare").click()
    expect(looking.locator("#episode[data-drawn]")).to_have_attribute("data-drawn", " ".join(rig.wipes))
    expect(looking.locator(".key", has_text="Force").locator("button")).to_have_count(2)
    looking.get_by_label("Align at").select_option("contact")
    with rig.studio.open(rig.wipes[1]) as episode:
        first_contact = next(span.start for span in Cursor(episode).arms[0].phases if span.label == "contact")
    assert time_of(looking) == 0.0
    rail = looking.locator(".rail").first.bounding_box()
    assert rail is not None
    for lane in (looking.get_by_text("A contact"), looking.get_by_text("B contact")):
        band = lane.locator("xpath=..").locator("i.contact").first.bounding_box()
        line = looking.locator(".over .line").bounding_box()
        assert band is not None
        assert line is not None
        assert band["x"] == pytest.approx(line["x"], abs=2.5)  # both begin to touch at time zero
    looking.get_by_label("mean ± sd of 2").check()
    expect(looking.locator(".key", has_text="Force").locator("button")).to_have_count(3)
    looking.keyboard.press("Home")
    assert time_of(looking) <= -first_contact + 0.01


def test_the_3d_view_follows_the_page_beside_it(rig: Rig, looking: Page) -> None:
    looking.goto(f"{rig.front.url}/?fixedDpr=0.5")
    looking.get_by_role("button", name="Dataset page").click()
    page = looking.frame_locator("#studio-dock iframe")
    page.get_by_text("wiping").last.wait_for()
    frame = next(frame for frame in looking.frames if "/dataset" in frame.url)
    canvas = looking.locator("canvas[data-engine]").bounding_box()
    dock = looking.locator("#studio-dock").bounding_box()
    assert canvas is not None
    assert dock is not None
    assert canvas["width"] > 300
    assert canvas["x"] >= dock["x"] + dock["width"] - 1
    frame.evaluate(
        """async (ids) => {
            const {api} = await import("/assets/dataset/api.js");
            const {EpisodeView} = await import("/assets/episode/view.js");
            const rows = await Promise.all(ids.map((id) => api.get(`/episodes/${id}`)));
            const section = document.getElementById("episode");
            section.hidden = false;
            window.view = new EpisodeView(section, {api});
            await view.compare(rows.map(({row}) => row));
            view.go(3.7);
        }""",
        rig.wipes,
    )
    review = wait_for(lambda: rig.client.review)
    assert review.shown.wait(30)
    wait_for(lambda: review.playback.time == pytest.approx(3.7))
    assert [review.row.episode_id, *(row.episode_id for row in review.others)] == rig.wipes
    (client,) = rig.server.get_clients().values()
    assert client.scene.get_handle_by_name(f"{scene.REVIEW}/company/0/right/hand") is not None
    frame.evaluate("view.realign('contact')")
    anchors = frame.evaluate("view.takes.map((take) => take.anchor)")
    wait_for(lambda: review.playback.time == pytest.approx(anchors[0]))
    assert review.shifts == [pytest.approx(anchors[1] - anchors[0])]
    looking.locator(".undock").click()
    wait_for(lambda: rig.client.review is None)
    expect(looking.locator("#studio-dock")).to_have_count(0)


def test_a_link_opens_a_take_in_the_studio_and_only_its_owner_commands_the_view(
    rig: Rig, looking: Page
) -> None:
    looking.goto(f"{rig.front.url}/?fixedDpr=0.5&episode={rig.wipes[0]}")
    expect(looking.locator(".readout")).to_be_visible(timeout=30_000)
    assert wait_for(lambda: rig.client.review).row.episode_id == rig.wipes[0]
    stranger = looking.context.browser.new_context()  # type: ignore[union-attr]
    answer = stranger.request.put(
        f"{rig.front.url}/api/v1/view",
        data={"view": rig.client.key, "episode_ids": [rig.wipes[1]]},
    )
    assert answer.status == 404
    assert "somebody else's" in answer.json()["detail"]
    stranger.close()
    looking.get_by_role("button", name="All takes").click()
    wait_for(lambda: looking.wait_for_timeout(100) or "episode=" not in looking.url)
