"""The explorer shows what it was given: as data, in a browser, and with films of demonstrations."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

import io
import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

for extra in ("scipy", "matplotlib", "jinja2", "sklearn"):
    pytest.importorskip(extra)

from PIL import Image

from torchrl_bmrl.errors import BMRLError, DataError, RenderError
from torchrl_bmrl.reports import (
    Embeddings,
    Explorer,
    Section,
    paper,
    task_colors,
    task_titles,
    write_page,
)

STEPS = 21
TASKS = tuple(paper.TABLE_1)
TASK_COLORS = dict(zip(TASKS, task_colors(len(TASKS)), strict=True))
EVIL = "</script><script>document.title = 'taken'</script>"


def webp(color: tuple[int, int, int]) -> bytes:
    data = io.BytesIO()
    Image.new("RGB", (16, 16), color).save(data, "WEBP", lossless=True)
    return data.getvalue()


def make_explorer(**changes: Any) -> Explorer:
    """Six tasks of two episodes, each a line from left to right, none near another.

    The first episode of each task has a film of three pictures.
    """
    task, episode, step = (a.ravel() for a in np.mgrid[:6, :2, :STEPS])
    explorer = Explorer(
        titles=list(task_titles(TASKS).values()),
        periods=dict.fromkeys(range(6), 0.05),
        task_latent=np.stack([step / 2.0, 2.0 * task + episode], axis=1),
        task=task,
        episode=episode,
        step=step,
        distance=0.5 - step / 100,
        phase=["near" if s >= 10 else "far" for s in step],
        success=step >= 15,
        frames={(t, 0, s): webp((40 * t, 10 * s, 0)) for t in range(6) for s in (0, 10, 20)},
    )
    return replace(explorer, **changes)


def content_of(html: str) -> dict[str, Any]:
    """The data that the script reads."""
    match = re.search(r'<script type="application/json">(.*?)</script>', html, re.DOTALL)
    assert match is not None
    return json.loads(match[1])


def page_of(explorer: Explorer, folder: Path) -> Path:
    path = folder / "report.html"
    section = Section(heading="Explore", paragraphs=explorer.paragraphs(), explorer=explorer)
    write_page(path, title="A run", facts={}, sections=[section])
    return path


# Data


def test_every_transition_is_in_the_data_once() -> None:
    explorer = make_explorer()
    episodes = content_of(explorer.html())["episodes"]
    assert len(episodes) == 12
    rows = [
        (e["task"], e["number"], s, x, y, d, ok)
        for e in episodes
        for s, x, y, d, ok in zip(
            e["step"], e["x"], e["y"], e["distance"], e["success"], strict=True
        )
    ]
    expected = zip(
        explorer.task,
        explorer.episode + 1,
        explorer.step,
        *explorer.task_latent.T,
        explorer.distance.round(5),
        explorer.success,
        strict=True,
    )
    assert rows == [tuple(row) for row in expected]
    assert [len(e["frames"]) for e in episodes] == [3, 0] * 6


def test_the_order_of_transitions_does_not_matter() -> None:
    explorer = make_explorer()
    order = np.random.default_rng(0).permutation(len(explorer.task))
    columns = ("task_latent", "task", "episode", "step", "distance", "success")
    shuffled: dict[str, Any] = {name: getattr(explorer, name)[order] for name in columns}
    shuffled["phase"] = [explorer.phase[i] for i in order]
    assert replace(explorer, **shuffled).html() == explorer.html()


def test_what_is_unknown_is_null_in_the_data() -> None:
    rows = 12 * STEPS
    explorer = make_explorer(
        distance=np.full(rows, np.nan), success=np.full(rows, None), periods={1: 0.02}
    )
    content = content_of(explorer.html())
    assert {d for e in content["episodes"] for d in e["distance"] + e["success"]} == {None}
    assert [task["period"] for task in content["tasks"]] == [None, 0.02, None, None, None, None]


def test_names_from_data_cannot_leave_the_data() -> None:
    explorer = make_explorer(phase=[EVIL] * (12 * STEPS), note=EVIL)
    html = explorer.html()
    assert html.count("<script") == html.count("</script>") == 2
    content = content_of(html)
    assert (content["phases"][0]["name"], content["note"]) == (EVIL, EVIL)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_embeddings_of_other_sizes_are_shown_in_a_plane_and_the_page_says_so(dim: int) -> None:
    latent = np.random.default_rng(0).normal(size=(12 * STEPS, dim))
    explorer = make_explorer(task_latent=latent)
    content, text = content_of(explorer.html()), " ".join(explorer.paragraphs())
    assert all(len(e["x"]) == len(e["y"]) == STEPS for e in content["episodes"])
    axis = "principal component 1 (no unit)" if dim == 3 else "m 1 (no unit)"
    assert content["axes"][0] == axis
    assert ("is 3-D; drawn are its first two principal components" in text) == (dim == 3)
    assert ("1-D, drawn on a line" in text) == (dim == 1)


def test_where_no_picture_can_be_made_the_page_says_why(tmp_path: Path) -> None:
    explorer = make_explorer(frames={}, note="no pictures can be rendered here (egl: none).")
    assert "There are no films: no pictures can be rendered here (egl: none)." in " ".join(
        explorer.paragraphs()
    )
    assert "egl: none" in page_of(explorer, tmp_path).read_text(encoding="utf-8")


def test_what_does_not_fit_is_refused_by_name() -> None:
    rows = 12 * STEPS
    for name, value in (
        ("task_latent", np.zeros(rows)),
        ("task_latent", np.zeros((0, 2))),
        ("task_latent", np.full((rows, 2), np.inf)),
        ("task", np.full(rows, 6)),
        ("episode", np.zeros(rows - 1, dtype=int)),
        ("step", np.zeros(rows, dtype=int)),
        ("distance", np.full(rows, np.inf)),
        ("phase", ["far"]),
        ("success", np.zeros((rows, 1), dtype=bool)),
        ("frames", {(0, 0, STEPS): b""}),
    ):
        with pytest.raises(BMRLError, match=f"^{name} must"):
            make_explorer(**{name: value})


def test_a_page_without_explorer_holds_no_script(tmp_path: Path) -> None:
    write_page(tmp_path / "page.html", title="T", facts={}, sections=[Section(heading="H")])
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<script" not in text
    assert "explorer" not in text


def test_the_page_names_no_address(tmp_path: Path) -> None:
    text = page_of(make_explorer(), tmp_path).read_text(encoding="utf-8")
    assert not re.search(r"https?:|url\(|@import|<link", text)
    assert "default-src 'none'" in text  # the browser is told to load nothing


# Films


def write_demonstrations(folder: Path, *, states: bool = True) -> Embeddings:
    """Held-out demonstrations of lift, three of six steps, and their embeddings."""
    pytest.importorskip("h5py")
    from torchrl_bmrl.data.episodes import Episode
    from torchrl_bmrl.data.robomimic import write_episodes

    model = """<mujoco><worldbody><light pos="0 0 3"/>
      <site name="goal_marker" size=".05" pos="{} 0 1" rgba="1 0 0 1"/>
      <body pos="0 0 1"><joint type="slide" axis="0 0 1"/>
        <geom size=".1" rgba="0 0 1 1"/></body></worldbody></mujoco>"""

    def episode(number: int) -> Episode:
        part = {"part": np.zeros((6, 1))}
        extras = {"successes": np.arange(6) > 3, "phases": np.arange(6) // 3}
        height = np.linspace(0.0, 0.3, 6)
        if states:
            extras["states"] = np.stack([np.arange(6) * 0.05, height, 0 * height], axis=1)
        return Episode(
            observations=part,
            next_observations=part,
            actions=np.zeros((6, 7)),
            rewards=np.zeros(6),
            terminated=np.zeros(6, dtype=bool),
            extras=extras,
            attributes={"phase_names": ["down", "up"], "model_file": model.format(0.2 * number)},
        )

    masks = {"train": range(1), "valid": range(1, 4)}
    write_episodes(folder / "lift.hdf5", map(episode, range(4)), masks=masks, env_args={})
    number, step = (a.ravel() for a in np.mgrid[:3, :6])
    return Embeddings(
        tasks=TASKS,
        task_latent=np.stack([number, step], axis=1) / 2,
        task=np.full(18, TASKS.index("lift")),
        episode=number,
        step=step,
        distance=np.ones(18),
    )


def test_phases_and_successes_are_those_of_the_file(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    from torchrl_bmrl.reports.films import explore_demonstrations

    explorer = explore_demonstrations(tmp_path, write_demonstrations(tmp_path, states=False))
    assert explorer.phase == ["down"] * 3 + ["up"] * 3 + ["down"] * 3 + ["up"] * 3 + [
        *["down"] * 3,
        *["up"] * 3,
    ]
    assert explorer.success.tolist() == [False, False, False, False, True, True] * 3
    assert not explorer.frames
    assert "contain no simulator states" in explorer.note


def test_transitions_that_the_file_does_not_hold_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    from torchrl_bmrl.reports.films import explore_demonstrations

    embeddings = write_demonstrations(tmp_path)
    with pytest.raises(DataError, match=r"lift\.hdf5.*no episode 9"):
        explore_demonstrations(tmp_path, replace(embeddings, episode=embeddings.episode + 9))
    with pytest.raises(DataError, match=r"lift\.hdf5.*no step 12"):
        explore_demonstrations(tmp_path, replace(embeddings, step=embeddings.step + 7))


@pytest.mark.parametrize("library", ["disabled", "no-such-library"])
def test_without_a_renderer_the_rest_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str
) -> None:
    pytest.importorskip("mujoco")
    from torchrl_bmrl.reports.films import explore_demonstrations

    monkeypatch.setenv("MUJOCO_GL", library)
    explorer = explore_demonstrations(tmp_path, write_demonstrations(tmp_path))
    assert not explorer.frames
    assert explorer.phase[0] == "down"
    assert "There are no films: no pictures can be rendered here" in explorer.paragraphs()[-1]
    assert library in explorer.paragraphs()[-1]


def test_a_library_that_kills_its_process_is_only_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("mujoco")
    from torchrl_bmrl.envs import rendering

    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    killer = ["sh", "-c", "echo; echo; kill -SEGV $$", "sh"]
    start = rendering.subprocess.Popen
    monkeypatch.setattr(
        rendering.subprocess, "Popen", lambda command, **options: start(killer, **options)
    )
    made: list[int] = []
    with pytest.raises(RenderError, match=r"egl: .*code -11; osmesa: .*code -11"):
        rendering.render_states([("<mujoco/>", np.zeros((3, 1)))], report=made.append)
    assert sum(made) == 0  # what did not last is taken back from the progress


def test_states_of_another_shape_are_refused() -> None:
    pytest.importorskip("mujoco")
    from torchrl_bmrl.envs.rendering import render_states

    for states in (np.zeros(3), np.full((2, 3), np.nan)):
        with pytest.raises(BMRLError, match="states must be finite, of shape"):
            render_states([("<mujoco/>", states)])


def rendered(make: Callable[[], Any]) -> Any:
    """What needs a renderer; a machine without one skips, unless it is said to have one."""
    try:
        return make()
    except RenderError as error:
        if os.environ.get("BMRL_REQUIRE_BROWSER"):
            raise
        pytest.skip(str(error))


def test_pictures_follow_states_and_goal() -> None:
    pytest.importorskip("mujoco")
    from torchrl_bmrl.envs.rendering import render_states

    model = """<mujoco><worldbody><light pos="0 0 3"/>
      <site name="goal_marker" size=".05" pos="{} 0.3 1" rgba="1 0 0 1"/>
      <site name="aid" size=".2" pos="0 -0.3 1" rgba="0 1 0 1"/>
      <body pos="0 0 1"><joint type="slide" axis="0 0 1"/>
        <geom size=".1" rgba="0 0 1 1" group="1"/></body></worldbody></mujoco>"""
    states = np.array([[0.0, 0.0, 0.0], [0.0, 0.3, 0.0]])
    made: list[int] = []
    here, near = rendered(
        lambda: render_states(
            [(model.format(0), states), (model.format(0.5), states)], size=64, report=made.append
        )
    )
    assert here.shape == near.shape == (2, 64, 64, 3)
    assert here.dtype == np.uint8
    assert sum(made) == 4

    def rows_of(picture: np.ndarray, channel: int) -> np.ndarray:
        other = np.delete(picture, channel, axis=-1).max(-1)
        return np.nonzero(picture[..., channel] > other.astype(int) + 60)[0]

    assert rows_of(here[1], 2).mean() < rows_of(here[0], 2).mean()  # the body rose
    assert len(rows_of(near[0], 0)) > len(rows_of(here[0], 0)) > 0  # the goal is nearer
    assert len(rows_of(here[0], 1)) == 0  # robosuite's aids are hidden


def test_films_are_of_the_first_held_out_episodes(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    from torchrl_bmrl.reports.films import explore_demonstrations

    explorer = explore_demonstrations(tmp_path, write_demonstrations(tmp_path))
    if not explorer.frames:
        rendered(lambda: (_ for _ in ()).throw(RenderError([explorer.note])))
    lift = TASKS.index("lift")
    assert set(explorer.frames) == {(lift, number, step) for number in (0, 1) for step in (0, 5)}
    picture = Image.open(io.BytesIO(explorer.frames[lift, 0, 0]))
    assert (picture.format, picture.size) == ("WEBP", (192, 192))
    assert "2 episodes have a film" in explorer.paragraphs()[-1]


# In a browser


class Browser:
    """A page in headless Chromium."""

    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def open(self, path: Path) -> None:
        self.driver.get_log("browser")  # forgets what was said before
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
        """Where a colour is on the canvas, blended with the page's white or not: (x, y)."""
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
        # Offsets count from the middle of what is in view: all of it must be.
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
    # Where it is set (.ci/run), a test that cannot run fails.
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
    # The file itself; pictures are data that it holds.
    files = [url for url in asked if not url.startswith("data:")]
    assert files == [(tmp_path / "report.html").as_uri()]
    assert browser.shown("task") == "Reach"


def test_pointing_at_a_point_shows_its_moment_and_leaving_it_the_chosen_one(
    browser: Browser,
) -> None:
    for task in ("lift", "push_down"):
        pixels = browser.pixels(TASK_COLORS[task])
        # Of two lines, episode 1 is the lower one; its last point is the rightmost.
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
    # It is decoded, and of the size it was given.
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
    assert browser.pixels("#fde725")  # viridis' far end


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
