"""Typed settings of the recipes; the presets under ``config/preset`` fill them."""

from __future__ import annotations

import gc
import logging
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from given import with_folders_settings
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchrl_bmrl.data.replay import check_device
from torchrl_bmrl.errors import ConfigError, UnknownNameError
from torchrl_bmrl.experts.controllers import ExpertGains
from torchrl_bmrl.names import STEPPERS, TASKS, check_task, composition_stages
from torchrl_bmrl.objectives.checks import check_value_bounds
from torchrl_bmrl.objectives.common import LOSS_FUNCTIONS
from torchrl_bmrl.objectives.distillation import CONTEXTS, ENCODER_TERMS
from torchrl_bmrl.objectives.generative import KL_REDUCTIONS
from torchrl_bmrl.pipeline.agents import LATENT_SOURCES, TASK_ENCODERS
from torchrl_bmrl.run.command_line import exit_codes
from torchrl_bmrl.run.folder import LOGGERS, deciding
from torchrl_bmrl.run.locks import hold_run
from torchrl_bmrl.run.logs import log_to_stderr
from torchrl_bmrl.run.workers import available_cores

log = logging.getLogger("torchrl_bmrl.recipes")

BASELINES = ("bc", "td3_bc", "iql", "cql", "bcq_one_hot")


@dataclass
class CollectSettings:
    """Demonstrations of the scripted experts."""

    train_episodes: dict[str, int] = MISSING  # by task
    valid_episodes: int = MISSING  # held out, of each task
    noise: float = 0.2  # standard deviation on every action dimension
    # By task, what the expert does before an episode begins, in turn: starts as in a composition.
    after: dict[str, list[str]] = field(default_factory=dict)
    gains: ExpertGains = field(default_factory=ExpertGains)


@dataclass
class BCQSettings:
    """Stage 1: one Batch-Constrained Q-learning agent per task."""

    epochs: int = MISSING
    updates_per_epoch: int = MISSING
    eval_episodes: int = MISSING  # after each epoch, for the curves
    batch_size: int = 128
    lr: float = 1e-3
    num_cells: list[int] = field(default_factory=lambda: [256, 256])
    num_qvalue_nets: int = 2
    num_candidates: int = 10  # in the target
    lmbda: float = 0.75
    latent_clip: float | None = 0.5  # null turns it off
    kl_weight: float = 0.5
    kl_reduction: str = "mean"  # or sum, over the latent's dimensions
    gamma: float = 0.99
    tau: float = 0.005
    perturbation: bool = False  # the paper has none
    max_perturbation: float = 0.05
    value_bounds: tuple[float, float] | None = None  # of the next states' value
    loss_function: str = "l2"  # or l1, smooth_l1 (Huber)
    generator_warmup: int = 0  # updates of the generator alone before the critics start
    critic_grad_clip: float | None = None  # norm of the critics' gradient
    seeds: int = 1  # agents of each task; those after the first are kept under bcq/<task>-<seed>
    stacked: bool = False  # all agents as one program, for a GPU; False: a process each


@dataclass
class DistillSettings:
    """Stage 2: one student for all tasks."""

    updates: int = MISSING
    batch_size: int = 64  # of each task
    lr: float = 1e-3
    cosine: bool = True  # decay of the learning rate to zero
    num_cells: list[int] = field(default_factory=lambda: [256, 256])
    task_encoder: str = "transition"  # what m is made of; one_hot: of the task's index alone
    task_latent_dim: int = 2
    context: str = "set"  # what m is computed from: current (the paper's), previous, random, set
    context_fraction: float = 0.5
    context_size: int = 8
    encoder_terms: list[str] = field(default_factory=lambda: list(ENCODER_TERMS))  # train M
    classification_weight: float = 1.0
    generator_weight: float = 1.0
    direction_weight: float = 1.0
    qvalue_weight: float = 1.0
    latent_norm_weight: float = 2e-3
    metric_weight: float = 0.0  # of the triplet loss on m
    metric_margin: float = 1.0
    isometry_weight: float = 1.0  # of distances in m that are those of rewards and actions
    normalise_qvalue: bool = True
    prototype: str = "mean"  # or medoid


@dataclass
class EvaluateSettings:
    """Episodes from starts that no demonstration had."""

    episodes: int = MISSING  # of each task and policy
    num_candidates: int = 100
    latent_sources: list[str] = field(default_factory=lambda: ["prototype"])
    policy: str | None = None  # a shipped policy's file, evaluated alone
    expert_rollouts: bool = False  # False: the expert's rows are its demonstrations


