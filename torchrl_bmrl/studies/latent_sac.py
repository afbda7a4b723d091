"""Learning on top: SAC chooses the embedding m, and the frozen distilled policy acts.

TorchRL's SAC learns a composition whose only reward is +1 for each completed task. It learns twice:
with m as its action, held for ``hold`` steps, and with the robot's own action. Networks, learning
rates, steps of the environment, updates per step and the discount per step are the same.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import ActionScaling, EnvBase, ExplorationType, TerminateTransform
from torchrl.envs import set_exploration_type as exploring
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_bmrl.envs.transforms import StageReward
from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.evaluation.rollout import rollout_episodes
from torchrl_bmrl.modules import HeldTaskLatent, task_latent_box
from torchrl_bmrl.modules.generator import Network, make_mlp
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.reports import Picture, Section, Table, success_curves, write_study
from torchrl_bmrl.rows import check_rows, finite, read_rows, whole, write_rows
from torchrl_bmrl.run.folder import check_made_from, open_run
from torchrl_bmrl.run.settings import setting
from torchrl_bmrl.run.workers import Report, derive_seed
from torchrl_bmrl.training.health import check_metrics

VARIANTS = ("latent", "raw")
"""The agent's action: m, or the robot's action."""
NUM_ENVS = 5  # environments side by side
CHUNK = 20  # steps in each environment between updates
STEPS_PER_UPDATE = 4
CELLS = (256, 256)  # of every network
BATCH_SIZE, LR, TAU = 128, 1e-3, 0.005
GAMMA = 0.99  # per step of the environment
ALPHA = 0.1  # initial temperature; with 1 the entropy would exceed a return of 2
STATE = ["observation", "progress"]
COLUMNS: dict[str, Any] = {
    "variant": str,
    "seed": whole,
    "environment_steps": whole,
    "success": finite,
    "stages": finite,
}
Row = dict[str, Any]


@dataclass
class LatentSACSettings:
    """Settings of :func:`latent_sac`."""

    composition: str = "reach-lift"
    hold: int = setting(20, above=0)  # steps of the environment for which a chosen m is held
    num_candidates: int = setting(20, above=0)  # of the frozen policy, which acts at every step
    environment_steps: int = setting(20_000, above=0)  # of each agent
    random_steps: int = setting(1_000, at_least=0)  # the first of these, without updates
    seeds: list[int] = setting([0, 1, 2], unique=True)
    eval_interval: int = setting(2_000, above=0)  # steps of the environment
    eval_episodes: int = setting(10, above=0)

    @property
    def folder(self) -> Path:
        """Folder of these agents, relative to the run's."""
        return Path("latent_sac", f"{self.composition}-hold{self.hold}")


def latent_sac(run: Run, settings: LatentSACSettings) -> str:
    """Trains SAC agents with m and with raw actions, and compares them.

    Writes the agents' rows and ``results.csv`` under ``latent_sac/``, and a table and a figure. An
    agent that is done is read back; one that was stopped starts over.

    Args:
        run: an open run with stage 2.
        settings: of the study.

    Returns:
        the table as Markdown.

    Raises:
        BMRLError: for settings that are not valid, a missing policy, or an agent that diverges.
    """
    run.check_open()
    if settings.random_steps > settings.environment_steps:
        raise ConfigError(
            f"latent_sac.random_steps is {settings.random_steps}; valid: 0 to environment_steps"
        )
    run.composition(settings.composition)
    # A missing policy, or one that cannot take part, is an error before anything is written.
    run.student()[0].check_embeds("latent_sac")
    folder = run.folder / settings.folder
    # Seeds may be added later; all other settings must agree.
    open_run(folder, {name: x for name, x in asdict(settings).items() if name != "seeds"})
    jobs = [(settings, variant, seed) for variant in VARIANTS for seed in settings.seeds]
    agents = run.jobs(
        train_job,
        jobs,
        total=len(jobs) * settings.environment_steps,
        description="SAC",
        unit="step",
    )
    write_rows(folder / "results.csv", [row for rows in agents for row in rows])
    table = make_table(settings, agents)
    curves: dict[str, list[np.ndarray]] = {}
    for rows in agents:
        curve = np.array([[row["environment_steps"], row["success"]] for row in rows])
        curves.setdefault(rows[0]["variant"], []).append(curve)
    name = "-".join(settings.folder.parts)
    picture = Picture(
        png=success_curves(curves, title=table.title),
        alt="success over the environment's steps, with m and with raw actions",
        caption="Thin: one seed. Thick: the mean over seeds. Dashed: half of the episodes.",
    )
    section = Section(heading="Learning on top", tables=[table])
    write_study(run.folder, name, section, {name: picture})
    return table.markdown()


