"""Learning on top: SAC that chooses m, a frozen distilled policy that executes it.

    python recipes/latent_sac.py run_dir=runs/mine      # after recipes/two_stage.py preset=compose
    python recipes/latent_sac.py run_dir=runs/mine latent_sac.composition=lift-reach

TorchRL's SAC on a composition that rewards nothing but its stages, +1 for each: once with m as its
action, held for ``hold`` steps, and once with the robot's own. Networks, learning rates, steps of
the environment, updates per step and discount per step are the same. Rows are kept as they come;
agents that are done are skipped the next time, one that was stopped starts over.
"""

from __future__ import annotations

import os

import needed  # noqa: F401 (first)

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from contextlib import closing
from dataclasses import asdict
from pathlib import Path

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from settings import Config, run_recipe
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import ActionScaling, EnvBase, ExplorationType, TerminateTransform
from torchrl.envs import set_exploration_type as exploring
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_bmrl.data.demonstrations import load_transitions, read_statistics
from torchrl_bmrl.envs.transforms import StageReward, make_env
from torchrl_bmrl.evaluation.rollout import rollout_episodes
from torchrl_bmrl.files import finite, read_rows, whole, write_rows
from torchrl_bmrl.modules import HeldTaskLatent, task_latent_box
from torchrl_bmrl.modules.generator import Network, make_mlp
from torchrl_bmrl.names import composition_stages, horizon_of
from torchrl_bmrl.pipeline.agents import load_student
from torchrl_bmrl.reports import Picture, Section, Table, success_curves, write_study
from torchrl_bmrl.run.folder import open_run
from torchrl_bmrl.run.workers import Report, derive_seed, run_jobs
from torchrl_bmrl.training.health import check_metrics

VARIANTS = ("latent", "raw")
"""What the agent's action is: m, or the robot's."""
NUM_ENVS = 5  # episodes side by side
CHUNK = 20  # steps in each of them between updates
STEPS_PER_UPDATE = 4
CELLS = (256, 256)  # of every network
BATCH_SIZE, LR, TAU = 128, 1e-3, 0.005
GAMMA = 0.99  # per step of the environment
ALPHA = 0.1  # at first: 1 would drown a return of 2
STATE = ["observation", "progress"]

Job = tuple[Config, str, int]
Row = dict[str, str | int | float]


COLUMNS = {
    "variant": str,
    "seed": whole,
    "environment_steps": whole,
    "success": finite,
    "stages": finite,
}


def output_dir(config: Config) -> Path:
    """Where the agents of a composition and a hold are kept."""
    settings = config.latent_sac
    return Path(config.run_dir) / "latent_sac" / f"{settings.composition}-hold{settings.hold}"


def make_agent_env(config: Config, variant: str, num_envs: int, *, stop: bool) -> EnvBase:
    """The composition as the agent sees it: sparse reward, actions in [-1, 1].

    Args:
        config: of the run.
        variant: one of :data:`VARIANTS`.
        num_envs: batch size.
        stop: whether success ends an episode: nothing is left to gain then, a true termination.
    """
    run_dir, settings = Path(config.run_dir), config.latent_sac
    statistics = read_statistics(run_dir / "data")
    num_stages = len(composition_stages(settings.composition))
    env = make_env(
        settings.composition,
        statistics,
        StageReward(num_stages),
        num_envs=num_envs,
        stepper=config.stepper,
    )
    if stop:
        env.append_transform(TerminateTransform(lambda after: after["success"]))
    if variant == "latent":
        student, metadata = load_student(run_dir / "distill" / "checkpoint.safetensors")
        policy = student.policy(
            num_candidates=settings.num_candidates, latent_clip=metadata["latent_clip"]
        )
        embeddings = [
            student.embed(
                load_transitions(run_dir / "data", task, statistics, split="train", num_task=i)
            )
            for i, task in enumerate(config.tasks)
        ]
        box = task_latent_box(torch.cat(embeddings))
        env.append_transform(HeldTaskLatent(policy, *box, hold=settings.hold))
    return env.append_transform(ActionScaling())


def make_sac(env: EnvBase, gamma: float) -> SACLoss:
    """TorchRL's SAC for an environment's observation, progress and action."""
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


