"""The page of `unitouch-gen app` in a headless Chromium: what a person does, on a phone and in the dark too."""

import shutil
from pathlib import Path
from urllib.parse import urlparse

import pytest

from tests.helpers import served

pytest.importorskip("gradio", reason="the extra `app` is not installed")
playwright = pytest.importorskip("playwright.sync_api", reason="the extra `test` is not installed")

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
PATIENCE = 60_000
"""Milliseconds, of a machine that does much else."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here; on Debian: apt install chromium"),
]


EARS = ["--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream"]


@pytest.fixture(scope="module")
def address(make_components, make_x_to_touch, tmp_path_factory):
    pipes = served.tiny_pipelines(make_components(), make_x_to_touch())
    with served.page(pipes, tmp_path_factory.mktemp("served")) as url:
        yield url


@pytest.fixture(scope="module")
def chromium():
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *EARS])
        yield browser
        browser.close()


@pytest.fixture
def visit(chromium, address):
    """Opens the page, in a window of some kind; the page must ask no other host for anything, and have no errors."""
    pages, asked, broken = [], [], []

    def visit(**window):
        page = chromium.new_context(**window, permissions=["microphone"]).new_page()
        page.set_default_timeout(PATIENCE)
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: broken.append(str(error)))
        page.goto(address)
        page.get_by_role("button", name="Make pictures").wait_for()
        pages.append(page)
        return page

    yield visit
    for page in pages:
        page.context.close()
    hosts = {urlparse(url).hostname for url in asked if url.startswith("http")}
    assert (hosts, broken) == ({"127.0.0.1"}, [])


def upload(page, label, file):
    """Puts a file where the first part of that label takes one."""
    part = page.locator(".block", has=page.get_by_text(label, exact=True))
    part.locator("input[type=file]").first.set_input_files(file)


def picture_made(page):
    """Waits for a picture that the page shows as made."""
    made = page.locator("img[src*='seed-']").locator("visible=true").first
    made.wait_for()
    assert made.evaluate("image => image.decode().then(() => image.naturalWidth)") == 16


def test_a_touch_is_uploaded_and_becomes_a_picture(here, visit):
    page = visit()
    upload(page, "Touch", "in/dark.png")
    page.locator("img[src*='dark.png']").first.wait_for()
    page.get_by_role("button", name="Make pictures").click()
    picture_made(page)
    feels = page.get_by_label("Feels like").first.input_value()
    assert "%" in feels and "error" not in feels
    assert "2 steps" in page.get_by_label("Run report of the solver").first.input_value()


def test_a_bad_file_has_a_line_and_the_page_goes_on(here, visit):
    Path("in/words.png").write_text("no picture")
    page = visit()
    upload(page, "Touch", "in/words.png")
    page.locator("img[src*='words.png']").first.wait_for(state="attached")
    page.get_by_role("button", name="Make pictures").click()
    line = page.get_by_test_id("toast-text").first
    line.wait_for()
    assert "touch" in line.inner_text() and "words.png" in line.inner_text() and "\n" not in line.inner_text()
    page.reload()
    upload(page, "Touch", "in/bright.png")
    page.locator("img[src*='bright.png']").first.wait_for()
    page.get_by_role("button", name="Make pictures").click()
    picture_made(page)


def test_words_and_the_microphone_become_touches(here, visit):
    page = visit()
    page.get_by_role("tab", name="To touch").click()
    page.get_by_role("textbox", name="Words").fill("rough brick")
    page.get_by_role("button", name="Make touches").click()
    picture_made(page)
    report = page.get_by_label("Run report of the solver").last
    of_words = report.input_value()
    page.get_by_label("a sound", exact=True).check()
    page.get_by_role("button", name="Record audio").first.click()  # in the place of a file
    page.get_by_role("button", name="Record", exact=True).first.click()
    page.wait_for_timeout(2000)
    with page.expect_response(lambda answer: "/upload" in answer.url):
        page.get_by_role("button", name="Stop").first.click()
    page.get_by_role("button", name="Make touches").click()
    playwright.expect(report).not_to_have_value(of_words, timeout=PATIENCE)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_is_wider_than_a_phone(here, visit, scheme):
    page = visit(viewport={"width": 375, "height": 812}, color_scheme=scheme, device_scale_factor=2)
    for tab in ("To picture", "Style a photo", "To touch"):
        page.get_by_role("tab", name=tab).click()
        assert page.evaluate("document.documentElement.scrollWidth") <= 375
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).every(value => value < 60)")
    assert dark == (scheme == "dark")
