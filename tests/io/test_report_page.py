"""The report's page with its 3D view in a real browser, opened from disk."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from pnpdepth_cli.dataset.frame_files import ScanOptions
from pnpdepth_cli.io.report import VIEWER
from tests.commands.batches import add_frame, batch, pairs_on_disk
from tests.commands.report_pages import frames_of

pytest.importorskip("selenium", reason="needs selenium")

from selenium import webdriver
from selenium.webdriver import Keys
from selenium.webdriver.common.by import By
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.ui import WebDriverWait

BACKGROUND = (0x1B, 0x1D, 0x21)
STRANGE = "<img src=x onerror=document.title='run'>\n\"ü'"


@pytest.fixture(scope="module")
def chrome() -> Iterator[webdriver.Chrome]:
    programs = [shutil.which(name) for name in ("chromium", "google-chrome")]
    program = next(filter(None, programs), None)
    driver = shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip("needs chromium and chromedriver (Debian: apt install chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    for argument in ("headless=new", "no-sandbox", "disable-dev-shm-usage"):
        options.add_argument(f"--{argument}")
    options.add_argument("--enable-unsafe-swiftshader")  # WebGL without a graphics card
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    yield browser
    browser.quit()


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a batch of five frames, one with a strange name, and one that failed."""
    root = pairs_on_disk(tmp_path_factory.mktemp("batch"))
    add_frame(root, STRANGE, cv2.imread(str(root / "net/img.png"))[::-1])
    (root / "rgb/d.png").write_bytes(b"no image")
    height, width = cv2.imread(str(root / "rgb/a.png")).shape[:2]
    (root / "k.txt").write_text(f"{width} 0 {width / 2} 0 {width} {height / 2} 0 0 1\n")
    camera = {"scan": ScanOptions(calib=root / "k.txt")}
    batch(root, html=root / "out/report", html_3d=True, refine=camera)
    return root / "out/report"


@pytest.fixture
def page(chrome: webdriver.Chrome, report: Path) -> webdriver.Chrome:
    for kind in ("browser", "performance"):
        chrome.get_log(kind)  # what was before is not of this test
    chrome.get((report / "index.html").as_uri())
    return chrome


def one(page: webdriver.Chrome, css: str) -> WebElement:
    return page.find_element(By.CSS_SELECTOR, css)


def names(page: webdriver.Chrome) -> list[str]:
    return [row.text for row in page.find_elements(By.CSS_SELECTOR, "#rows .open")]


def open_view(page: webdriver.Chrome) -> None:
    """Opens the 3D view of frame a."""
    rows = page.find_elements(By.CSS_SELECTOR, "#rows .open")
    rows[names(page).index("a")].send_keys(Keys.ENTER)
    one(page, "button.load").send_keys(Keys.ENTER)
    WebDriverWait(page, 20, poll_frequency=0.02).until(lambda _: one(page, ".switch"))


def requested(page: webdriver.Chrome) -> list[str]:
    messages = [json.loads(entry["message"])["message"] for entry in page.get_log("performance")]
    sent = [message for message in messages if message["method"] == "Network.requestWillBeSent"]
    return [message["params"]["request"]["url"] for message in sent]


def test_it_opens_without_a_network_and_loads_views_when_asked(page: webdriver.Chrome) -> None:
    loaded = (
        "const all = [...document.querySelectorAll('img')];"
        "all.forEach(each => { each.loading = 'eager' });"  # those below the window, too
        "return all.every(each => each.naturalWidth > 0)"
    )
    WebDriverWait(page, 20, poll_frequency=0.02).until(lambda _: page.execute_script(loaded))
    before = requested(page)
    open_view(page)
    urls = before + requested(page)
    assert not any(url.endswith(VIEWER) for url in before)
    assert any(url.endswith(VIEWER) for url in urls)
    assert {url.split(":")[0] for url in urls} <= {"file", "data"}
    messages = [entry["message"] for entry in page.get_log("browser")]
    assert [text for text in messages if "GL Driver Message" not in text] == []


def test_before_after_and_ground_truth_are_drawn_and_differ(page: webdriver.Chrome) -> None:
    open_view(page)
    canvas = one(page, ".space canvas")
    drawn = {}
    for name in ("before", "after", "gt"):
        page.execute_async_script(
            "const [css, canvas, done] = arguments; document.querySelector(css).click();"
            "canvas.scrollIntoView({block: 'center'});"
            "requestAnimationFrame(() => requestAnimationFrame(done))",
            f".switch input[value='{name}']",
            canvas,
        )
        png = Image.open(io.BytesIO(canvas.screenshot_as_png)).convert("RGB")
        drawn[name] = np.asarray(png).astype(int)
        assert (np.abs(drawn[name] - BACKGROUND).sum(axis=2) > 20).mean() > 0.01, name
    for first, second in (("before", "after"), ("after", "gt")):
        assert (np.abs(drawn[first] - drawn[second]).sum(axis=2) > 20).mean() > 0.001


def test_frames_are_sorted_worst_first_and_searched(page: webdriver.Chrome, report: Path) -> None:
    frames = frames_of(report).values()
    ordered = sorted(frames, key=lambda frame: -frame["values"]["rmse_change"])
    worst_first = [frame["name"].replace("\n", "\\u000a") for frame in ordered]
    assert names(page) == worst_first
    one(page, "#head th[data-column='0'] button").click()
    assert names(page) == worst_first[::-1]
    one(page, "#filter").send_keys("B")
    assert names(page) == ["b"]
