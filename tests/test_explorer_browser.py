"""The explorer in headless Chromium: pointing, choosing, playing, keyboard, small screens."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

for extra in ("scipy", "matplotlib", "jinja2", "sklearn"):
    pytest.importorskip(extra)

from explorers import EVIL, STEPS, TASK_COLORS, TASKS, make_explorer, page_of


class Browser:
    """A page in headless Chromium."""

    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def open(self, path: Path) -> None:
        self.driver.get_log("browser")  # removes earlier messages
        self.driver.get(path.as_uri())

    def part(self, name: str) -> Any:
        return self.driver.find_element("css selector", f'[data-part="{name}"]')

    def shown(self, name: str) -> str:
        return self.part(f"show-{name}").text

    def choose(self, part: str, text: str) -> None:
        from selenium.webdriver.support.select import Select

        Select(self.part(part)).select_by_visible_text(text)

    def wait(self, condition: Callable[[], bool]) -> None:
        from selenium.webdriver.support.wait import WebDriverWait

        WebDriverWait(self.driver, 60, poll_frequency=0.02).until(lambda _: condition())

    def pixels(self, color: str) -> list[tuple[int, int]]:
        """Pixels (x, y) of the canvas in a colour, opaque or half transparent."""
        return self.driver.execute_script(
            """
            const [canvas, hex] = arguments;
            const {width, height} = canvas;
            const data = canvas.getContext("2d").getImageData(0, 0, width, height).data;
            const want = [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
            const alphas = [1, 0.5];
            const found = [];
            for (let i = 0; i < data.length; i += 4) {
              const share = data[i + 3] / 255;
              if (!alphas.some((a) => Math.abs(share - a) < 0.01)) continue;
              if (want.some((v, k) => Math.abs(data[i + k] - v) > 2)) continue;
              const pixel = i / 4;
              found.push([pixel % width, Math.floor(pixel / width)]);
            }
            return found.map(([x, y]) => [x / devicePixelRatio, y / devicePixelRatio]);
            """,
            self.part("canvas"),
            color,
        )

    def point_at(self, x: float, y: float, *, click: bool = False) -> None:
        from selenium.webdriver.common.action_chains import ActionChains

        canvas = self.part("canvas")
        # Offsets are from the middle of the visible part, so all of it must be visible.
        self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", canvas)
        size = canvas.size
        chain = ActionChains(self.driver)
        chain.move_to_element_with_offset(
            canvas, round(x - size["width"] / 2), round(y - size["height"] / 2)
        )
        (chain.click() if click else chain).perform()


def missing_browser() -> str | None:
    for program in ("chromium", "chromedriver"):
        if shutil.which(program) is None:
            return f"{program} is not installed"
    return None


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    # .ci/run sets it: a test that cannot run fails.
    required = bool(os.environ.get("BMRL_REQUIRE_BROWSER"))
    if (problem := missing_browser()) and not required:
        pytest.skip(problem)
    webdriver = pytest.importorskip("selenium.webdriver")
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or "chromium"
    for flag in (
        "headless",
        "no-sandbox",
        "disable-gpu",
        "disable-quic",
        "disable-dev-shm-usage",
        "no-first-run",
        "disable-background-networking",
        "disable-component-update",
        "disable-sync",
        "window-size=1200,1000",
        f"user-data-dir={tmp_path_factory.mktemp('browser')}",
    ):
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    service = Service(shutil.which("chromedriver") or "chromedriver")
    driver = webdriver.Chrome(options=options, service=service)
    yield driver
    driver.quit()


@pytest.fixture
def browser(driver: Any, tmp_path: Path) -> Browser:
    browser = Browser(driver)
    driver.get("about:blank")
    driver.get_log("performance")
    browser.open(page_of(make_explorer(), tmp_path))
    return browser


def test_the_page_opens_without_errors_and_without_a_request(
    browser: Browser, tmp_path: Path
) -> None:
    browser.wait(lambda: bool(browser.pixels(TASK_COLORS["reach"])))
    assert browser.driver.get_log("browser") == []
    log = browser.driver.get_log("performance")
    events = [json.loads(entry["message"])["message"] for entry in log]
    sent = [e["params"]["request"] for e in events if e["method"] == "Network.requestWillBeSent"]
    asked = [request["url"] for request in sent]
    # Only the file itself; its pictures are data URLs.
    files = [url for url in asked if not url.startswith("data:")]
    assert files == [(tmp_path / "report.html").as_uri()]
    assert browser.shown("task") == "Reach"


def test_pointing_at_a_point_shows_its_moment_and_leaving_it_the_chosen_one(
    browser: Browser,
) -> None:
    for task in ("lift", "push_down"):
        pixels = browser.pixels(TASK_COLORS[task])
        # Episode 1 is the lower of two lines; its last point is the rightmost.
        x = max(x for x, _ in pixels)
        y = max(y for _, y in pixels)
        browser.point_at(x - 2, y - 2)
        browser.wait(lambda task=task: browser.shown("task") == task.replace("_", " ").title())
        assert browser.shown("episode") == "1 of 2"
        assert browser.shown("time") == "1.00 s (step 20)"
        assert browser.shown("phase") == "near"
        assert browser.shown("distance") == "0.300 m"
        assert browser.shown("success") == "yes"
        y = min(y for _, y in pixels)
        browser.point_at(min(x for x, _ in pixels) + 2, y + 2)
        browser.wait(lambda: browser.shown("episode") == "2 of 2")
        assert browser.shown("time") == "0.00 s (step 0)"
        assert browser.shown("phase") == "far"
        assert browser.shown("success") == "no"
        assert browser.part("which").text == "Under the pointer"
        assert "No pictures" in browser.part("noframe").text
    browser.point_at(2, 2)
    browser.wait(lambda: browser.part("which").text == "Chosen point")
    assert browser.shown("task") == "Reach"


def test_clicking_a_point_chooses_its_episode_and_moment(browser: Browser) -> None:
    pixels = browser.pixels(TASK_COLORS["lift"])
    browser.point_at(max(x for x, _ in pixels) - 2, max(y for _, y in pixels) - 2, click=True)
    browser.point_at(2, 2)
    browser.wait(lambda: browser.part("which").text == "Chosen point")
    assert browser.shown("task") == "Lift"
    assert browser.shown("time") == "1.00 s (step 20)"
    assert browser.part("slider").get_attribute("value") == "20"
    lift = str(2 * TASKS.index("lift"))
    assert browser.part("episode").get_attribute("value") == lift


def test_choosing_a_task_hides_the_others(browser: Browser) -> None:
    browser.wait(lambda: all(browser.pixels(c) for c in TASK_COLORS.values()))
    assert len(browser.driver.find_elements("css selector", ".explorer li")) == 6
    browser.choose("task", "Push Left")
    browser.wait(lambda: not browser.pixels(TASK_COLORS["reach"]))
    for task, color in TASK_COLORS.items():
        assert bool(browser.pixels(color)) == (task == "push_left")
    options = browser.part("episode").text.split("\n")
    assert [option.strip() for option in options] == ["Push Left 1 (film)", "Push Left 2"]
    assert browser.shown("task") == "Push Left"
    (legend,) = browser.driver.find_elements("css selector", ".explorer li")
    assert legend.text == "Push Left"


def test_playing_moves_the_slider_and_the_picture_to_the_end(browser: Browser) -> None:
    browser.choose("task", "Push Up")
    play, slider, frame = (browser.part(n) for n in ("play", "slider", "frame"))
    first = frame.get_attribute("src")
    assert slider.get_attribute("value") == "0"
    play.click()
    browser.wait(lambda: int(slider.get_attribute("value")) > 0)
    browser.wait(lambda: frame.get_attribute("src") != first)
    browser.wait(lambda: slider.get_attribute("value") == "20")
    browser.wait(lambda: play.text == "Play")
    assert browser.shown("time") == "1.00 s (step 20)"
    assert frame.get_attribute("alt") == "Push Up, episode 1, at 1.00 s"
    # It is decoded and has its own size.
    browser.wait(lambda: frame.get_property("naturalWidth") == 16)


def test_everything_can_be_done_with_the_keyboard(browser: Browser) -> None:
    from selenium.webdriver.common.keys import Keys

    browser.part("task").send_keys("Lift")
    browser.wait(lambda: browser.shown("task") == "Lift")
    browser.part("episode").send_keys("Lift 2")
    browser.wait(lambda: browser.shown("episode") == "2 of 2")
    slider = browser.part("slider")
    slider.send_keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    assert browser.shown("time") == "0.10 s (step 2)"
    assert slider.get_attribute("aria-valuetext") == "0.10 s, 0.480 m"
    browser.part("play").send_keys(Keys.SPACE)
    browser.wait(lambda: slider.get_attribute("value") == "20")


def test_colors_can_show_phase_and_distance(browser: Browser) -> None:
    def legend() -> list[str]:
        return [e.text for e in browser.driver.find_elements("css selector", ".explorer li")]

    browser.choose("coloring", "phase")
    assert legend() == ["far", "near"]
    assert not browser.pixels(TASK_COLORS["push_right"])
    browser.choose("coloring", "distance to goal")
    assert legend() == ["distance to goal: 0 to 0.50 m"]
    assert browser.pixels("#fde725")  # the last colour of viridis


def test_what_is_unknown_is_a_dash_and_times_are_steps(browser: Browser, tmp_path: Path) -> None:
    rows = 12 * STEPS
    explorer = make_explorer(
        distance=np.full(rows, np.nan), success=np.full(rows, None), periods={}
    )
    browser.open(page_of(explorer, tmp_path))
    browser.wait(lambda: bool(browser.pixels(TASK_COLORS["reach"])))
    assert (browser.shown("distance"), browser.shown("success")) == ("–", "–")
    assert browser.shown("time") == browser.part("clock").text == "step 0"
    assert "distance" not in browser.part("coloring").text
    browser.part("play").click()
    browser.wait(lambda: browser.shown("time") == "step 20")
    assert browser.driver.get_log("browser") == []


def test_markup_in_names_is_shown_and_not_run(browser: Browser, tmp_path: Path) -> None:
    evil = make_explorer(phase=[EVIL] * (12 * STEPS), note=EVIL, frames={})
    browser.open(page_of(evil, tmp_path))
    browser.choose("coloring", "phase")
    assert browser.shown("phase") == EVIL
    assert browser.part("noframe").text == EVIL
    assert browser.driver.title == "A run"
    assert browser.driver.get_log("browser") == []


def test_a_single_point_is_shown(browser: Browser, tmp_path: Path) -> None:
    one = make_explorer()
    row: dict[str, Any] = {
        name: getattr(one, name)[:1]
        for name in ("task_latent", "task", "episode", "step", "distance", "phase", "success")
    }
    browser.open(page_of(replace(one, **row, frames={}), tmp_path))
    browser.wait(lambda: bool(browser.pixels(TASK_COLORS["reach"])))
    browser.part("play").click()
    browser.wait(lambda: browser.part("play").text == "Play")
    assert browser.driver.get_log("browser") == []


def test_a_click_on_a_member_of_a_family_plays_its_film(browser: Browser, tmp_path: Path) -> None:
    from families import lifted

    browser.open(page_of(lifted(), tmp_path))
    yellow = "#fde725"  # of the largest height, which lies at the right
    browser.wait(lambda: browser.part("which").text == "Chosen point")
    pixels = browser.pixels(yellow)  # once: Chromium warns of more
    browser.point_at(*(sum(axis) / len(pixels) for axis in zip(*pixels, strict=True)), click=True)
    slider = browser.part("slider")
    browser.wait(lambda: slider.get_attribute("value") == "2")
    assert browser.shown("task") == "Lift to height 26"
    assert browser.shown("fact-0") == "26"
    assert browser.shown("fact-1") == "held out, outside the trained range"
    assert browser.shown("time") == "0.50 s (step 10)"
    # The pointer is still on the point; the film of it is what is shown.
    assert browser.part("which").text == "Chosen point"
    assert browser.part("frame").get_attribute("alt") == "Lift to height 26, at 0.50 s"
    assert not browser.part("show-phase").is_displayed()
    assert browser.driver.get_log("browser") == []


def test_without_films_there_is_nothing_to_play(browser: Browser, tmp_path: Path) -> None:
    from families import lifted

    browser.open(page_of(lifted(films=False, note="egl: none."), tmp_path))
    assert browser.part("noframe").text == "There are no films: egl: none."
    assert not browser.part("play").is_displayed()
    assert browser.driver.get_log("browser") == []


def test_the_page_fits_a_narrow_screen(browser: Browser) -> None:
    driver = browser.driver
    before = driver.get_window_size()
    try:
        driver.execute_cdp_cmd(
            "Emulation.setDeviceMetricsOverride",
            {"width": 400, "height": 800, "deviceScaleFactor": 2, "mobile": True},
        )
        browser.wait(lambda: driver.execute_script("return innerWidth") == 400)
        width = driver.execute_script("return document.documentElement.scrollWidth")
        assert width <= 400
        browser.wait(lambda: bool(browser.pixels(TASK_COLORS["reach"])))
    finally:
        driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
        driver.set_window_size(**{k: before[k] for k in ("width", "height")})