@dataclass
class HumanSettings:
    """People's demonstrations of lift beside the scripted ones (learn_from_people.py)."""

    path: str = ""  # robosuite's demo.hdf5, or a file in robomimic's layout
    shares: list[float] = field(default_factory=lambda: [0.0, 0.1, 0.3])  # of each batch
    training_seeds: int = 2  # agents of each share
    tracking: float = 1.0  # see docs/data.md; 1 takes plain differences for actions


@dataclass
class ImitateSettings:
    """One demonstration of a composition drives the distilled policy (imitate.py)."""

    composition: str = "reach-lift-reach"
    demonstrations: int = 5  # each alone drives its share of the episodes
    episodes: int = 50  # of each method and perturbation
    magnitude: tuple[float, float] = (0.5, 1.5)  # factor of the perturbed motion
    max_angle: float = 45.0  # tilt of its direction [degrees]
    cloning_updates: int = 2000  # of behaviour cloning on the demonstration


@dataclass
class InterpolationSettings:
    """Exploration between the tasks' embeddings (interpolate.py)."""

    task: str = "lift"  # whose scene, and whose prototype the paths start from
    episodes: int = 50  # of each method


@dataclass
class LatentSACSettings:
    """SAC on top of the distilled policy, beside SAC alone (latent_sac.py)."""

    composition: str = "reach-lift"
    hold: int = 20  # steps of the environment that a chosen m is held
    num_candidates: int = 20  # of the frozen policy, which acts at every step
    environment_steps: int = 20_000  # of each agent
    random_steps: int = 1_000  # the first of these, without updates
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])
    eval_interval: int = 2_000  # steps of the environment
    eval_episodes: int = 10


@dataclass
class FQESettings:
    """Fitted Q evaluation of agents of stage 1, beside their true returns (fqe.py)."""

    checkpoints: list[int] = field(default_factory=lambda: [100, 250, 500, 1000, 2000, 4000])
    updates: int = 3000  # of each evaluation
    tau: float = 0.1  # of its target: bcq.tau would take twenty times as many to reach a value
    num_candidates: int = 10  # of the policies that are evaluated


@dataclass
class BaselineSettings:
    """Other offline algorithms on the same demonstrations (baselines.py)."""

    algorithms: list[str] = field(default_factory=lambda: list(BASELINES))
    updates: int | None = None  # of each; null: as many as an agent of stage 1


@dataclass
class Config:
    """Everything that decides a run; ``config.yaml`` in the run folder is one of these."""

    preset: str = MISSING  # the name
    ablation: str = MISSING
    seed: int = 0
    run_dir: str = "runs/${hydra:job.name}-${name:${preset},${ablation}}-seed${seed}"
    base: str | None = None  # a run's folder: what this run would make again is taken from there
    tasks: list[str] = field(default_factory=lambda: list(TASKS))
    only: list[str] | None = None  # tasks of this job of train_bcq.py; other jobs train the others
    workers: int = field(default_factory=available_cores)  # processes; no result depends on them
    stepper: str = "fast"  # or robosuite, four times slower; no result depends on it
    device: str = "cpu"  # that trains; episodes are played on the CPU
    compile: bool = False  # the updates, with torch.compile: half a minute, then faster
    cudagraphs: bool = False  # captures the updates, on a GPU
    logger: str = "csv"  # csv, wandb, tensorboard, none
    verbose: bool = False  # also says what is kept, read back, gone on from
    log_interval: int = 100  # updates
    checkpoint_interval: int = 1000  # updates
    keep_checkpoints: int = 2  # the newest, and those before it in case that is damaged
    collect: CollectSettings = field(default_factory=CollectSettings)
    bcq: BCQSettings = field(default_factory=BCQSettings)
    distill: DistillSettings = field(default_factory=DistillSettings)
    evaluate: EvaluateSettings = field(default_factory=EvaluateSettings)
    human: HumanSettings = field(default_factory=HumanSettings)
    imitate: ImitateSettings = field(default_factory=ImitateSettings)
    interpolation: InterpolationSettings = field(default_factory=InterpolationSettings)
    latent_sac: LatentSACSettings = field(default_factory=LatentSACSettings)
    fqe: FQESettings = field(default_factory=FQESettings)
    baselines: BaselineSettings = field(default_factory=BaselineSettings)


