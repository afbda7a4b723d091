"""Films of held-out demonstrations: phases, pictures, and what happens without a renderer."""

# ruff: noqa: E402 -- the package's imports need the extras that the skip checks
from __future__ import annotations

import importlib
import io
import os
import signal
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import numpy as np
import pytest

for extra in ("scipy", "matplotlib", "jinja2", "sklearn", "mujoco"):
    pytest.importorskip(extra)

from explorers import TASKS
from PIL import Image

from torchrl_bmrl.errors import BMRLError, DataError, RenderError, StoppedError
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.reports import Embeddings
from torchrl_bmrl.run.stops import stop_on_signals


def write_demonstrations(folder: Path, *, states: bool = True) -> Embeddings:
    """Writes three held-out demonstrations of lift, of six steps; returns their embeddings."""
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
    from torchrl_bmrl.reports.films import explore_demonstrations, film_demonstrations

    embeddings = write_demonstrations(tmp_path, states=False)
    films = film_demonstrations(tmp_path, ["lift"])
    explorer = explore_demonstrations(tmp_path, embeddings, films)
    assert explorer.phase == ["down"] * 3 + ["up"] * 3 + ["down"] * 3 + ["up"] * 3 + [
        *["down"] * 3,
        *["up"] * 3,
    ]
    assert explorer.success.tolist() == [False, False, False, False, True, True] * 3
    assert not explorer.frames
    assert "contain no simulator states" in explorer.note


def test_transitions_that_the_file_does_not_hold_are_refused(tmp_path: Path) -> None:
    from torchrl_bmrl.reports.films import Films, explore_demonstrations

    embeddings = write_demonstrations(tmp_path)
    others = replace(embeddings, episode=embeddings.episode + 9)
    with pytest.raises(DataError, match=r"lift\.hdf5.*no episode 9"):
        explore_demonstrations(tmp_path, others, Films())
    with pytest.raises(DataError, match=r"lift\.hdf5.*no step 12"):
        explore_demonstrations(tmp_path, replace(embeddings, step=embeddings.step + 7), Films())


class OneTask(SimpleNamespace):
    """What :func:`films_of` reads of a run of lift."""

    once = Run.once

    def __init__(self, folder: Path) -> None:
        super().__init__(folder=folder, data_dir=folder, names=("lift",))


@pytest.mark.parametrize("library", ["disabled", "no-such-library"])
def test_without_a_renderer_the_rest_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str
) -> None:
    from torchrl_bmrl.pipeline.films import films_of
    from torchrl_bmrl.reports.films import explore_demonstrations

    monkeypatch.setenv("MUJOCO_GL", library)
    embeddings = write_demonstrations(tmp_path)
    explorer = explore_demonstrations(tmp_path, embeddings, films_of(OneTask(tmp_path)))
    assert not explorer.frames
    assert explorer.phase[0] == "down"
    assert "There are no films: no pictures can be rendered here" in explorer.paragraphs()[-1]
    assert library in explorer.paragraphs()[-1]
    assert not (tmp_path / "evaluation").exists()  # so another machine can still make them


def test_films_are_rendered_once_and_read_from_their_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from torchrl_bmrl.pipeline.films import films_of
    from torchrl_bmrl.reports import films

    def render(scenes: list[Any], report: Any) -> list[np.ndarray]:
        drawn.append([len(states) for _, states in scenes])
        report(1)
        return [np.full((len(states), 16, 16, 3), 90, np.uint8) for _, states in scenes]

    drawn: list[list[int]] = []
    made: list[int] = []
    monkeypatch.setattr(films, "render_states", render)
    write_demonstrations(tmp_path)
    first = films_of(OneTask(tmp_path), made.append)
    assert (drawn, made) == ([[2, 2]], [1])
    assert set(first.frames) == {(0, number, step) for number in (0, 1) for step in (0, 5)}
    assert films_of(OneTask(tmp_path)) == first
    assert len(drawn) == 1


def test_pictures_of_transitions_that_are_not_shown_are_left_out(tmp_path: Path) -> None:
    from torchrl_bmrl.reports.films import Films, explore_demonstrations

    embeddings = write_demonstrations(tmp_path)
    lift = TASKS.index("lift")
    films = Films(frames={(lift, 0, 0): b"first", (lift, 0, 5): b"last"})
    shown = explore_demonstrations(tmp_path, embeddings.rows(embeddings.step < 5), films)
    assert shown.frames == {(lift, 0, 0): b"first"}


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("encoder", ["transition", "one_hot"])
def test_what_needs_no_student_is_done_beside_stage_2_where_there_are_workers_for_it(
    monkeypatch: pytest.MonkeyPatch, workers: int, encoder: str
) -> None:
    from torchrl_bmrl.pipeline.evaluate import evaluate_job
    from torchrl_bmrl.pipeline.films import film_job
    from torchrl_bmrl.pipeline.settings import Settings

    # The package has a function of the module's name.
    two_stage = importlib.import_module("torchrl_bmrl.pipeline.two_stage")
    given: list[Any] = []
    monkeypatch.setattr(two_stage, "stage2", lambda run, beside: given.extend(beside))
    settings = Settings(workers=workers)
    settings.distill.task_encoder = encoder
    two_stage._stage2(SimpleNamespace(settings=settings, playable=True, names=("reach", "lift")))
    expected: list[Any] = [
        (evaluate_job, (task, policy, ""))
        for policy in ("expert", "bcq")
        for task in ("reach", "lift")
    ]
    expected += [(film_job, None)] if encoder == "transition" else []
    assert given == (expected if workers > 1 else [])