def train_job(job: Job, report: Report) -> list[Row]:
    """Trains one agent and evaluates it as it learns; its rows are kept, read back if there."""
    config, variant, seed = job
    settings = config.latent_sac
    path = output_dir(config) / f"{variant}-seed{seed}.csv"
    if path.exists():
        kept: list[Row] = read_rows(path, COLUMNS)
        if int(kept[-1]["environment_steps"]) >= settings.environment_steps:
            report(settings.environment_steps)
            return kept
    hold = settings.hold if variant == "latent" else 1
    torch.manual_seed(derive_seed(seed, "latent_sac", variant))
    env = make_agent_env(config, variant, NUM_ENVS, stop=True)
    env.set_seed(derive_seed(seed, "latent_sac", "train"))
    # Compared as it is, over whole episodes: there success need not end one.
    eval_env = make_agent_env(config, variant, settings.eval_episodes, stop=False)
    loss = make_sac(env, GAMMA**hold)
    optimizer = torch.optim.Adam(loss.parameters(), lr=LR)
    targets = SoftUpdate(loss, tau=TAU)
    storage = LazyTensorStorage(settings.environment_steps)
    buffer = TensorDictReplayBuffer(storage=storage, batch_size=BATCH_SIZE)
    keep = [("next", key) for key in (*STATE, "reward", "done", "terminated")]
    rows = [evaluate(config, loss, eval_env, variant, seed, 0)]
    steps = updates = 0
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
            buffer.extend(data.select(*STATE, "action", *keep).reshape(-1))
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
                rows.append(evaluate(config, loss, eval_env, variant, seed, steps))
                write_rows(path, rows)
            if last:
                break
        collector.shutdown(close_env=False)
    return rows


def evaluate(
    config: Config, loss: SACLoss, env: EnvBase, variant: str, seed: int, steps: int
) -> Row:
    """Episodes of the present agent's mode, from the same starts every time."""
    settings = config.latent_sac
    hold = settings.hold if variant == "latent" else 1
    starts = [derive_seed(seed, "latent_sac", "evaluate", i) for i in range(settings.eval_episodes)]
    with exploring(ExplorationType.DETERMINISTIC):
        episodes = rollout_episodes(
            env,
            loss.actor_network,
            seed=starts,
            max_steps=-(-horizon_of(settings.composition) // hold),
        )
    return {
        "variant": variant,
        "seed": seed,
        "environment_steps": steps,
        "success": episodes["next", "success"].any(-1).double().mean().item(),
        "stages": episodes["next", "stage"].amax(-1).double().mean().item(),
    }


def steps_to_half(rows: list[Row]) -> int | None:
    """Steps at one agent's first evaluation in which half of the episodes succeed."""
    return next(
        (int(row["environment_steps"]) for row in rows if float(row["success"]) >= 0.5), None
    )


def make_table(config: Config, agents: list[list[Row]]) -> Table:
    """One line for each agent."""
    settings = config.latent_sac
    lines = []
    for rows in agents:
        half = steps_to_half(rows)
        lines.append(
            (
                str(rows[0]["variant"]),
                str(rows[0]["seed"]),
                f"not within {settings.environment_steps:,}" if half is None else f"{half:,}",
                f"{float(rows[0]['success']):.0%}",
                f"{max(float(row['success']) for row in rows):.0%}",
                f"{float(rows[-1]['success']):.0%}",
                f"{float(rows[-1]['stages']):.1f}",
            )
        )
    return Table(
        title=f"Learning {settings.composition} from its stages alone",
        caption=(
            f"SAC with m as its action, held for {settings.hold} steps and executed by the "
            "distilled policy (latent), and with the robot's own action (raw). Steps are the "
            f"environment's; each agent is evaluated about every {settings.eval_interval:,} on "
            f"{settings.eval_episodes} episodes that it does not learn from, with its mode. "
            "Success: all stages done. Before: the untrained agent."
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


def latent_sac(config: Config) -> None:
    """Trains what is not done yet, then writes rows, table and figure."""
    settings, run_dir, folder = config.latent_sac, Path(config.run_dir), output_dir(config)
    load_student(run_dir / "distill" / "checkpoint.safetensors")  # before anything is written
    # More seeds may join agents that are there; nothing else may differ.
    open_run(folder, {name: x for name, x in asdict(settings).items() if name != "seeds"})
    jobs = [(config, variant, seed) for seed in settings.seeds for variant in VARIANTS]
    agents = run_jobs(
        train_job,
        jobs,
        workers=config.workers,
        total=len(jobs) * settings.environment_steps,
        description="SAC",
        unit="step",
    )
    agents.sort(key=lambda rows: str(rows[0]["variant"]))
    write_rows(folder / "results.csv", [row for rows in agents for row in rows])
    table = make_table(config, agents)
    curves = {
        variant: [
            np.array([[float(row["environment_steps"]), float(row["success"])] for row in rows])
            for rows in agents
            if rows[0]["variant"] == variant
        ]
        for variant in VARIANTS
    }
    name = f"latent_sac-{folder.name}"
    picture = Picture(
        png=success_curves(curves, title=table.title),
        alt="success over the environment's steps, with m and with raw actions",
        caption="Thin: a seed. Thick: their mean. Dashed: half of the episodes.",
    )
    section = Section(heading="Learning on top", tables=[table])
    write_study(run_dir, name, section, {name: picture})
    print(table.markdown())


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, latent_sac, trains=False)


if __name__ == "__main__":
    main()
