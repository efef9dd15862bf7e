"""The page of `unitouch-gen app` in a headless Chromium: what a person does in each tab."""

import os
import shutil
import signal
import socket
import time
from pathlib import Path
from urllib.parse import urlparse

import pytest

from tests.helpers.processes import Child, command
from unitouch_gen import example

pytest.importorskip("gradio", reason="the extra `app` is not installed")
playwright = pytest.importorskip("playwright.sync_api", reason="the extra `test` is not installed")

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here; on Debian: apt install chromium"),
]


@pytest.fixture(scope="module")
def address(models, tmp_path_factory):
    """A page that the command serves, until Ctrl-C."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    words = [word for folder in models.values() for word in ("--model", folder)]
    child = Child(command, "app", "--port", str(port), *words, folder=tmp_path_factory.mktemp("served"))
    while not (child.notes / "out").exists() or "The page is at" not in child.out:
        assert child.process.is_alive(), child.err
        time.sleep(0.1)
    yield f"http://127.0.0.1:{port}"
    os.kill(child.process.pid, signal.SIGINT)
    assert child.wait() == 0, child.err


@pytest.fixture
def page(address):
    """The page, which must ask no other host for anything, and have no errors."""
    asked = []
    broken = []
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 375, "height": 812})  # a phone's
        page.set_default_timeout(60_000)
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: broken.append(str(error)))
        page.goto(address)
        yield page
        browser.close()
    hosts = {urlparse(url).hostname for url in asked if url.startswith("http")}
    assert (hosts, broken) == ({"127.0.0.1"}, [])


def upload(page, label, file):
    part = page.locator(".block", has=page.get_by_text(label, exact=True)).locator("visible=true")
    part.locator("input[type=file]").first.set_input_files(file)
    page.locator(f"img[src*='{Path(file).name}']").locator("visible=true").first.wait_for()


def make(page) -> str:
    """Asks for pictures, and gives the run report when they are shown; nothing is wider than the window."""
    page.get_by_role("button", name="Make it").locator("visible=true").click()
    page.locator("img[src*='image.png']").locator("visible=true").first.wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= 375
    return page.get_by_label("Run report").locator("visible=true").input_value()


def test_a_touch_becomes_a_picture(page):
    upload(page, "Touch", str(example("brick")))
    assert "2 steps" in make(page)
    assert "%" in page.get_by_label("Feels like").first.input_value()


def test_a_photo_is_restyled_and_what_is_missing_is_told(page):
    page.get_by_role("tab", name="Style a photo").click()
    upload(page, "Touch", str(example("brick")))
    page.get_by_role("button", name="Make it").locator("visible=true").click()
    said = page.get_by_test_id("toast-text").first
    said.wait_for()
    assert "`image` is missing" in said.inner_text()
    assert "\n" not in said.inner_text()
    upload(page, "Photo", str(example("wood", "image")))
    assert "steps" in make(page)


def test_settings_that_are_opened_and_left_as_they_are_change_nothing(page):
    upload(page, "Touch", str(example("brick")))
    page.get_by_text("Sampling").locator("visible=true").click()
    page.get_by_label("Seed; a new one each time if empty").locator("visible=true").wait_for()
    assert "2 steps" in make(page)


def test_stop_leaves_no_error(page):
    upload(page, "Touch", str(example("brick")))
    page.get_by_text("Sampling").locator("visible=true").click()
    steps = page.get_by_label("number input for Steps").locator("visible=true")
    steps.fill("50")
    steps.blur()
    page.get_by_role("button", name="Make it").locator("visible=true").click()
    page.get_by_role("button", name="Stop").locator("visible=true").click()
    page.get_by_text("Stopped.").or_(page.locator("img[src*='image.png']")).locator("visible=true").first.wait_for()
    assert page.get_by_text("Error", exact=True).locator("visible=true").count() == 0


def test_words_become_a_touch(page):
    page.get_by_role("tab", name="To touch").click()
    page.get_by_role("textbox", name="Words").fill("rough brick")
    assert "2 steps" in make(page)