POSITIVE = (
    "workers",
    "log_interval",
    "checkpoint_interval",
    "keep_checkpoints",
    "bcq.epochs",
    "bcq.updates_per_epoch",
    "bcq.eval_episodes",
    "bcq.batch_size",
    "bcq.lr",
    "bcq.num_qvalue_nets",
    "bcq.num_candidates",
    "bcq.seeds",
    "distill.updates",
    "distill.batch_size",
    "distill.lr",
    "distill.task_latent_dim",
    "distill.context_size",
    "evaluate.episodes",
    "evaluate.num_candidates",
    "human.training_seeds",
    "human.tracking",
    "imitate.demonstrations",
    "imitate.episodes",
    "imitate.cloning_updates",
    "interpolation.episodes",
    "latent_sac.hold",
    "latent_sac.num_candidates",
    "latent_sac.environment_steps",
    "latent_sac.eval_interval",
    "latent_sac.eval_episodes",
    "fqe.checkpoints",
    "fqe.updates",
    "fqe.tau",
    "fqe.num_candidates",
    "collect.valid_episodes",
    "collect.gains.position",
    "collect.gains.grasp_position",
    "collect.gains.rotation",
    "collect.gains.speed_limit",
    "collect.gains.contact_speed_limit",
    "collect.gains.lift_height",
    "bcq.num_cells",
    "bcq.tau",
    "distill.num_cells",
)
POSITIVE_OR_NULL = ("bcq.critic_grad_clip", "bcq.latent_clip", "baselines.updates")
NOT_NEGATIVE = (
    "collect.noise",
    "collect.gains.grasp_steps",
    "bcq.kl_weight",
    "bcq.max_perturbation",
    "bcq.generator_warmup",
    "distill.classification_weight",
    "distill.generator_weight",
    "distill.direction_weight",
    "distill.qvalue_weight",
    "distill.latent_norm_weight",
    "distill.metric_weight",
    "distill.metric_margin",
    "distill.isometry_weight",
    "imitate.max_angle",
    "latent_sac.random_steps",
)
SHARES = (
    "collect.gains.speed_limit",
    "collect.gains.contact_speed_limit",
    "bcq.lmbda",
    "bcq.gamma",
    "bcq.tau",
    "fqe.tau",
    "distill.context_fraction",
    "human.shares",
)
RANGES = {
    POSITIVE: (sys.float_info.min, sys.float_info.max, "above 0"),
    POSITIVE_OR_NULL: (sys.float_info.min, sys.float_info.max, "above 0, or null"),
    NOT_NEGATIVE: (0.0, sys.float_info.max, "0 or above"),
    SHARES: (0.0, 1.0, "between 0 and 1"),
}
CHOICES = {
    "logger": LOGGERS,
    "stepper": STEPPERS,
    "bcq.loss_function": LOSS_FUNCTIONS,
    "bcq.kl_reduction": KL_REDUCTIONS,
    "distill.context": CONTEXTS,
    "distill.task_encoder": TASK_ENCODERS,
    "distill.prototype": ("mean", "medoid"),
}


