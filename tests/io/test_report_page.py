"""The report's page in a real browser, opened from disk."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from tests.commands.batches import add_frame, batch, pairs_on_disk
from tests.commands.report_pages import frames_of, page_data

pytest.importorskip("selenium", reason="needs selenium")

from selenium import webdriver
from selenium.webdriver import Keys
from selenium.webdriver.common.by import By
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.ui import WebDriverWait

STRANGE = "<img src=x onerror=document.title='run'>\n\"ü'"


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a batch of five frames, one with a strange name, and one that failed."""
    root = pairs_on_disk(tmp_path_factory.mktemp("batch"))
    add_frame(root, STRANGE, cv2.imread(str(root / "net/img.png"))[::-1])
    (root / "rgb/d.png").write_bytes(b"no image")
    batch(root, html=root / "out/report")
    return root / "out/report"


def size(chrome: webdriver.Chrome, width: int, height: int, *, dark: bool = False) -> None:
    screen = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
    chrome.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    chrome.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})


@pytest.fixture
def page(chrome: webdriver.Chrome, report: Path) -> webdriver.Chrome:
    size(chrome, 1280, 900)
    for kind in ("browser", "performance"):
        chrome.get_log(kind)  # what was before is not of this test
    chrome.get((report / "index.html").as_uri())
    return chrome


def one(page: webdriver.Chrome, css: str) -> WebElement:
    return page.find_element(By.CSS_SELECTOR, css)


def names(page: webdriver.Chrome) -> list[str]:
    script = "return [...document.querySelectorAll('#rows .open')].map(b => b.textContent)"
    return list(page.execute_script(script))


def press(page: webdriver.Chrome, *keys: str) -> None:
    page.switch_to.active_element.send_keys(*keys)


def wait(page: webdriver.Chrome, condition: Callable[[], bool]) -> None:
    WebDriverWait(page, 10, poll_frequency=0.02).until(lambda _: condition())


def shown_by(report: Path, key: str) -> list[str]:
    """The names as the page writes them, the lowest value first."""
    frames = frames_of(report).values()
    ordered = sorted(frames, key=lambda frame: frame["values"][key])
    return [frame["name"].replace("\n", "\\u000a") for frame in ordered]


def focused(page: webdriver.Chrome) -> str:
    return str(page.switch_to.active_element.get_attribute("textContent"))


def is_open(page: webdriver.Chrome) -> bool:
    return bool(page.execute_script("return document.getElementById('frame').open"))


def loaded(page: webdriver.Chrome, css: str) -> bool:
    script = "return [...document.querySelectorAll(arguments[0])].every(i => i.naturalWidth > 0)"
    return bool(page.execute_script(script, css))


def test_it_opens_from_disk_without_an_error_and_without_a_network(page: webdriver.Chrome) -> None:
    one(page, "#rows .open").click()
    wait(page, lambda: loaded(page, "img"))
    assert page.get_log("browser") == []
    requests = [
        message["params"]["request"]["url"]
        for entry in page.get_log("performance")
        for message in [json.loads(entry["message"])["message"]]
        if message["method"] == "Network.requestWillBeSent"
    ]
    assert len(requests) > 8  # the page, and two figures of each frame
    assert {url.split(":")[0] for url in requests} <= {"file", "data"}


def test_names_stay_text_and_what_failed_is_listed_with_its_reason(page: webdriver.Chrome) -> None:
    assert one(page, "#without-title").text == "Not refined: 1"
    text = one(page, "#reasons").text
    assert text.startswith("d")
    assert "d.png" in text
    assert page.title.endswith("Batch refinement")
    (name,) = [name for name in names(page) if "onerror" in name]
    assert name == STRANGE.replace("\n", "\\u000a")
    one(page, "#frames thead button").click()
    assert one(page, "#rows img[alt='']").is_displayed()
    assert not page.find_elements(By.CSS_SELECTOR, "img[src=x]")


def test_the_worst_frame_is_first_and_it_sorts_by_every_column_and_can_be_searched(
    page: webdriver.Chrome, report: Path
) -> None:
    worst_first = shown_by(report, "rmse_change")[::-1]
    assert names(page) == worst_first
    header = one(page, "#head th[data-column='0']")
    assert header.get_attribute("aria-sort") == "descending"
    header.find_element(By.TAG_NAME, "button").click()
    assert names(page) == worst_first[::-1]
    assert header.get_attribute("aria-sort") == "ascending"
    one(page, "#sort-column option[value='2']").click()  # an error: the largest is the worst
    assert names(page) == shown_by(report, page_data(report)["columns"][2]["key"])[::-1]
    one(page, "#sort-column option[value='-1']").click()
    by_name = sorted(name.replace("\n", "\\u000a") for name in frames_of(report))
    assert names(page) == by_name
    one(page, "#sort-turn").click()
    assert names(page) == by_name[::-1]
    one(page, "#filter").send_keys("B")
    assert names(page) == ["b"]
    assert one(page, "#count").text == "1 of 4 frames."


