"""People look through takes on the dataset page, say how they were, and see what others say."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import http_site
import pytest
from playwright.sync_api import Browser, Locator, Page, expect
from visitor import PATIENCE, wait_for

from studio.benchmarks.catalog import fill
from studio.benchmarks.episodes import made_up_header, write_take
from studio.edits import edits_path, read
from studio.index import EpisodeRow

pytestmark = pytest.mark.browser

EVIL = "<img src=x onerror=alert(1)>"
TAKES = 6  # seeds 0 .. 5; the odd ones are bob's


class Site(http_site.Site):
    """The page over a data folder, without a robot."""

    @property
    def url(self) -> str:
        return f"{self.front.url}/dataset"

    def take(self, seed: int) -> EpisodeRow:
        (row,) = self.studio.catalog.episodes(seed=seed)
        return row


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """Tests leave the takes as they were."""
    expect.set_options(timeout=PATIENCE * 1e3)
    data = tmp_path_factory.mktemp("dataset")
    for seed in range(TAKES):
        header = made_up_header(arms=("right",), cameras=("front",))
        operator = "bob" if seed % 2 else "ann"
        header = dataclasses.replace(
            header, seed=seed, operator=operator, agent=EVIL, started=1.7e9 + 60 * seed
        )
        write_take(data / "episodes" / header.task / f"{header.episode_id}.mcap", header, 0.3)
    site = Site(data)
    yield site
    site.close()


def visit(page: Page, site: Site, author: str = "ann", query: str = "") -> None:
    page.set_viewport_size({"width": 1280, "height": 800})  # there is room for all columns
    page.add_init_script(f"localStorage.setItem('studio.author', '{author}')")
    page.goto(site.url + query)
    expect(row(page, 5) if not query else page.locator(".space .row").first).to_be_visible()


def row(page: Page, seed: int) -> Locator:
    return page.locator(".space .row", has_text=f"made-up · {seed}")


def rows(page: Page) -> Locator:
    return page.locator(".space .row")


@pytest.fixture
def untouched(site: Site) -> Iterator[Callable[[], bool]]:
    """Whether every take is as it was recorded, which it must be in the end."""

    def is_untouched() -> bool:
        return all(
            (row.outcome, row.quality, row.flags, row.note) == ("unmarked", None, (), "")
            for row in site.studio.catalog.episodes()
        )

    yield is_untouched
    assert is_untouched()
    assert site.studio.catalog.count() == TAKES


def test_keys_annotate_and_take_back_but_not_while_typing(
    page: Page, site: Site, untouched: Callable[[], bool]
) -> None:
    visit(page, site)
    expect(row(page, 5)).to_have_class(re.compile("cursor"))  # the newest
    page.keyboard.press("s")
    expect(row(page, 5)).to_contain_text("success")
    page.keyboard.press("ArrowDown")
    for key in ("4", "j", "f"):
        page.keyboard.press(key)
    expect(row(page, 4)).to_contain_text("failure")
    expect(row(page, 4)).to_contain_text("jittery")
    expect(row(page, 4).get_by_label("quality 4 of 5")).to_be_visible()
    told = wait_for(lambda: (t := site.take(4)).outcome == "failure" and t)
    assert (told.quality, told.flags) == (4, ("jittery",))
    history = read(edits_path(told.path)).history
    assert [edit.author for edit in history] == ["ann"] * 3
    page.keyboard.press("/")
    page.keyboard.type("fs3")
    page.keyboard.press("Control+A")
    page.keyboard.press("Delete")
    page.keyboard.press("Escape")
    expect(rows(page)).to_have_count(TAKES)
    assert read(edits_path(told.path)).history == history
    for _ in range(4):
        page.keyboard.press("u")
    wait_for(untouched)
    expect(row(page, 5)).to_contain_text("unmarked")


def test_filters_narrow_the_list_and_a_link_shows_the_same_again(page: Page, site: Site) -> None:
    visit(page, site)
    expect(page.locator("#facets").get_by_role("button", name=EVIL)).to_be_visible()  # in words
    expect(page.locator("img[src=x]")).to_have_count(0)
    page.locator("#facets").get_by_role("button", name="bob").click()
    expect(rows(page)).to_have_count(TAKES // 2)
    expect(page.locator(".amount")).to_contain_text("3 takes")
    # What else there is.
    expect(page.locator("#facets").get_by_role("button", name="ann")).to_contain_text("3")
    page.locator(".head").get_by_role("button", name="Recorded").click()  # the oldest first
    expect(rows(page).first).to_contain_text("made-up · 1")
    again = page.context.new_page()
    again.goto(page.url)
    expect(rows(again)).to_have_count(TAKES // 2)
    expect(rows(again).first).to_contain_text("made-up · 1")
    again.close()
    page.keyboard.press("/")
    page.keyboard.type("nothing like that")
    expect(page.get_by_text("No take matches.")).to_be_visible()
    page.get_by_role("button", name="Take all filters off").click()
    expect(rows(page)).to_have_count(TAKES)


def test_one_edit_goes_to_all_selected_takes(page: Page, site: Site, untouched: Callable[[], bool]) -> None:
    visit(page, site)
    page.keyboard.press("Shift+ArrowDown")
    page.keyboard.press("Shift+ArrowDown")
    expect(page.locator(".selection")).to_contain_text("3 selected")
    page.keyboard.press("2")
    wait_for(lambda: [site.take(seed).quality for seed in (5, 4, 3, 2)] == [2, 2, 2, None])
    page.keyboard.press("e")
    page.get_by_role("dialog").get_by_text("collision").click()
    page.get_by_role("dialog").locator("textarea").fill("too fast")
    page.get_by_role("button", name="Change 3 takes").click()
    expect(page.locator(".space .row", has_text="too fast")).to_have_count(3)
    assert {site.take(seed).flags for seed in (5, 4, 3)} == {("collision",)}
    edit_ids = {read(edits_path(site.take(seed).path)).history[-1].edit_id for seed in (5, 4, 3)}
    assert len(edit_ids) == 1
    page.keyboard.press("u")
    page.keyboard.press("u")
    wait_for(untouched)


def test_a_deleted_take_comes_back(page: Page, site: Site, untouched: Callable[[], bool]) -> None:
    visit(page, site)
    trash = page.locator("#facets").get_by_role("button", name="Trash")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Delete")
    expect(row(page, 4)).to_have_count(0)
    expect(trash).to_contain_text("1")
    page.keyboard.press("u")
    expect(row(page, 4)).to_be_visible()
    row(page, 3).click()
    page.keyboard.press("Delete")
    trash.click()
    expect(rows(page)).to_have_count(1)
    page.keyboard.press("s")
    expect(page.get_by_text("A deleted take is not edited")).to_be_visible()
    page.keyboard.press("r")
    expect(page.get_by_text("The trash is empty.")).to_be_visible()
    page.go_back()
    expect(rows(page)).to_have_count(TAKES)


def test_what_two_people_say_is_seen_by_both(
    page: Page, site: Site, chromium: Browser, untouched: Callable[[], bool]
) -> None:
    visit(page, site, "ann")
    other = chromium.new_context().new_page()
    visit(other, site, "bob")
    page.keyboard.press("s")
    page.keyboard.press("3")
    expect(row(other, 5)).to_contain_text("success")
    other.keyboard.press("f")
    expect(row(page, 5)).to_contain_text("failure")  # although the cursor rests on her own edit
    expect(row(page, 5).get_by_label("quality 3 of 5")).to_be_visible()
    site.studio.annotate(site.take(4).episode_id, author="eve", add_flags=["hesitation"])  # not by HTTP
    for visitor in (page, other):
        expect(row(visitor, 4)).to_contain_text("hesitation")
    other.keyboard.press("u")
    expect(row(page, 5)).to_contain_text("success")  # ann's counts again
    page.keyboard.press("u")
    page.keyboard.press("u")
    site.studio.annotate(site.take(4).episode_id, author="eve", remove_flags=["hesitation"])
    wait_for(untouched)
    other.context.close()


def test_an_edited_take_stays_under_the_cursor_until_one_goes_on(
    page: Page, site: Site, untouched: Callable[[], bool]
) -> None:
    visit(page, site, query="?outcome=unmarked")
    page.keyboard.press("s")
    expect(row(page, 5)).to_contain_text("success")  # no longer what was asked for, but still here
    page.keyboard.press("ArrowDown")
    expect(row(page, 5)).to_have_count(0)
    expect(row(page, 4)).to_have_class(re.compile("cursor"))  # none was skipped
    page.keyboard.press("u")
    expect(row(page, 5)).to_be_visible()
    wait_for(untouched)


def test_leafing_quickly_ends_at_the_take_under_the_cursor(
    page: Page, site: Site, untouched: Callable[[], bool]
) -> None:
    visit(page, site)
    page.keyboard.press("Enter")
    for key in ("ArrowDown", "ArrowDown", "ArrowUp", "ArrowDown"):
        page.keyboard.press(key)
    page.keyboard.press("4")  # is about the take under the cursor, shown already or not
    expect(page.locator("#episode")).to_have_attribute("data-drawn", site.take(3).episode_id)
    wait_for(lambda: site.take(3).quality == 4)
    assert site.take(3).episode_id in page.url
    expect(page.locator(".toast.bad")).to_have_count(0)
    page.keyboard.press("u")
    wait_for(untouched)
    page.keyboard.press("Escape")
    expect(page.locator("#episode")).to_be_hidden()
    page.go_back()
    expect(page.locator("#episode")).to_be_visible()


def test_a_selection_becomes_a_collection_that_stays_as_it_is(
    page: Page, site: Site, untouched: Callable[[], bool]
) -> None:
    visit(page, site)
    page.keyboard.press("Shift+ArrowDown")
    page.keyboard.press("c")
    dialog = page.get_by_role("dialog")
    expect(dialog).to_contain_text("2 fair")  # made of noise
    dialog.get_by_label("Name").fill("two")
    dialog.get_by_role("button", name="Make").click()
    page.locator("#facets").get_by_role("button", name="two").click()
    expect(rows(page)).to_have_count(2)
    expect(page.locator(".banner")).to_contain_text("2 takes as they were")
    assert [member.episode_id for member in site.studio.collection("two").members] == [
        site.take(seed).episode_id for seed in (5, 4)
    ]
    page.get_by_role("button", name="Delete collection").click()
    expect(rows(page)).to_have_count(TAKES)
    page.keyboard.press("Delete")
    page.keyboard.press("u")  # the take, which no collection holds by now
    expect(page.get_by_text("Taken back: made-up · 5 deleted")).to_be_visible()


def test_ten_thousand_takes_are_scrolled_by_a_few_rows(page: Page, tmp_path: Path) -> None:
    site = Site(tmp_path)
    made = fill(tmp_path, 10_000)
    page.route("**/api/v1/refresh", lambda route: route.fulfill(json={}))  # there are no files
    try:
        page.goto(site.url)
        first = rows(page).filter(has_text=f"{made[-1].task} · {made[-1].seed}")
        expect(first.first).to_be_visible()
        expect(page.locator(".amount")).to_contain_text("10,000 takes")
        page.keyboard.press("End")
        last = page.locator(f".space .row[data-id={made[0].episode_id}]")
        expect(last).to_have_class(re.compile("cursor"))
        expect(last).to_be_in_viewport()
        assert rows(page).count() < 60
    finally:
        site.close()
