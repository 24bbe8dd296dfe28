"""The 3D view of a report in a real browser, opened from disk."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pnpdepth_cli.dataset.read_options import ScanOptions
from pnpdepth_cli.errors import UsageError
from pnpdepth_cli.io.report import VIEWER
from tests.commands.batches import batch, pairs_on_disk
from tests.commands.report_pages import page_data

pytest.importorskip("selenium", reason="needs selenium")

from selenium import webdriver
from selenium.webdriver import Keys
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

BACKGROUND = (0x1B, 0x1D, 0x21)


def with_camera(root: Path) -> dict[str, ScanOptions]:
    """Options of a batch whose images see 60°."""
    with Image.open(root / "rgb/a.png") as image:
        width, height = image.size
    focal = width / 2 / np.tan(np.deg2rad(30))
    path = root / "k.txt"
    path.write_text(f"{focal} 0 {(width - 1) / 2} 0 {focal} {(height - 1) / 2} 0 0 1\n")
    return {"scan": ScanOptions(calib=path)}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A batch of two frames, one of them without ground truth, with a report."""
    root = pairs_on_disk(tmp_path_factory.mktemp("batch"), ("a", "b"))
    (root / "gt/b.png").unlink()
    batch(root, html=root / "out" / "report", html_3d=True, refine=with_camera(root))
    return root


