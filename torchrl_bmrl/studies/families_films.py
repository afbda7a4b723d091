"""Episodes of a family's members for the page: played and rendered once."""

from __future__ import annotations

import base64
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_bmrl.envs.rendering import graphics_library, render_states
from torchrl_bmrl.envs.transforms import make_env
from torchrl_bmrl.errors import RenderError
from torchrl_bmrl.evaluation.rollout import rollout_episodes
from torchrl_bmrl.modules import PathTaskLatent
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.reports.films import EVERY, webp
from torchrl_bmrl.reports.members import Film, read_film, write_film
from torchrl_bmrl.run.workers import Report
from torchrl_bmrl.tasks import Task


def why_no_films() -> str:
    """Why no film can be made on this machine; "" if films can be made."""
    try:
        graphics_library()
    except RenderError as error:
        return f"{error}."
    return ""


def film_once(
    run: Run,
    folder: str,
    task: Task,
    policy: TensorDictModuleBase,
    latent: Tensor,
    report: Report,
) -> Film | None:
    """One episode of a member with its pictures, ``<folder>/films/<task>.json``.

    ``None`` for environments other than the tabletop's, which make no pictures: nothing is played.

    Args:
        run: the run.
        folder: of the study, below the run's.
        task: the member.
        policy: reads ``task_latent``, writes ``action``.
        latent: the constant m, ``(m,)``.
        report: called with the number of new steps.
    """

    def make(path: Path) -> None:
        states: list[NDArray[Any]] = []

        def watch(*_: object) -> None:
            states.append(scene.sim.get_state().flatten())

        transform = PathTaskLatent(latent.unsqueeze(0))
        with closing(make_env(task, run.statistics, transform)) as env:
            scene = env.base_env.robosuite_env
            seed = run.seed("families", "film", task.name)
            horizon = run.horizon(task)
            hook = policy.register_forward_pre_hook(watch)  # before each action
            played = rollout_episodes(env, policy, seed=seed, max_steps=horizon, report=report)
            hook.remove()
            scenes = [(scene.scene_xml(), np.stack(states)[::EVERY])]
        after = played["next"]
        success = after.get("success", None)
        frames = [webp(picture) for pictures in render_states(scenes) for picture in pictures]
        film = Film(
            frames={
                str(i * EVERY): base64.b64encode(frame).decode("ascii")
                for i, frame in enumerate(frames)
            },
            episode_return=float(after["reward"].double().sum()),
            success=None if success is None else bool(success.any()),
            period=scene.control_timestep,
        )
        write_film(path, film)

    skipped = partial(report, run.horizon(task))
    file = f"{folder}/films/{task.name}.json"
    if not (run.folder / file).exists():
        with closing(make_env(task, run.statistics)) as env:
            if not hasattr(env.base_env, "robosuite_env"):
                skipped()
                return None
    return run.once(file, read_film, make, skipped=skipped)