@pytest.mark.parametrize(
    "content",
    [
        "[]",
        '{"frames": {}}',
        '{"frames": {"0 1": "AAAA"}, "note": ""}',
        '{"frames": {"0 1 x": "AAAA"}, "note": ""}',
        '{"frames": {"0 1 2": "%%"}, "note": ""}',
        '{"frames": {"0 1 2": 3}, "note": ""}',
    ],
)
def test_a_damaged_file_of_films_is_refused_by_name(tmp_path: Path, content: str) -> None:
    from torchrl_bmrl.reports.films import read_films

    path = tmp_path / "films.json"
    path.write_text(content)
    with pytest.raises(DataError, match=r"films\.json: not films .*; remove it"):
        read_films(path)


def test_a_library_that_kills_its_process_is_only_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
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
    assert sum(made) == 0  # the progress of the killed process is taken back


def test_states_of_another_shape_are_refused() -> None:
    from torchrl_bmrl.envs.rendering import render_states

    for states in (np.zeros(3), np.full((2, 3), np.nan)):
        with pytest.raises(BMRLError, match="states must be finite, of shape"):
            render_states([("<mujoco/>", states)])


def skip_without_renderer(error: RenderError) -> NoReturn:
    """Skips the test, or fails it where a renderer is required."""
    if os.environ.get("BMRL_REQUIRE_BROWSER"):
        raise error
    pytest.skip(str(error))


def test_pictures_follow_states_and_goal() -> None:
    from torchrl_bmrl.envs.rendering import render_states

    model = """<mujoco><worldbody><light pos="0 0 3"/>
      <site name="goal_marker" size=".05" pos="{} 0.3 1" rgba="1 0 0 1"/>
      <site name="aid" size=".2" pos="0 -0.3 1" rgba="0 1 0 1"/>
      <body pos="0 0 1"><joint type="slide" axis="0 0 1"/>
        <geom size=".1" rgba="0 0 1 1" group="1"/></body></worldbody></mujoco>"""
    states = np.array([[0.0, 0.0, 0.0], [0.0, 0.3, 0.0]])
    made: list[int] = []
    jobs = [(model.format(0), states), (model.format(0.5), states)]
    try:
        here, near = render_states(jobs, size=64, report=made.append)
    except RenderError as error:
        skip_without_renderer(error)
    assert here.shape == near.shape == (2, 64, 64, 3)
    assert here.dtype == np.uint8
    assert sum(made) == 4

    def rows_of(picture: np.ndarray, channel: int) -> np.ndarray:
        other = np.delete(picture, channel, axis=-1).max(-1)
        return np.nonzero(picture[..., channel] > other.astype(int) + 60)[0]

    assert rows_of(here[1], 2).mean() < rows_of(here[0], 2).mean()  # the body rose
    assert len(rows_of(near[0], 0)) > len(rows_of(here[0], 0)) > 0  # the goal is nearer
    assert len(rows_of(here[0], 1)) == 0  # robosuite's aids are hidden


def test_each_scene_is_drawn_from_its_own_model_in_any_order() -> None:
    from torchrl_bmrl.envs.rendering import render_states

    model = """<mujoco><worldbody><light pos="0 0 3"/><body pos="0 0 1">
      <joint type="slide" axis="0 0 1"/><geom size="{}" rgba="0 0 1 1" group="1"/>
      </body></worldbody></mujoco>"""
    small, large = (model.format(size) for size in (0.1, 0.2))
    states = np.array([[0.0, 0.0, 0.0], [0.0, 0.3, 0.0]])
    try:
        apart = [render_states([(text, states)], size=64)[0] for text in (small, large)]
        mixed = render_states([(text, states) for text in (small, large, large, small)], size=64)
    except RenderError as error:
        skip_without_renderer(error)
    assert not np.array_equal(*apart)
    for found, expected in zip(mixed, [apart[0], apart[1], apart[1], apart[0]], strict=True):
        np.testing.assert_array_equal(found, expected)


def test_films_are_of_the_first_held_out_episodes(tmp_path: Path) -> None:
    from torchrl_bmrl.reports.films import explore_demonstrations, film_demonstrations

    embeddings = write_demonstrations(tmp_path)
    others = tmp_path / "others"
    write_demonstrations(others, states=False)
    for task in TASKS:
        if task != "lift":
            (tmp_path / f"{task}.hdf5").symlink_to(others / "lift.hdf5")
    try:
        films = film_demonstrations(tmp_path, TASKS)
    except RenderError as error:
        skip_without_renderer(error)
    explorer = explore_demonstrations(tmp_path, embeddings, films)
    lift = TASKS.index("lift")
    assert set(explorer.frames) == {(lift, number, step) for number in (0, 1) for step in (0, 5)}
    picture = Image.open(io.BytesIO(explorer.frames[lift, 0, 0]))
    assert (picture.format, picture.size) == ("WEBP", (192, 192))
    assert "2 episodes have a film" in explorer.paragraphs()[-1]


@pytest.mark.robosuite
@pytest.mark.timeout(120)
@pytest.mark.usefixtures("signals_not_ignored")
def test_a_stop_does_not_wait_for_the_figures_of_the_embedding(
    finished_copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from small_runs import SMALL, settings_of

    module = importlib.import_module("torchrl_bmrl.pipeline.evaluate")

    def look_at_embedding(run: Run) -> dict[str, Any]:
        os.kill(os.getpid(), signal.SIGTERM)
        while True:
            time.sleep(0.01)

    monkeypatch.setattr(module, "look_at_embedding", look_at_embedding)
    monkeypatch.setattr(module, "play", lambda run: None)
    settings = settings_of(*SMALL, f"run_dir={finished_copy}", "workers=2")
    threads = threading.active_count()
    with stop_on_signals(), Run(settings) as run, pytest.raises(StoppedError):
        module.evaluate(run)
    assert threading.active_count() == threads
