"""Networks, policies, and the task embedding."""

from torchrl_bmrl.modules.chunk_policy import ChunkPolicy
from torchrl_bmrl.modules.context_encoder import (
    ContextTaskLatent,
    as_context,
    embed_context,
    make_context_encoder,
    make_told_encoder,
    reads_context,
)
from torchrl_bmrl.modules.demonstration_latent import DemonstrationTaskLatent
from torchrl_bmrl.modules.discrete_policy import DiscreteBCQPolicy
from torchrl_bmrl.modules.ensemble import EnsembleCritic
from torchrl_bmrl.modules.flow import ActionFlow
from torchrl_bmrl.modules.following import LossPolicy, extract_critic, extract_network
from torchrl_bmrl.modules.gaussian_actor import make_gaussian_actor
from torchrl_bmrl.modules.generator import (
    ActionVAE,
    make_decoder,
    make_latent_actor,
    make_perturbation_network,
    make_qvalue_network,
)
from torchrl_bmrl.modules.latent_action import HeldTaskLatent, task_latent_box
from torchrl_bmrl.modules.mixture import ActionMixture
from torchrl_bmrl.modules.policy import BCQPolicy, PLASPolicy
from torchrl_bmrl.modules.reward_models import make_reward_models
from torchrl_bmrl.modules.task_latent import (
    OnlineTaskLatent,
    PathTaskLatent,
    PrototypeTaskLatent,
    StageTaskLatent,
    make_one_hot_encoder,
    make_task_classifier,
    make_task_encoder,
    prototype,
)

__all__ = [
    "ActionFlow",
    "ActionMixture",
    "ActionVAE",
    "BCQPolicy",
    "ChunkPolicy",
    "ContextTaskLatent",
    "DemonstrationTaskLatent",
    "DiscreteBCQPolicy",
    "EnsembleCritic",
    "HeldTaskLatent",
    "LossPolicy",
    "OnlineTaskLatent",
    "PLASPolicy",
    "PathTaskLatent",
    "PrototypeTaskLatent",
    "StageTaskLatent",
    "as_context",
    "embed_context",
    "extract_critic",
    "extract_network",
    "make_context_encoder",
    "make_decoder",
    "make_gaussian_actor",
    "make_latent_actor",
    "make_one_hot_encoder",
    "make_perturbation_network",
    "make_qvalue_network",
    "make_reward_models",
    "make_task_classifier",
    "make_task_encoder",
    "make_told_encoder",
    "prototype",
    "reads_context",
    "task_latent_box",
]