@pytest.fixture
def page(chrome: webdriver.Chrome, root: Path) -> webdriver.Chrome:
    screen = {"width": 1280, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    chrome.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    for kind in ("browser", "performance"):
        chrome.get_log(kind)  # what was before is not of this test
    chrome.get((root / "out" / "report" / "index.html").as_uri())
    return chrome


def wait(page: webdriver.Chrome, condition: Callable[[], bool]) -> None:
    WebDriverWait(page, 20, poll_frequency=0.02).until(lambda _: condition())


def open_view(page: webdriver.Chrome, name: str = "a") -> None:
    """Opens the frame and its 3D view."""
    ask_for_view(page, name)
    wait(page, lambda: bool(page.find_elements(By.CSS_SELECTOR, ".switch")))


def ask_for_view(page: webdriver.Chrome, name: str) -> None:
    rows = page.find_elements(By.CSS_SELECTOR, "#rows .open")
    next(row for row in rows if row.text == name).send_keys(Keys.ENTER)
    page.find_element(By.CSS_SELECTOR, "button.load").send_keys(Keys.ENTER)


def choose(page: webdriver.Chrome, name: str) -> None:
    css = f".switch input[value='{name}']"
    page.execute_script("document.querySelector(arguments[0]).click()", css)


def pixels(page: webdriver.Chrome) -> np.ndarray:
    """The canvas as it is on the screen, after the next frames are drawn."""
    canvas = page.find_element(By.CSS_SELECTOR, ".space canvas")
    page.execute_async_script(
        "const [canvas, done] = arguments; canvas.scrollIntoView({block: 'center'});"
        "requestAnimationFrame(() => requestAnimationFrame(done))",
        canvas,
    )
    png = canvas.screenshot_as_png
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def test_before_after_and_ground_truth_are_drawn_and_differ(page: webdriver.Chrome) -> None:
    open_view(page)
    drawn = {}
    for name in ("before", "after", "gt"):
        choose(page, name)
        drawn[name] = pixels(page)
        coloured = (np.abs(drawn[name] - BACKGROUND).sum(axis=2) > 20).mean()
        assert coloured > 0.01, name
    for one, other in (("before", "after"), ("after", "gt")):
        assert (np.abs(drawn[one] - drawn[other]).sum(axis=2) > 20).mean() > 0.001
    choose(page, "before")
    assert (pixels(page) == drawn["before"]).all()


def test_it_opens_from_disk_without_an_error_or_a_network_and_is_not_loaded_before(
    page: webdriver.Chrome,
) -> None:
    page.find_element(By.CSS_SELECTOR, "#rows .open").click()
    wait(page, lambda: bool(page.find_elements(By.CSS_SELECTOR, "button.load")))
    assert not [entry for entry in page.get_log("performance") if VIEWER in entry["message"]]
    page.find_element(By.CSS_SELECTOR, "#close").click()
    open_view(page)
    pixels(page)
    messages = [entry["message"] for entry in page.get_log("browser")]
    assert [text for text in messages if "GL Driver Message" not in text] == []
    requests = [
        message["params"]["request"]["url"]
        for entry in page.get_log("performance")
        for message in [json.loads(entry["message"])["message"]]
        if message["method"] == "Network.requestWillBeSent"
    ]
    assert any(url.endswith(VIEWER) for url in requests)
    assert {url.split(":")[0] for url in requests} <= {"file", "data"}


def test_dragging_turns_the_cloud_and_reset_turns_it_back(page: webdriver.Chrome) -> None:
    open_view(page)
    start = pixels(page)
    canvas = page.find_element(By.CSS_SELECTOR, ".space canvas")
    actions = webdriver.ActionChains(page).move_to_element(canvas).click_and_hold()
    actions.move_by_offset(120, 30).release().perform()
    assert (pixels(page) != start).any()
    page.find_element(By.CSS_SELECTOR, ".switch button").click()
    webdriver.ActionChains(page).move_by_offset(0, 0).perform()
    assert (pixels(page) == start).all()


def test_a_frame_without_ground_truth_has_two_clouds_and_the_next_opens_at_once(
    page: webdriver.Chrome,
) -> None:
    open_view(page, "b")
    names = [i.get_attribute("value") for i in page.find_elements(By.CSS_SELECTOR, ".switch input")]
    assert names == ["before", "after"]
    page.find_element(By.CSS_SELECTOR, "#previous:enabled, #next:enabled").click()
    wait(page, lambda: bool(page.find_elements(By.CSS_SELECTOR, ".switch input[value=gt]")))
    assert page.find_element(By.CSS_SELECTOR, "#frame-title").text == "a"


def test_a_phone_shows_it_without_overflow_and_leaves_touches_to_it(page: webdriver.Chrome) -> None:
    screen = {"width": 360, "height": 740, "deviceScaleFactor": 2, "mobile": True}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    page.refresh()
    open_view(page)
    script = "const e = document.getElementById('frame'); return [e.scrollWidth, e.clientWidth]"
    inner, outer = page.execute_script(script)
    assert inner == outer <= 360
    canvas = page.find_element(By.CSS_SELECTOR, ".space canvas")
    assert canvas.value_of_css_property("touch-action") == "none"
    assert canvas.accessible_name.endswith("points")


def test_a_missing_view_is_reported(page: webdriver.Chrome, root: Path) -> None:
    (key,) = [
        each["key"] for each in page_data(root / "out" / "report")["frames"] if each["name"] == "b"
    ]
    script = root / "out" / "report" / "images" / f"{key}_view.js"
    moved = script.rename(script.with_suffix(".away"))
    try:
        ask_for_view(page, "b")
        wait(page, lambda: "cannot be shown" in page.find_element(By.CSS_SELECTOR, ".space").text)
    finally:
        moved.rename(script)


def test_a_report_without_views_holds_no_other_script_and_views_need_report_and_camera(
    tmp_path: Path,
) -> None:
    root = pairs_on_disk(tmp_path, ("a",))
    report, camera = root / "out" / "report", with_camera(root)
    batch(root, html=report, html_3d=True, refine=camera)
    assert (report / VIEWER).stat().st_size > 500_000
    assert len(list((report / "images").glob("*_view.js"))) == 1
    batch(root, html=report, refine=camera)
    assert not (report / VIEWER).exists()
    assert list((report / "images").glob("*_view.js")) == []
    text = (report / "index.html").read_text()
    assert " file:;" not in text.split("script-src")[1].split('"')[0]

    with pytest.raises(UsageError, match="--html-3d adds to the report"):
        batch(root, html_3d=True)
    with pytest.raises(UsageError, match="--html-3d needs the camera"):
        batch(root, html=report, html_3d=True)
