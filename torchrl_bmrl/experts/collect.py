"""Episodes of the scripted experts, one file each until a task is complete."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.robomimic import (
    count_episodes,
    keep_episode,
    read_kept_episode,
    write_episodes,
)
from torchrl_bmrl.envs.sawyer import SawyerEnv
from torchrl_bmrl.envs.tasks import robosuite_metadata
from torchrl_bmrl.errors import BMRLError, DataError
from torchrl_bmrl.experts.controllers import ExpertGains, make_expert
from torchrl_bmrl.names import (
    STAGE_HORIZON,
    TASKS,
    check_task,
    composition_stages,
    horizon_of,
)
from torchrl_bmrl.run.workers import Report, derive_seed, run_jobs


@dataclass(frozen=True, kw_only=True)
class EpisodeJob:
    """One episode to collect.

    Attributes:
        task: its task.
        seed: decides start and noise.
        noise: standard deviation of the Gaussian noise on each action dimension.
        path: where the episode is kept.
        gains: of the expert.
        stepper: of :class:`~torchrl_bmrl.envs.sawyer.SawyerEnv`.
        after: tasks that the expert does before, joined by ``-``.

    Example:
        >>> job = EpisodeJob(task="lift", seed=0, noise=0.2, path=Path("00000.npz"))
        >>> job.stepper, job.gains.grasp_steps
        ('fast', 10)
    """

    task: str
    seed: int
    noise: float
    path: Path
    gains: ExpertGains = field(default_factory=ExpertGains)
    stepper: str = "fast"
    after: str = ""


_kept: SawyerEnv | None = None


def _env(task: str, stepper: str) -> SawyerEnv:
    # Building one with its pictures takes a second: the last one is kept.
    global _kept
    if _kept is None or (_kept.task, _kept.stepper) != (task, stepper):
        if _kept is not None:
            _kept.close()
        _kept = SawyerEnv(task, stepper=stepper)
    return _kept


def collect_episode(
    task: str,
    seed: int,
    *,
    noise: float,
    gains: ExpertGains,
    stepper: str = "fast",
    after: str = "",
) -> Episode:
    """One episode of the expert, reproduced by ``seed``.

    Args:
        task: one of the six (200 steps), or a composition (100 steps for each of its tasks).
        seed: decides start and noise.
        noise: standard deviation of the Gaussian noise on each action dimension.
        gains: of the expert.
        stepper: of :class:`~torchrl_bmrl.envs.sawyer.SawyerEnv`.
        after: tasks that the expert does before, joined by ``-``: the episode begins where the last
            of them succeeded, with arm, gripper and cube as they are then. Empty: where the task
            itself begins.

    Returns:
        the episode, with the extras ``successes``, ``states`` and, of a task, ``phases``, of a
        composition ``stages``.

    Raises:
        UnknownNameError: for a name that is not a task.
        BMRLError: if the expert never does ``after``, in 100 starts.

    Example:
        >>> episode = collect_episode("reach", seed=0, noise=0.2, gains=ExpertGains())
        >>> len(episode), bool(episode.extras["successes"].any())
        (200, True)
    """
    env = _env(f"{after}-{task}" if after else task, stepper)
    scene = env.robosuite_env
    rng = np.random.default_rng(derive_seed(seed, "action noise"))

    def act() -> np.ndarray:
        # What is stored is what was executed, to the bit.
        return np.clip(expert() + noise * rng.standard_normal(7), -1.0, 1.0).astype(np.float32)

    before = len(composition_stages(after)) if after else 0
    for attempt in range(100):
        observation, _ = env.reset(seed=derive_seed(seed, "again", attempt) if attempt else seed)
        expert = make_expert(env.task, scene, gains)
        while scene.stage < before and scene.timestep < STAGE_HORIZON * before:
            observation, *_ = env.step(act())
        if scene.stage == before:
            break
    else:
        raise BMRLError(f"the expert never came to {task} after {after}; valid: what it can do")
    observations = {name: [part] for name, part in observation.items()}
    model_file = scene.scene_xml()
    actions, rewards, successes, phases, states, stages = [], [], [], [], [], []
    for _ in range(horizon_of(task)):
        action = act()
        phases.append(expert.phase)
        states.append(scene.sim.get_state().flatten())
        stages.append(scene.stage - before)
        observation, reward, _, _, info = env.step(action)
        for name, part in observation.items():
            observations[name].append(part)
        actions.append(action)
        rewards.append(reward)
        successes.append(scene.task_success() if after else info["success"])
    parts = {name: np.stack(rows) for name, rows in observations.items()}
    return Episode(
        observations={name: part[:-1] for name, part in parts.items()},
        next_observations={name: part[1:] for name, part in parts.items()},
        actions=np.stack(actions),
        rewards=np.array(rewards),
        terminated=np.zeros(len(actions), dtype=bool),
        extras={
            "successes": np.array(successes),
            # A composition's experts differ in what their phases are: it has stages instead.
            **({} if "-" in task else {"phases": np.array(phases, dtype=np.int8)}),
            "states": np.stack(states),
            **({"stages": np.array(stages, dtype=np.int8)} if "-" in task else {}),
        },
        # robomimic plays states back in the model of the demonstration.
        attributes={
            "seed": seed,
            **({} if "-" in task else {"phase_names": list(expert.phases)}),
            "model_file": model_file,
            **({"after": after} if after else {}),
        },
    )


def _collect_job(job: EpisodeJob, report: Report) -> None:
    episode = collect_episode(
        job.task,
        job.seed,
        noise=job.noise,
        gains=job.gains,
        stepper=job.stepper,
        after=job.after,
    )
    keep_episode(job.path, episode)
    report(1)


def collect_demonstrations(
    directory: Path,
    episodes: dict[str, int],
    *,
    valid_episodes: int,
    noise: float,
    seed: int,
    workers: int,
    gains: ExpertGains | None = None,
    stepper: str = "fast",
    after: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, Path]:
    """Collects demonstrations, one robomimic-layout HDF5 file per task.

    Every finished episode is kept under ``directory/.episodes`` at once; the same call after a kill
    goes on with the missing ones. A task's file appears, complete, when its last episode is there.

    Args:
        directory: where ``<task>.hdf5`` is written.
        episodes: number of episodes to train on, by task.
        valid_episodes: further episodes of each task, held out under ``mask/valid``.
        noise: standard deviation of the Gaussian action noise.
        seed: episode i of a task is the same in every collection with this seed.
        workers: processes.
        gains: of the experts.
        stepper: of :class:`~torchrl_bmrl.envs.sawyer.SawyerEnv`; the episodes are the same.
        after: by task, what the expert does before an episode of it begins
            (:func:`collect_episode`); the episodes of a task take the entries in turn.

    Returns:
        the file of each task.

    Raises:
        UnknownNameError: for a name that is not a task.
        DataError: if a finished file holds another number of episodes than asked for.
        StoppedError: if the run was asked to stop; the episodes that were finished are kept.

    Example:
        >>> import tempfile
        >>> files = collect_demonstrations(
        ...     Path(tempfile.mkdtemp()),
        ...     {"reach": 1},
        ...     valid_episodes=1,
        ...     noise=0.2,
        ...     seed=0,
        ...     workers=1,
        ... )
        >>> files["reach"].name, count_episodes(files["reach"])
        ('reach.hdf5', 2)
    """
    gains = gains or ExpertGains()
    files = {check_task(task): directory / f"{task}.hdf5" for task in episodes}
    afters = {task: list((after or {}).get(task, ())) or [""] for task in files}
    counts = {task: number + valid_episodes for task, number in episodes.items()}
    parts = {
        task: [directory / ".episodes" / task / f"{i:05d}.npz" for i in range(counts[task])]
        for task in files
        if not files[task].exists()
    }
    jobs = [
        EpisodeJob(
            task=task,
            seed=derive_seed(seed, "collect", task, i),
            noise=noise,
            path=path,
            gains=gains,
            stepper=stepper,
            after=afters[task][i % len(afters[task])],
        )
        for task in sorted(parts, key=TASKS.index)
        for i, path in enumerate(parts[task])
        if not path.exists()
    ]
    jobs.sort(key=lambda job: (TASKS.index(job.task), job.after))  # a worker keeps its last scene
    run_jobs(
        _collect_job,
        jobs,
        workers=workers,
        total=len(jobs),
        description="collecting demonstrations",
        unit="episode",
    )
    for task, paths in parts.items():
        write_episodes(
            files[task],
            (read_kept_episode(path) for path in paths),
            masks={
                "train": range(episodes[task]),
                "valid": range(episodes[task], counts[task]),
            },
            env_args=robosuite_metadata(task),
            attributes={"task": task, "action_noise": noise, "seed": seed},
        )
        # Whole: a killed process may have left temporary files there.
        shutil.rmtree(paths[0].parent)
    for task, path in files.items():
        if count_episodes(path) != counts[task]:
            raise DataError(
                path,
                "data",
                f"holds {count_episodes(path)} episodes where {counts[task]} are asked for; "
                "give another run_dir or remove the file",
            )
    return files
