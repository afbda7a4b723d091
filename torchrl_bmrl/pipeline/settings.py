"""Settings of a run of the two stages; the defaults are those of the preset ``quick``."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from torchrl_bmrl.data.replay import check_device
from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.experts.controllers import ExpertGains
from torchrl_bmrl.objectives.checks import check_value_bounds
from torchrl_bmrl.objectives.common import LOSS_FUNCTIONS
from torchrl_bmrl.objectives.distillation import CONTEXTS, ENCODER_TERMS
from torchrl_bmrl.objectives.generative import KL_REDUCTIONS
from torchrl_bmrl.pipeline.agents import LATENT_SOURCES, TASK_ENCODERS
from torchrl_bmrl.run.folder import deciding
from torchrl_bmrl.run.loggers import LOGGERS
from torchrl_bmrl.run.settings import check_settings, setting
from torchrl_bmrl.run.workers import available_cores

STEPPERS = ("fast", "robosuite")
SIX_TASKS = ("reach", "lift", "push_right", "push_left", "push_up", "push_down")


@dataclass
class CollectSettings:
    """Demonstrations of the scripted experts.

    Example:
        >>> CollectSettings(noise=0.1).valid_episodes
        6
    """

    # By task; "default" is for the others.
    train_episodes: dict[str, int] = setting(
        {"default": 60, **dict.fromkeys(SIX_TASKS, 60), "lift": 80}, above=0
    )
    valid_episodes: int = setting(6, above=0)  # of each task, held out
    noise: float = setting(0.2, at_least=0)  # standard deviation on every action dimension
    # By task: what the expert does before an episode begins, in turn. Starts as in a composition.
    after: dict[str, list[str]] = field(default_factory=dict)
    gains: ExpertGains = field(default_factory=ExpertGains)  # of the experts' controllers


@dataclass
class BCQSettings:
    """Stage 1: one Batch-Constrained Q-learning agent per task.

    Example:
        >>> BCQSettings(epochs=2).updates_per_epoch
        1000
    """

    epochs: int = setting(5, above=0)  # an evaluation follows each
    updates_per_epoch: int = setting(1000, above=0)  # of every network
    eval_episodes: int = setting(3, above=0)  # after each epoch, for the curves
    batch_size: int = setting(128, above=0)  # transitions
    lr: float = setting(1e-3, above=0)  # of Adam
    num_cells: list[int] = setting([256, 256], above=0)  # widths of the hidden layers
    num_qvalue_nets: int = setting(2, above=0)  # critics of an agent
    num_candidates: int = setting(10, above=0)  # in the target
    lmbda: float = setting(0.75, at_least=0, at_most=1)  # weight of the critics' minimum
    latent_clip: float | None = setting(0.5, above=0)  # null turns it off
    kl_weight: float = setting(0.5, at_least=0)  # in the generator's loss
    kl_reduction: str = setting("mean", choices=KL_REDUCTIONS)  # over the latent's dimensions
    gamma: float = setting(0.99, at_least=0, at_most=1)  # discount
    tau: float = setting(0.005, above=0, at_most=1)  # step of the target networks
    perturbation: bool = False  # the paper has none
    max_perturbation: float = setting(0.05, at_least=0)  # bound on it
    value_bounds: tuple[float, float] | None = None  # of the next states' value
    loss_function: str = setting("l2", choices=LOSS_FUNCTIONS)  # of the critics
    generator_warmup: int = setting(0, at_least=0)  # updates of the generator alone at the start
    critic_grad_clip: float | None = setting(None, above=0)  # norm of the critics' gradient
    seeds: int = setting(1, above=0)  # agents per task; later ones are under bcq/<task>-<seed>
    stacked: bool = False  # all agents in one program, for a GPU; false: one process each


@dataclass
class DistillSettings:
    """Stage 2: one student for all tasks.

    Example:
        >>> DistillSettings(task_latent_dim=4).context
        'set'
    """

    updates: int = setting(12_000, above=0)  # of all networks together
    batch_size: int = setting(64, above=0)  # of each task
    lr: float = setting(1e-3, above=0)  # of Adam
    cosine: bool = True  # the learning rate decays to zero
    num_cells: list[int] = setting([256, 256], above=0)  # widths of the hidden layers
    task_encoder: str = setting("transition", choices=TASK_ENCODERS)  # what m is computed from
    task_latent_dim: int = setting(2, above=0)  # size of m
    context: str = setting("set", choices=CONTEXTS)  # transitions that m comes from
    context_fraction: float = setting(0.5, at_least=0, at_most=1)  # of contexts that are sets
    context_size: int = setting(8, above=0)  # transitions of a set
    # Terms whose gradient trains the encoder.
    encoder_terms: list[str] = setting(list(ENCODER_TERMS), choices=ENCODER_TERMS)
    classification_weight: float = setting(1.0, at_least=0)  # of the cross-entropy of the task
    generator_weight: float = setting(1.0, at_least=0)  # of the distance to the teachers' actions
    direction_weight: float = setting(1.0, at_least=0)  # of the critics' gradients' directions
    qvalue_weight: float = setting(1.0, at_least=0)  # of the distance to the teachers' values
    latent_norm_weight: float = setting(2e-3, at_least=0)  # of the squared norm of m
    metric_weight: float = setting(0.0, at_least=0)  # of the triplet loss on m
    metric_margin: float = setting(1.0, at_least=0)  # of the triplet loss
    isometry_weight: float = setting(1.0, at_least=0)  # distances in m follow rewards and actions
    normalise_qvalue: bool = True  # by each teacher's mean and deviation
    prototype: str = setting("mean", choices=("mean", "medoid"))  # point of m for a task


@dataclass
class EvaluateSettings:
    """Episodes from starts that no demonstration had.

    Example:
        >>> EvaluateSettings(episodes=50).latent_sources
        ['prototype']
    """

    episodes: int = setting(20, above=0)  # of each task and policy
    num_candidates: int = setting(100, above=0)  # actions that a policy chooses from
    # Where the distilled policy takes m from.
    latent_sources: list[str] = setting(["prototype"], choices=LATENT_SOURCES, unique=True)
    policy: str | None = None  # an exported policy's file, evaluated alone
    expert_rollouts: bool = False  # false: the expert's rows are its demonstrations


@dataclass
class Settings:
    """Everything that decides a run; ``config.yaml`` in the run folder is one of these.

    Example:
        >>> settings = Settings(tasks=["reach", "lift"], bcq=BCQSettings(epochs=2))
        >>> settings.check()
        >>> settings.distill.updates
        12000
    """

    preset: str = "quick"  # a name of settings
    ablation: str = "none"  # a name of changes to a preset
    seed: int = 0  # of everything random
    run_dir: str = "runs/mine"  # the folder of the run
    base: str | None = None  # another run's folder: its files are reused where settings agree
    tasks: Any = None  # names, or a YAML file of tasks; null: the six Sawyer tasks
    robot: str | None = None  # arm of the robosuite tasks; null: the task's own
    only: list[str] | None = None  # tasks of this job of train_bcq.py; other jobs train the rest
    # processes; no result depends on them
    workers: int = field(default_factory=available_cores, metadata=setting(above=0).metadata)
    stepper: str = setting("fast", choices=STEPPERS)  # of robosuite; no result depends on it
    device: str = "cpu"  # of training; episodes are played on the CPU
    compile: bool = False  # compiles the updates with torch.compile in half a minute
    cudagraphs: bool = False  # captures the updates, on a GPU
    logger: str = setting("csv", choices=LOGGERS)  # of the losses
    verbose: bool = False  # also logs what is saved, read back and resumed
    log_interval: int = setting(100, above=0)  # updates between two rows of losses
    checkpoint_interval: int = setting(1000, above=0)  # updates between two checkpoints
    keep_checkpoints: int = setting(2, above=0)  # the newest ones, in case one is damaged
    collect: CollectSettings = field(default_factory=CollectSettings)  # demonstrations
    bcq: BCQSettings = field(default_factory=BCQSettings)  # stage 1
    distill: DistillSettings = field(default_factory=DistillSettings)  # stage 2
    evaluate: EvaluateSettings = field(default_factory=EvaluateSettings)  # evaluation

    def check(self, *, device: bool = True) -> None:
        """Checks the values.

        Args:
            device: whether ``device`` must exist on this machine.

        Raises:
            BMRLError: naming the setting, its value and what is valid.
        """
        check_settings(self)
        check_value_bounds(self.bcq.value_bounds)
        evaluate, distill = self.evaluate, self.distill
        if distill.task_encoder == "one_hot" and (
            evaluate.latent_sources != ["prototype"] or distill.isometry_weight
        ):
            raise ConfigError(
                "distill.task_encoder is one_hot, which does not read transitions; valid with it: "
                "evaluate.latent_sources=[prototype] and distill.isometry_weight=0"
            )
        if self.only is not None and self.bcq.stacked:
            raise ConfigError(f"only is {self.only}; valid with bcq.stacked: null")
        if device:
            check_device(self.device)

    def deciding(self) -> dict[str, Any]:
        """The settings that decide a run's result, by dotted names, for checkpoints."""
        return deciding(asdict(self))
