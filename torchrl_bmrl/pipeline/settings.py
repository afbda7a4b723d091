"""Settings of a run of the two stages; the defaults are those of the preset ``quick``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from torchrl_bmrl.data.replay import check_device
from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.experts.controllers import ExpertGains
from torchrl_bmrl.experts.settings import ExpertSettings, experts_of
from torchrl_bmrl.functional import ACTING_RULES, TARGET_RULES
from torchrl_bmrl.objectives.checks import check_value_bounds
from torchrl_bmrl.objectives.common import LOSS_FUNCTIONS
from torchrl_bmrl.objectives.distillation import ARRANGING_TERMS, CONTEXTS, ENCODER_TERMS
from torchrl_bmrl.objectives.generative import KL_REDUCTIONS
from torchrl_bmrl.pipeline.agents import GENERATORS
from torchrl_bmrl.pipeline.student import LATENT_SOURCES, OF_SETS, TASK_ENCODERS
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

    # Number by task; "default" is for the other tasks.
    train_episodes: dict[str, int] = setting(
        {"default": 60, **dict.fromkeys(SIX_TASKS, 60), "lift": 80}, above=0
    )
    valid_episodes: int = setting(6, above=0)  # held-out episodes of each task
    # Episodes of each task in which the experts of the other tasks act, for distill.context=given.
    context_episodes: int = setting(0, at_least=0)
    noise: float = setting(0.2, at_least=0)  # standard deviation in each action dimension
    # By task: tasks whose experts act before an episode, in turn, for starts as in a composition.
    after: dict[str, list[str]] = field(default_factory=dict)
    gains: ExpertGains = field(default_factory=ExpertGains)  # gains of the experts
    # By task, or "default": experts of different quality, each given by its changes to noise and
    # gains. The episodes use them in turn. (Not float: OmegaConf refuses whole numbers there.)
    experts: dict[str, list[dict[str, Any]]] = field(default_factory=dict)

    def experts_of(self, task: str) -> list[ExpertSettings]:
        """Returns the experts that demonstrate a task; episode ``i`` uses ``i`` modulo the length.

        Args:
            task: name of the task.

        Raises:
            ConfigError: for invalid ``experts``.
        """
        return experts_of(task, self.experts, noise=self.noise, gains=self.gains)


OF_THE_AUTOENCODER = ("kl_weight", "kl_reduction", "latent_clip")
"""Settings of stage 1 that no other generator reads."""


@dataclass
class BCQSettings:
    """Stage 1: one Batch-Constrained Q-learning agent per task.

    Example:
        >>> BCQSettings(epochs=4).updates_per_epoch
        600
    """

    epochs: int = setting(2, above=0)  # the agents are evaluated after each
    updates_per_epoch: int = setting(600, above=0)  # updates of each network
    eval_episodes: int = setting(2, at_least=0)  # after each epoch, for the curves; 0: no curves
    batch_size: int = setting(128, above=0)  # transitions per update
    lr: float = setting(3e-3, above=0)  # learning rate of Adam
    cosine: bool = True  # the learning rate decays to zero
    num_cells: list[int] = setting([256, 256], above=0)  # widths of the hidden layers
    generator: str = setting("autoencoder", choices=tuple(GENERATORS))  # model of the actions
    num_qvalue_nets: int = setting(2, above=0)  # critics of each agent
    layer_norm: bool = False  # normalises the critics' hidden layers
    num_candidates: int = setting(10, above=0)  # proposals in the critics' target
    lmbda: float = setting(0.75, at_least=0, at_most=1)  # weight of the critics' minimum
    target_rule: str = setting("clipped", choices=TARGET_RULES)  # value of next actions
    acting_rule: str = setting("first", choices=ACTING_RULES)  # value of the policy's candidates
    latent_clip: float | None = setting(0.5, above=0)  # null turns it off
    kl_weight: float = setting(0.5, at_least=0)  # weight of the KL term in the generator's loss
    kl_reduction: str = setting("mean", choices=KL_REDUCTIONS)  # reduction over the latent
    gamma: float = setting(0.99, at_least=0, at_most=1)  # discount factor
    n_steps: int = setting(1, above=0)  # rewards in the critics' target
    action_chunk: int = setting(1, above=0)  # actions that are chosen at once, stage 1 only
    standard_reward: bool = False  # rewards minus their mean, over their standard deviation
    tau: float = setting(0.005, above=0, at_most=1)  # update rate of the target networks
    perturbation: bool = False  # perturbation network; none in the paper
    max_perturbation: float = setting(0.05, at_least=0)  # bound on the perturbation
    value_bounds: tuple[float, float] | None = None  # bounds of the next value
    loss_function: str = setting("l2", choices=LOSS_FUNCTIONS)  # loss of the critics
    generator_warmup: int = setting(0, at_least=0)  # first updates, of the generator only
    critic_grad_clip: float | None = setting(None, above=0)  # bound on the gradient's norm
    seeds: int = setting(1, above=0)  # agents per task; further ones: bcq/<task>-<seed>
    stacked: bool = False  # all agents in one program, for a GPU; else one process each

    @property
    def updates(self) -> int:
        """Of each network in all epochs."""
        return self.epochs * self.updates_per_epoch

    def check_single_actions(self, where: str) -> None:
        """Checks that the agents propose single actions.

        Args:
            where: what needs them, for the message.

        Raises:
            ConfigError: if they propose chunks.
        """
        if self.action_chunk > 1:
            raise ConfigError(f"bcq.action_chunk is {self.action_chunk}; valid for {where}: 1")


OF_SEVERAL_TASKS = ("mixing_fraction", *(f"{term}_weight" for term in ARRANGING_TERMS))
"""Settings of stage 2 that compare tasks."""


@dataclass
class DistillSettings:
    """Stage 2: one student for all tasks.

    Example:
        >>> DistillSettings(task_latent_dim=4).context
        'set'
    """

    updates: int = setting(2500, above=0)  # number of updates
    # Further updates, of an encoder that tells the task from any behaviour (context_episodes).
    inference_updates: int = setting(0, at_least=0)
    # Before these, updates of models of each task's reward, which relabel its contexts; 0: none.
    reward_updates: int = setting(0, at_least=0)
    batch_size: int = setting(64, above=0)  # transitions of each task per update
    lr: float = setting(3e-3, above=0)  # learning rate of Adam
    cosine: bool = True  # the learning rate decays to zero
    num_cells: list[int] = setting([256, 256], above=0)  # widths of the hidden layers
    task_encoder: str = setting("transition", choices=TASK_ENCODERS)  # input of the encoder
    task_latent_dim: int = setting(2, above=0)  # size of m
    context: str = setting("set", choices=CONTEXTS)  # transitions that m is computed from
    context_fraction: float = setting(0.5, at_least=0, at_most=1)  # share of set contexts
    context_size: int = setting(8, above=0)  # transitions in a set
    # Share of the rows whose m and targets are mixed with those of another task.
    mixing_fraction: float = setting(0.0, at_least=0, at_most=1)
    # Terms whose gradient trains the encoder.
    encoder_terms: list[str] = setting(list(ENCODER_TERMS), choices=ENCODER_TERMS)
    # Weight of the task's cross-entropy; null: no classifier.
    classification_weight: float | None = setting(1.0, at_least=0)
    generator_weight: float = setting(1.0, at_least=0)  # weight of the actions' loss
    direction_weight: float = setting(1.0, at_least=0)  # weight of the gradient direction
    qvalue_weight: float = setting(1.0, at_least=0)  # weight of the values' loss
    latent_norm_weight: float = setting(2e-3, at_least=0)  # weight of the squared norm of m
    metric_weight: float = setting(0.0, at_least=0)  # weight of the triplet loss on m
    metric_margin: float = setting(1.0, at_least=0)  # margin of the triplet loss
    distance_weight: float = setting(0.0, at_least=0)  # weight of FOCAL's distance on m
    contrastive_weight: float = setting(0.0, at_least=0)  # weight of InfoNCE on m
    temperature: float = setting(0.1, above=0)  # temperature of InfoNCE
    isometry_weight: float = setting(1.0, at_least=0)  # weight of the isometry of m
    advantage_weight: float = setting(1.0, at_least=0)  # weight of differences within a state
    normalise_qvalue: bool = True  # with each teacher's mean and deviation
    prototype: str = setting("mean", choices=("mean", "medoid"))  # a task's point of m

    @property
    def reads_contexts(self) -> bool:
        """Whether stage 2 reads episodes of another behaviour."""
        return self.context == "given" or self.inference_updates > 0

    def check(self, latent_sources: list[str]) -> None:
        """Checks that the settings fit what the encoder of m reads.

        Args:
            latent_sources: the run's sources of m when it is evaluated.

        Raises:
            ConfigError: naming the setting, its value and the valid values.
        """
        needs: dict[str, Any] = {}
        if self.task_encoder in OF_SETS:
            needs = {"context_fraction": 1, "isometry_weight": 0, "prototype": "mean"}
            if self.context not in ("set", "given"):
                needs["context"] = "set or given"
            elif self.batch_size < 2 * self.context_size:
                needs["batch_size"] = f"at least {2 * self.context_size}, two contexts"
        elif self.inference_updates:
            needs = {"inference_updates": 0}
        if self.reward_updates and not self.inference_updates:
            raise ConfigError(
                f"distill.reward_updates is {self.reward_updates} and distill.inference_updates 0; "
                "valid: 0, or updates of the encoder that the models are for"
            )
        if self.task_encoder not in OF_SETS and self.context == "given":
            needs["context"] = "another one, or an encoder of sets"
        if self.task_encoder in ("one_hot", "told", "nothing"):
            needs["isometry_weight"] = 0
            if self.context == "previous":
                needs["context"] = "set, current or random"
            if latent_sources != ["prototype"]:
                raise ConfigError(
                    f"distill.task_encoder is {self.task_encoder}, which does not read "
                    f"transitions, and evaluate.latent_sources {latent_sources}; valid: [prototype]"
                )
        for name, valid in needs.items():
            if (value := getattr(self, name)) != valid:
                raise ConfigError(
                    f"distill.{name} is {value}; valid with distill.task_encoder="
                    f"{self.task_encoder}: {valid}"
                )


@dataclass
class EvaluateSettings:
    """Episodes from starts that no demonstration had.

    Example:
        >>> EvaluateSettings(episodes=50).latent_sources
        ['prototype']
    """

    episodes: int = setting(20, above=0)  # episodes per task and policy
    num_candidates: int = setting(100, above=0)  # proposals that a policy chooses from
    # Sources of m for the distilled policy.
    latent_sources: list[str] = setting(["prototype"], choices=LATENT_SOURCES, unique=True)
    policy: str | None = None  # an exported policy's file, evaluated alone
    expert_rollouts: bool = False  # false: the expert's rows are its demonstrations
    reference: bool = False  # also play the scripted experts without noise, with default gains


@dataclass
class Settings:
    """All settings of a run; ``config.yaml`` in the run folder contains them.

    Example:
        >>> settings = Settings(tasks=["reach", "lift"], bcq=BCQSettings(epochs=2))
        >>> settings.check()
        >>> settings.distill.updates
        2500
    """

    preset: str = "quick"  # name of the preset
    ablation: str = "none"  # name of the ablation
    seed: int = 0  # seed of all random numbers
    run_dir: str = "runs/mine"  # folder of the run
    base: str | None = None  # folder of a run whose files are reused if the settings agree
    tasks: Any = None  # names, or a YAML file of tasks; null: the six Sawyer tasks
    robot: str | None = None  # arm of the robosuite tasks; null: the task's own
    only: list[str] | None = None  # tasks of this job of train_bcq.py; other jobs train the rest
    workers: int = setting(available_cores, above=0)  # processes; no result depends on their number
    stepper: str = setting("fast", choices=STEPPERS)  # of robosuite; the results are equal
    device: str = "cpu"  # device of training; episodes are played on the CPU
    compile: bool = False  # compile the updates, which takes half a minute
    cudagraphs: bool = False  # capture the updates as CUDA graphs
    logger: str = setting("csv", choices=LOGGERS)  # logger of the losses
    verbose: bool = False  # also log each file that is saved, loaded or resumed
    log_interval: int = setting(100, above=0)  # updates between two rows of losses
    checkpoint_interval: int = setting(1000, above=0)  # updates between two checkpoints
    keep_checkpoints: int = setting(2, above=0)  # number of checkpoints, in case one is damaged
    collect: CollectSettings = field(default_factory=CollectSettings)  # demonstrations
    bcq: BCQSettings = field(default_factory=BCQSettings)  # stage 1
    distill: DistillSettings = field(default_factory=DistillSettings)  # stage 2
    evaluate: EvaluateSettings = field(default_factory=EvaluateSettings)  # evaluation

    def check(self, *, device: bool = True) -> None:
        """Checks the values.

        Args:
            device: whether ``device`` must exist on this machine.

        Raises:
            BMRLError: naming the setting, its value and the valid values.
        """
        check_settings(self)
        for name in self.collect.experts:
            self.collect.experts_of(name)
        check_value_bounds(self.bcq.value_bounds)
        evaluate, distill, bcq = self.evaluate, self.distill, self.bcq
        if bcq.n_steps > 1 and bcq.action_chunk > 1:
            raise ConfigError(
                f"bcq.n_steps is {bcq.n_steps} and bcq.action_chunk {bcq.action_chunk}; valid: one "
                "of them 1, since a chunk's outcome is that of all its steps"
            )
        for name in OF_THE_AUTOENCODER if bcq.generator != "autoencoder" else ():
            value, default = getattr(bcq, name), getattr(BCQSettings(), name)
            if value != default:
                raise ConfigError(
                    f"bcq.{name} is {value}, and bcq.generator={bcq.generator} does not read it; "
                    f"valid with this generator: {default}, the default"
                )
        distill.check(evaluate.latent_sources)
        if self.only is not None and self.bcq.stacked:
            raise ConfigError(f"only is {self.only}; valid with bcq.stacked: null")
        if device:
            check_device(self.device)

    def check_distillation(self, tasks: Sequence[str]) -> None:
        """Checks that stage 2 can follow stage 1.

        Args:
            tasks: names of the run's tasks.

        Raises:
            ConfigError: for agents that propose chunks of actions, or terms that compare tasks if
                there is only one.
        """
        self.bcq.check_single_actions("the distillation")
        for name in OF_SEVERAL_TASKS:
            if len(tasks) < 2 and (value := getattr(self.distill, name)):
                raise ConfigError(
                    f"distill.{name} is {value}, and {tasks[0]} the only task; valid: 0, or two "
                    "tasks"
                )

    def deciding(self) -> dict[str, Any]:
        """The settings that decide a run's result, by dotted names, for checkpoints."""
        return deciding(asdict(self))
