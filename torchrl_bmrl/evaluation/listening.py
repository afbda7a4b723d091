"""Whether a policy listens to m: what it does when m is swapped in the same states."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_bmrl.errors import BMRLError


@dataclass(frozen=True)
class Listening:
    """How far actions change with m and with the state.

    Attributes:
        by_latent: root mean square difference of two actions in one state with different m.
        by_state: the same for one m in different states.
        share: ``by_latent²/(by_latent² + by_state²)``: 0 for a policy that ignores m.

    Example:
        >>> Listening(by_latent=0.3, by_state=0.3, share=0.5).share
        0.5
    """

    by_latent: float
    by_state: float
    share: float


@torch.no_grad()
def measure_listening(
    policy: TensorDictModuleBase, observation: Tensor, task_latents: Tensor, *, seed: int = 0
) -> Listening:
    """Measures whether a policy listens to m: swap m, and compare the actions.

    A multi-task policy often ignores its task where the state already tells it. Then the share is
    near 0 on the states of one task's demonstrations.

    Args:
        policy: reads ``observation`` and ``task_latent``, writes ``action``. Its random numbers
            are the same for every m.
        observation: states, ``(N, obs_dim)``, N > 1.
        task_latents: points m, ``(K, m)``, K > 1, such as a student's prototypes.
        seed: of the policy's random numbers.

    Raises:
        BMRLError: for fewer than two states or two points, other shapes, or actions that are not
            finite.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> deaf = TensorDictModule(lambda s, m: s, ["observation", "task_latent"], ["action"])
        >>> measure_listening(deaf, torch.randn(5, 2), torch.randn(3, 4)).share
        0.0
    """
    for name, value in {"observation": observation, "task_latents": task_latents}.items():
        if value.ndim != 2:
            raise BMRLError(f"{name} has shape {tuple(value.shape)}; valid: (N, size)")
    if len(observation) < 2 or len(task_latents) < 2:
        raise BMRLError(
            f"{len(observation)} states and {len(task_latents)} points m; valid: at least two each"
        )
    actions = []
    for latent in task_latents:
        data = {"observation": observation, "task_latent": latent.expand(len(observation), -1)}
        on_gpu = observation.device.type == "cuda"
        with torch.random.fork_rng([observation.device] if on_gpu else []):
            torch.manual_seed(seed)
            made = policy(TensorDict(data, batch_size=[len(observation)]))
        actions.append(made.get("action"))
    stacked = torch.stack(actions).double()  # (K, N, action_dim)
    if not stacked.isfinite().all():
        raise BMRLError("the policy's actions are not finite; valid: a policy that did not diverge")
    # The variance is half of the mean squared difference of two draws.
    by_latent = 2 * stacked.var(0).sum(-1).mean().item()
    by_state = 2 * stacked.var(1).sum(-1).mean().item()
    total = by_latent + by_state
    share = by_latent / total if total > 0 else 0.0
    return Listening(by_latent=by_latent**0.5, by_state=by_state**0.5, share=share)