def check_settings(config: Config, *, device: bool = True) -> None:
    """Checks what types cannot say.

    Args:
        config: the settings.
        device: whether ``device`` must be one of this machine.

    Raises:
        BMRLError: naming the key, its value and what is valid.
    """
    for task in [*config.tasks, *config.collect.train_episodes, config.interpolation.task]:
        check_task(task)
    missing = [task for task in config.tasks if task not in config.collect.train_episodes]
    if not config.tasks or missing or len(set(config.tasks)) < len(config.tasks):
        raise ConfigError(
            f"tasks is {config.tasks}; valid: at least one, each once and with a number in "
            "collect.train_episodes"
        )
    if (only := config.only) is not None:
        unknown = [task for task in only if task not in config.tasks]
        if not only or unknown or len(set(only)) < len(only):
            raise ConfigError(f"only is {only}; valid: some of {config.tasks}, each once")
        if config.bcq.stacked:
            raise ConfigError(f"only is {only}; valid: null with bcq.stacked, which is one program")
    for task, befores in config.collect.after.items():
        check_task(task)
        for before in filter(None, befores):
            composition_stages(before)
    if not config.evaluate.latent_sources:
        raise ConfigError(f"evaluate.latent_sources is []; valid: some of {list(LATENT_SOURCES)}")
    for source in config.evaluate.latent_sources:
        if source not in LATENT_SOURCES:
            raise UnknownNameError("latent source", source, LATENT_SOURCES)
    settings = OmegaConf.structured(config)
    for key, valid in CHOICES.items():
        if (value := OmegaConf.select(settings, key)) not in valid:
            raise UnknownNameError(key, value, valid)
    for keys, (low, high, valid) in RANGES.items():
        for key in keys:
            value = OmegaConf.select(settings, key)
            for number in OmegaConf.to_object(value) if OmegaConf.is_list(value) else [value]:
                # Not the other way round: "not a number" is within no range.
                if number is not None and not low <= number <= high:
                    raise ConfigError(f"{key} is {value}; valid: {valid}")
    for task, number in config.collect.train_episodes.items():
        if number < 1:
            raise ConfigError(f"collect.train_episodes.{task} is {number}; valid: above 0")
    low, high = config.imitate.magnitude
    if not 0 < low <= high < math.inf:
        raise ConfigError(f"imitate.magnitude is ({low}, {high}); valid: two factors, low to high")
    composition_stages(config.imitate.composition)
    if config.imitate.episodes % config.imitate.demonstrations:
        raise ConfigError(
            f"imitate.episodes is {config.imitate.episodes}; valid: a multiple of "
            f"imitate.demonstrations ({config.imitate.demonstrations})"
        )
    one_hot = config.distill.task_encoder == "one_hot"
    if one_hot and (
        config.evaluate.latent_sources != ["prototype"] or config.distill.isometry_weight
    ):
        raise ConfigError(
            "distill.task_encoder is one_hot, which knows no transitions; valid with it: "
            "evaluate.latent_sources=[prototype] and distill.isometry_weight=0"
        )
    if device:
        check_device(config.device)
    check_value_bounds(config.bcq.value_bounds)
    for term in config.distill.encoder_terms:
        if term not in ENCODER_TERMS:
            raise UnknownNameError("encoder term", term, ENCODER_TERMS)
    shares = config.human.shares
    if 0 not in shares or len(set(shares)) < len(shares):
        raise ConfigError(f"human.shares is {shares}; valid: 0 and others up to 1, each once")
    composition_stages(config.latent_sac.composition)
    seeds, steps = config.latent_sac.seeds, config.latent_sac.random_steps
    if not seeds or len(set(seeds)) < len(seeds):
        raise ConfigError(f"latent_sac.seeds is {seeds}; valid: at least one, each once")
    if steps > config.latent_sac.environment_steps:
        raise ConfigError(f"latent_sac.random_steps is {steps}; valid: 0 to environment_steps")
    series = config.fqe.checkpoints
    if len(series) < 2 or series != sorted(set(series)):
        raise ConfigError(f"fqe.checkpoints is {series}; valid: at least two, from low to high")
    names = config.baselines.algorithms
    for name in names:
        if name not in BASELINES:
            raise UnknownNameError("baseline", name, BASELINES)
    if not names or len(set(names)) < len(names):
        raise ConfigError(f"baselines.algorithms is {names}; valid: at least one, each once")


def deciding_settings(config: Config) -> dict[str, Any]:
    """What decides a run's result, by dotted names: a checkpoint says how it came about."""
    return deciding(OmegaConf.to_container(OmegaConf.structured(config)))


OUT_OF_MEMORY = (
    "lower bcq.batch_size or bcq.seeds in stage 1 (bcq.stacked=false trains one agent at a time), "
    "distill.batch_size in stage 2"
)


def tell(config: Config, message: str) -> None:
    """Logs what only ``verbose`` shows."""
    log.debug(message)


def run_recipe(
    settings: DictConfig,
    run: Callable[[Config], None],
    *,
    splits: bool = False,
    trains: bool = True,
) -> None:
    """Runs a recipe in its run folder, which it holds meanwhile; ends as a command should.

    Args:
        settings: what the command line and the preset say.
        run: the recipe.
        splits: it does the tasks of ``only`` and leaves the others to other jobs.
        trains: it needs the run's ``device``, which another machine may not have.
    """
    with exit_codes(out_of_memory=OUT_OF_MEMORY):
        try:
            log_to_stderr(verbose=settings.verbose is True)
            composed, settings = settings, with_folders_settings(settings)
            config = OmegaConf.to_object(settings)
        except OmegaConfBaseException as error:  # a reference to nothing, say
            raise ConfigError(str(error).partition("\n")[0]) from error
        check_settings(config, device=trains or settings is composed)
        if config.only is not None and not splits:
            raise ConfigError(f"only is {config.only}; valid: null, except with train_bcq.py")
        run_dir = Path(config.run_dir)
        # A job of only some tasks leaves the others', and all else, to other jobs.
        parts = config.only or ["run", *config.tasks]
        with hold_run(run_dir, OmegaConf.to_container(settings, resolve=True), parts):
            tell(
                config,
                f"{run_dir}: {run.__name__}, preset {config.preset}, seed {config.seed}, "
                f"{config.workers} workers, {config.device}",
            )
            gc.freeze()  # imported modules stay; robosuite would search them at every env.close()
            run(config)


OmegaConf.register_new_resolver(
    "name", lambda preset, ablation: preset if ablation == "none" else f"{preset}-{ablation}"
)
ConfigStore.instance().store(name="schema", node=Config)
