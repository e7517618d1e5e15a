"""The page of jobs in a browser: from takes to a policy that was tried, as a person does it."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Error, Page, ViewportSize, expect
from served import Site as Servers
from visitor import wait_for

from studio.api import Studio
from studio.link import socket_path
from studio.ui.remote import Remote

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]
expect.set_options(timeout=30e3)  # [ms] for a page on a busy machine
LONG = 240e3  # [ms] for a job on a busy machine
SMALL = {"Width": "16", "Feedforward": "32", "Heads": "2", "Encoder layers": "1", "Decoder layers": "1"}


class Site:
    """`studio serve`, and what it does as its data folder and its session tell."""

    def __init__(self, data: Path) -> None:
        self._servers = Servers(data)
        self.url = self._servers.serve().url()
        self.studio, self.session = Studio(data), Remote()
        self.session.connect(socket_path(data))

    def close(self) -> None:
        self.session.close()
        self.studio.close()
        self._servers.close()

    def is_driven_by(self, driver: str) -> bool:
        status, _ = self.session.status.get()
        return status is not None and status.driver == driver

    def target(self) -> np.ndarray:
        """Of the arm: position [m], then its rotation."""
        frame, _ = self.session.frame.get()
        assert frame is not None
        return np.array(frame.arms[0].base_from_target)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """With nothing in it."""
    site = Site(tmp_path_factory.mktemp("jobs"))
    yield site
    site.close()


@pytest.fixture(scope="module")
def page(chromium: Browser) -> Iterator[Page]:
    """One for all tests; they fail where its scripts do."""
    context = chromium.new_context(viewport=ViewportSize(width=1280, height=800))
    page = context.new_page()
    page.set_default_timeout(60e3)
    errors: list[Error] = []
    page.on("pageerror", lambda error: errors.append(error))
    yield page
    context.close()
    assert not errors


def look(page: Page, name: str) -> None:
    """Keep a picture where somebody asks for them."""
    if folder := os.environ.get("STUDIO_SCREENSHOTS"):
        page.screenshot(path=Path(folder) / f"{name}.png")


def test_from_demonstrations_to_a_policy_that_drives(site: Site, page: Page) -> None:
    page.goto(f"{site.url}/train")
    form, closer = page.locator("#ask"), page.locator("#closer")
    form.get_by_label("Task").select_option("wiping")
    expect(form.get_by_text("No demonstration of 'wiping'")).to_be_visible()
    form.get_by_role("button", name="Demonstrate…").click()
    form.get_by_label("First seed").fill("7")
    form.get_by_label("How many").fill("6")
    form.get_by_label("Images").uncheck()
    form.get_by_role("button", name="Start recording").click()
    job = page.locator(".job", has_text="Record 6 demonstrations of wiping")
    expect(job.locator(".state")).to_have_text("done", timeout=LONG)
    expect(closer.get_by_role("link", name="Look at the takes")).to_be_visible()
    look(page, "demonstrate")
    site.studio.catalog.refresh()
    ids = [row.episode_id for row in site.studio.episodes()]
    site.studio.make_collection("six", episode_ids=ids)
    # Train on them.
    page.goto(f"{site.url}/train")
    expect(form.get_by_text("6 takes")).to_be_visible()
    form.get_by_label("From").select_option("collection")
    expect(form.get_by_label("Collection")).to_have_value("six")
    form.get_by_label("Images").uncheck()
    form.get_by_label("Steps", exact=True).fill("60")
    form.get_by_text("Network", exact=True).click()
    for name, value in SMALL.items():
        form.get_by_label(name, exact=True).fill(value)
    form.get_by_text("Optimisation", exact=True).click()
    form.get_by_label("Validate every").fill("20")
    form.get_by_label("Name", exact=True).fill("learner")
    form.get_by_role("button", name="Start training").click()
    job = page.locator(".job", has_text="Train learner")
    expect(job.locator(".state")).to_have_text("running")
    expect(closer.locator(".chart canvas").first).to_be_visible(timeout=LONG)
    expect(job.locator(".state")).to_have_text("done", timeout=LONG)
    expect(closer.get_by_text("step 60 of 60", exact=True)).to_be_visible()
    expect(closer.get_by_role("link", name="collection six")).to_have_attribute(
        "href", "/dataset?collection=six"
    )
    expect(closer.locator(".chart:visible")).to_have_count(5)
    expect(closer.locator(".log")).to_contain_text("on others")
    look(page, "train")
    # Evaluate what it learned.
    closer.get_by_role("button", name="Evaluate…").click()
    expect(form.get_by_label("Run or reference")).to_have_value("learner")
    form.get_by_label("How many").fill("2")
    form.get_by_role("button", name="Start evaluation").click()
    tried = page.locator(".job", has_text="Evaluate learner on wiping")
    expect(closer.locator("table.rollouts tbody tr").first).to_be_visible(timeout=LONG)  # before all are over
    expect(tried.locator(".state")).to_have_text("done", timeout=LONG)
    expect(closer.get_by_text("at step 60")).to_be_visible()
    rollouts = closer.locator("table.rollouts tbody tr")
    expect(rollouts).to_have_count(2)
    rollout = site.studio.evaluation("learner").rollouts[0]
    link = rollouts.first.get_by_role("link", name="open")
    expect(link).to_have_attribute("href", f"/dataset?episode={rollout.episode_id}")
    expect(closer.locator("img.figure").first).to_have_js_property("complete", True)
    look(page, "evaluate")
    link.click()
    expect(page.locator("#episode")).to_have_attribute("data-drawn", rollout.episode_id, timeout=LONG)
    look(page, "rollout")
    _drive_with(site, page, "learner")


def _drive_with(site: Site, page: Page, run: str) -> None:
    """On the first page: choose the run, take over, hand back, end."""
    page.goto(f"{site.url}/?fixedDpr=0.3")
    page.get_by_role("button", name="Start take").first.wait_for()
    page.locator(".mantine-Notification-closeButton").first.click()  # viser's word on software rendering
    expect(page.get_by_label("Run", exact=True)).to_have_value(run)
    before = site.target()
    page.get_by_role("button", name="Policy").click()
    expect(page.get_by_text(f"{run} drives").first).to_be_visible(timeout=LONG)
    wait_for(lambda: np.abs(site.target() - before)[:3].max() > 1e-3, LONG / 1e3)  # it answers
    look(page, "drive")
    page.get_by_role("button", name="Gizmo").click()
    wait_for(lambda: site.is_driven_by("operator"))
    held = site.target()
    page.get_by_role("button", name="Policy").click()
    wait_for(lambda: site.is_driven_by("policy") and np.abs(site.target() - held).max() > 1e-6)
    page.get_by_role("button", name="Nobody").click()
    wait_for(lambda: site.is_driven_by("nobody"))


def test_a_run_is_duplicated_compared_deleted_and_restored(site: Site, page: Page) -> None:
    page.goto(f"{site.url}/train")
    form, job = page.locator("#ask"), page.locator(".job", has_text="Train learner")
    job.get_by_role("button", name="Duplicate…").click()
    expect(form.get_by_label("Steps", exact=True)).to_have_value("60")
    form.get_by_text("Run", exact=True).click()
    form.get_by_label("Name", exact=True).fill("second")
    form.get_by_label("Sweep over", exact=True).select_option("lr")
    form.get_by_label("Values to sweep over").first.fill("1e-3")
    form.get_by_label("Steps", exact=True).fill("30")
    form.get_by_role("button", name="Start training").click()
    job = page.locator(".job", has_text="Train second-1")
    expect(job.locator(".state")).to_have_text("done", timeout=LONG)
    job.get_by_role("button", name="Compare").click()
    expect(page.get_by_label("Compare second-1")).to_be_checked()
    page.get_by_label("Compare learner").check()
    closer = page.locator("#closer")
    expect(closer.get_by_role("heading", name="2 runs")).to_be_visible()
    expect(closer.locator("th", has_text="Learning rate")).to_be_visible()
    look(page, "compare")
    job.get_by_role("button", name="Delete").click()
    expect(page.locator(".job", has_text="Train second-1")).to_have_count(0)
    assert "second-1" not in {path.name for path in (site.studio.data_dir / "runs").iterdir()}
    page.get_by_role("button", name="Undo").click()
    expect(page.locator(".job", has_text="Train second-1")).to_be_visible()
    assert "second-1" in {path.name for path in (site.studio.data_dir / "runs").iterdir()}


def test_two_agents_are_compared_on_the_same_scenes(site: Site, page: Page) -> None:
    one = site.studio.evaluation("learner").evaluation_id
    page.goto(f"{site.url}/train?tab=evaluate")
    form, closer = page.locator("#ask"), page.locator("#closer")
    form.get_by_label("Run or reference").select_option("demonstrator")
    form.get_by_label("Task").select_option("wiping")
    form.get_by_label("How many").fill("2")
    form.get_by_role("button", name="Start evaluation").click()
    expect(closer.get_by_label("Compare with")).to_be_visible(timeout=LONG)
    closer.get_by_label("Compare with").select_option(one)
    expect(closer.get_by_text("Paired difference")).to_be_visible()
    expect(closer.get_by_text(re.compile(r"demonstrator against learner on 2 scenes"))).to_be_visible()
    assert f"against={one}" in page.url
    look(page, "paired")


def test_what_cannot_work_is_told_in_a_sentence(site: Site, page: Page) -> None:
    page.goto(f"{site.url}/train")
    form = page.locator("#ask")
    expect(form.get_by_text("6 takes")).to_be_visible()
    form.get_by_label("Steps", exact=True).fill("many")
    form.get_by_role("button", name="Start training").click()
    expect(page.locator(".toast")).to_contain_text("Steps must be a number, not “many”.")
    form.get_by_label("Steps", exact=True).fill("10")
    form.get_by_label("Name", exact=True).fill("learner")
    form.get_by_role("button", name="Start training").click()
    expect(page.locator(".toast").last).to_contain_text("There is a run learner already")
    form.get_by_label("Task").select_option("drawing")
    expect(form.get_by_text("No demonstration of 'drawing'")).to_be_visible()
    expect(form.get_by_role("button", name="Start training")).to_be_disabled()