def train_job(job: tuple[Run, tuple[LatentSACSettings, str, int]], report: Report) -> list[Row]:
    """Trains the agent of a variant and a seed, or reads it back; one row per evaluation."""
    run, (settings, variant, seed) = job
    path = run.folder / settings.folder / f"{variant}-seed{seed}.csv"
    check_made_from(path, [run.student_path] if variant == "latent" else [])
    if path.exists():
        rows = read_rows(path, COLUMNS)
        check_rows(path, rows, [{"variant": variant, "seed": seed}] * max(1, len(rows)))
        if rows[-1]["environment_steps"] >= settings.environment_steps:
            report(settings.environment_steps)
            return rows
    hold = settings.hold if variant == "latent" else 1
    torch.manual_seed(derive_seed(seed, "latent_sac", variant))
    env = make_agent_env(run, settings, variant, NUM_ENVS, stop=True)
    env.set_seed(derive_seed(seed, "latent_sac", "train"))
    # Evaluated over whole episodes, which success does not end.
    eval_env = make_agent_env(run, settings, variant, settings.eval_episodes, stop=False)
    starts = [derive_seed(seed, "latent_sac", "evaluate", i) for i in range(settings.eval_episodes)]
    max_steps = -(-run.horizon(run.composition(settings.composition)) // hold)
    loss = make_sac(env, GAMMA**hold)

    def evaluate(steps: int) -> Row:
        with exploring(ExplorationType.DETERMINISTIC):
            actor = loss.actor_network
            after = rollout_episodes(eval_env, actor, seed=starts, max_steps=max_steps)["next"]
        success, stages = after["success"].any(-1), after["stage"].amax(-1)
        means = {"success": success.double().mean().item(), "stages": stages.double().mean().item()}
        return {"variant": variant, "seed": seed, "environment_steps": steps, **means}

    optimizer = torch.optim.Adam(loss.parameters(), lr=LR)
    targets = SoftUpdate(loss, tau=TAU)
    storage = LazyTensorStorage(settings.environment_steps)
    buffer = TensorDictReplayBuffer(storage=storage, batch_size=BATCH_SIZE)
    following = [("next", key) for key in (*STATE, "reward", "done", "terminated")]
    rows, steps, updates = [evaluate(0)], 0, 0
    with closing(env), closing(eval_env):
        collector = Collector(
            env,
            loss.actor_network,
            frames_per_batch=NUM_ENVS * max(1, CHUNK // hold),
            total_frames=-1,
            init_random_frames=settings.random_steps // hold,
            auto_register_policy_transforms=True,
        )
        for data in collector:
            taken = data["next", "held_steps"].sum().item() if variant == "latent" else data.numel()
            report(min(taken, settings.environment_steps - steps))
            steps += taken
            buffer.extend(data.select(*STATE, "action", *following).reshape(-1))
            while steps >= settings.random_steps and updates < steps // STEPS_PER_UPDATE:
                losses = loss(buffer.sample())
                optimizer.zero_grad(set_to_none=True)
                sum(losses[f"loss_{name}"] for name in ("actor", "qvalue", "alpha")).backward()
                optimizer.step()
                targets.step()
                updates += 1
            last = steps >= settings.environment_steps
            if last or steps >= len(rows) * settings.eval_interval:
                if updates:
                    check_metrics(losses.detach(), f"{variant}, seed {seed}, step {steps}")
                rows.append(evaluate(steps))
                write_rows(path, rows)
            if last:
                break
        collector.shutdown(close_env=False)
    return rows


def make_agent_env(
    run: Run, settings: LatentSACSettings, variant: str, num_envs: int, *, stop: bool
) -> EnvBase:
    """The composition as the agent sees it: sparse reward and actions in [-1, 1].

    With ``stop``, success ends an episode. It is a termination: no reward can follow.
    """
    task = run.composition(settings.composition)
    env = run.make_env(task, StageReward(len(task.stages)), num_envs=num_envs)
    if stop:
        env.append_transform(TerminateTransform(lambda after: after["success"]))
    if variant == "latent":
        student, metadata = run.student()
        policy = student.policy(
            num_candidates=settings.num_candidates, latent_clip=metadata["latent_clip"]
        )
        embeddings = [student.embed(run.transitions(name, "train")) for name in run.names]
        box = task_latent_box(torch.cat(embeddings))
        env.append_transform(HeldTaskLatent(policy, *box, hold=settings.hold))
    return env.append_transform(ActionScaling())


def make_sac(env: EnvBase, gamma: float) -> SACLoss:
    """TorchRL's SAC; ``gamma`` is the discount per action of the agent."""
    state_dim = sum(env.observation_spec[key].shape[-1] for key in STATE)
    action_dim = env.action_spec.shape[-1]
    actor = ProbabilisticActor(
        TensorDictSequential(
            TensorDictModule(make_mlp(state_dim, 2 * action_dim, CELLS), STATE, ["parameters"]),
            TensorDictModule(NormalParamExtractor(), ["parameters"], ["loc", "scale"]),
        ),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
    )
    critics = [
        Network(
            make_mlp(state_dim + action_dim, 1, CELLS),
            in_keys=[*STATE, "action"],
            out_keys=["state_action_value"],
        )
        for _ in range(2)
    ]
    loss = SACLoss(actor, critics, alpha_init=ALPHA, target_entropy=-float(action_dim))
    loss.make_value_estimator(gamma=gamma)  # returns nothing
    return loss


def steps_to_half(rows: list[Row]) -> int | None:
    """Environment steps at an agent's first evaluation with at least 50% success."""
    return next((row["environment_steps"] for row in rows if row["success"] >= 0.5), None)


def make_table(settings: LatentSACSettings, agents: list[list[Row]]) -> Table:
    """One line per agent."""
    lines = []
    for rows in agents:
        half, successes = steps_to_half(rows), [row["success"] for row in rows]
        lines.append(
            (
                rows[0]["variant"],
                str(rows[0]["seed"]),
                f"not within {settings.environment_steps:,}" if half is None else f"{half:,}",
                *(f"{x:.0%}" for x in (successes[0], max(successes), successes[-1])),
                f"{rows[-1]['stages']:.1f}",
            )
        )
    return Table(
        title=f"Learning {settings.composition} from its stages alone",
        caption=(
            f"SAC with m as its action, held for {settings.hold} steps while the distilled policy "
            "acts (latent), and with the robot's own action (raw). Steps are those of the "
            f"environment. Each agent is evaluated about every {settings.eval_interval:,} steps "
            f"on {settings.eval_episodes} separate episodes, with the mode of its distribution. "
            "Success: all tasks are completed. Before: the untrained agent."
        ),
        header=(
            "Action",
            "Seed",
            "Steps to 50% success",
            "Before",
            "Best success",
            "Success at the end",
            "Stages at the end",
        ),
        rows=lines,
    )