def test_a_frame_opens_moves_on_and_closes_by_keyboard_alone(page: webdriver.Chrome) -> None:
    order = names(page)
    for _ in range(40):
        press(page, Keys.TAB)
        if focused(page) == order[0]:
            break
    press(page, Keys.ARROW_DOWN)
    assert focused(page) == order[1]
    press(page, Keys.END)
    assert focused(page) == order[-1]
    press(page, Keys.HOME, Keys.ARROW_DOWN)
    press(page, Keys.ENTER)
    assert is_open(page)
    assert one(page, "#frame-title").text == order[1]
    press(page, "n")
    assert one(page, "#frame-title").text == order[2]
    press(page, "p")
    press(page, "p")
    assert one(page, "#frame-title").text == order[0]
    assert not one(page, "#previous").is_enabled()
    press(page, Keys.ESCAPE)
    wait(page, lambda: not is_open(page))
    wait(page, lambda: focused(page) == order[0])


def test_the_slider_moves_by_keyboard_and_pointer_and_names_its_position(
    page: webdriver.Chrome,
) -> None:
    one(page, "#rows .open").send_keys(Keys.ENTER)
    slider = page.switch_to.active_element
    for key, position in ((Keys.ARROW_RIGHT, 51), (Keys.HOME, 0), (Keys.END, 100)):
        slider.send_keys(key)
        text = f"{position} % Before, {100 - position} % After"
        assert slider.get_attribute("aria-valuetext") == text
        clip = page.execute_script("return document.querySelector('.over').style.clipPath")
        assert clip.startswith(f"inset(0px {100 - position}%")
    wait(page, lambda: loaded(page, "#views img"))
    left = -round(one(page, "#views .stage").rect["width"] / 4)  # from the middle
    actions = webdriver.ActionChains(page)
    actions.move_to_element_with_offset(one(page, "#views .stage"), left, 0).click().perform()
    assert abs(int(slider.get_property("value")) - 25) <= 1


def test_the_histogram_counts_all_frames_and_has_a_text_alternative(page: webdriver.Chrome) -> None:
    bars = page.find_elements(By.CSS_SELECTOR, "#chart .bar title")
    counts = [int(b.get_attribute("textContent").split(": ")[1].split()[0]) for b in bars]
    assert sum(counts) == 4
    label = one(page, "#chart svg").get_attribute("aria-label")
    assert label.startswith("Histogram of RMSE change: 4 frames, median ")
    assert label.endswith("; 4 better, 0 worse")
    one(page, "#chart-column option[value='1']").click()
    assert "RMSE before" in one(page, "#chart svg").get_attribute("aria-label")


@pytest.mark.parametrize(("width", "dark"), [(320, False), (768, True), (1280, False)])
def test_no_width_overflows_and_colours_are_those_that_the_reader_prefers(
    page: webdriver.Chrome, width: int, dark: bool
) -> None:
    size(page, width, 800, dark=dark)
    page.refresh()
    script = "const e = {}; return [e.scrollWidth, e.clientWidth]"
    inner, outer = page.execute_script(script.replace("{}", "document.documentElement"))
    assert inner == outer <= width  # a scroll bar takes some of it
    style = "const s = getComputedStyle(document.body); return [s.color, s.backgroundColor]"
    ink, paper = (
        sum(int(level) for level in colour[4:-1].split(","))
        for colour in page.execute_script(style)
    )
    assert (ink > paper) == dark
    assert abs(ink - paper) > 500
    one(page, "#rows .open").send_keys(Keys.ENTER)
    wait(page, lambda: loaded(page, "#views img"))
    inner, outer = page.execute_script(script.replace("{}", "document.getElementById('frame')"))
    assert inner == outer <= width


def test_every_control_has_a_name(page: webdriver.Chrome) -> None:
    for part in ("main", "#frame"):
        for control in one(page, part).find_elements(By.CSS_SELECTOR, "button, input, select"):
            if control.is_displayed():
                assert control.accessible_name, control.get_attribute("outerHTML")
        if part == "main":
            one(page, "#rows .open").send_keys(Keys.ENTER)
    for image in page.find_elements(By.CSS_SELECTOR, "#views img"):
        assert image.get_attribute("alt")
