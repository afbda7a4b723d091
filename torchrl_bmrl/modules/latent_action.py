"""Environments whose action is the task embedding m, which a frozen policy executes."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs.transforms import Transform

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules.task_latent import only_in_environments


def task_latent_box(task_latent: Tensor, *, share: float = 0.98) -> tuple[Tensor, Tensor]:
    """The box that contains the middle share of the embeddings in every coordinate.

    Args:
        task_latent: embeddings of the training transitions, ``(N, m)``.
        share: share of the embeddings in each coordinate; both ends lose half of the rest.

    Returns:
        lower and upper corner, ``(m,)`` each.

    Raises:
        BMRLError: for a share outside (0, 1], or embeddings without extent.

    Example:
        >>> low, high = task_latent_box(torch.arange(101.0).unsqueeze(-1))
        >>> low.item(), high.item()
        (1.0, 99.0)
    """
    if not 0 < share <= 1:
        raise BMRLError(f"share is {share}; valid: above 0, up to 1")
    if task_latent.ndim != 2 or len(task_latent) < 2:
        raise BMRLError(f"embeddings have shape {tuple(task_latent.shape)}; valid: (N, m), N > 1")
    ordered = task_latent.double().sort(0).values  # torch.quantile takes 16 million at most
    last = len(ordered) - 1
    outside = round((1 - share) / 2 * last)
    low, high = ordered[outside].to(task_latent), ordered[last - outside].to(task_latent)
    if not (low < high).all():
        raise BMRLError(f"the embeddings lie within {low.tolist()} to {high.tolist()}: no box")
    return low, high


class HeldTaskLatent(Transform):
    r"""Makes m the environment's action: a frozen policy executes it for ``hold`` steps.

    .. math:: a_{t+i} \sim \hat\pi(\cdot \mid s_{t+i}, m_t),\quad
              R_t = \sum_{i=0}^{n-1} r_{t+i},\quad n \le k

    One step of the transformed environment is one decision: ``action`` is m, the policy acts on
    each new observation, and the decision's reward is the plain sum of the steps' rewards. If
    the episode ends earlier, so does the hold, with the episode's last observation. An agent that
    discounts a step by γ discounts a decision by :math:`\gamma^k`.

    (``FrameSkipTransform`` repeats an action and ``MultiAction`` takes several actions chosen in
    advance; here the policy sees every step.)

    Transforms before it act on every step, those after it on every decision. Batched environments
    also step the episodes that have ended within the hold, and discard these results.

    Reference: *Compositional Skill Learning Using Batch Meta RL*, section 7.5.

    Args:
        policy: reads ``task_latent (*B, m)`` beside observations, writes ``action``; no gradient
            passes through it.
        low: least m, ``(m,)``; see :func:`task_latent_box`.
        high: greatest m, ``(m,)``.
        hold: k, steps for which an m is used.

    Keys read: ``action (*B, m)``, and what the policy reads. Keys written: the environment's own
    after the last step, ``("next", "reward")`` (a sum) and ``held_steps (*B, 1)`` int64, the
    environment's steps that the decision took (0 at the reset).

    Raises:
        BMRLError: for a hold below one, a policy that does not read ``task_latent``, corners that
            span no box, and, once attached, a policy made for an m of another size.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv
        >>> env = ContinuousActionVecMockEnv()
        >>> policy = TensorDictModule(
        ...     lambda observation, m: observation * m.mean(-1, keepdim=True),
        ...     in_keys=["observation", "task_latent"],
        ...     out_keys=["action"],
        ... )
        >>> held = HeldTaskLatent(policy, -torch.ones(2), torch.ones(2), hold=5)
        >>> env = TransformedEnv(env, held)
        >>> env.action_spec.shape[-1]
        2
        >>> env.rollout(3)["next", "held_steps"].squeeze(-1).tolist()
        [5, 5, 5]
    """

    low: Tensor
    high: Tensor

    def __init__(
        self, policy: TensorDictModuleBase, low: Tensor, high: Tensor, *, hold: int
    ) -> None:
        if hold < 1:
            raise BMRLError(f"hold is {hold}; valid: at least 1")
        if "task_latent" not in policy.in_keys:
            raise BMRLError(f"the policy reads {policy.in_keys}; valid: task_latent among them")
        if low.ndim != 1 or low.shape != high.shape or not (low < high).all():
            raise BMRLError(
                f"the box is {low.tolist()} to {high.tolist()}; valid: (m,) each, low below high"
            )
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])
        self.policy = policy
        self.hold = hold
        self.register_buffer("low", low.detach().clone())
        self.register_buffer("high", high.detach().clone())

    def _act(self, tensordict: TensorDictBase, task_latent: Tensor) -> TensorDictBase:
        with torch.no_grad():
            return self.policy(tensordict.copy().set("task_latent", task_latent))

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._act(tensordict, tensordict.get("action"))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        parent, task_latent = self.parent, tensordict.get("task_latent")
        reward = next_tensordict.get("reward")
        steps = torch.ones_like(next_tensordict.get("done"), dtype=torch.int64)
        for _ in range(self.hold - 1):
            over = next_tensordict.get("done")
            if over.all():
                break
            after = parent._step(self._act(next_tensordict, task_latent))
            reward = reward + after.get("reward").masked_fill(over, 0)
            steps = steps + ~over
            if over.any():
                after = torch.where(over.squeeze(-1), next_tensordict, after)
            next_tensordict = after
        return next_tensordict.update({"reward": reward, "held_steps": steps})

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        steps = torch.zeros((*tensordict_reset.batch_size, 1), dtype=torch.int64)
        return tensordict_reset.set("held_steps", steps)

    forward = only_in_environments

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """The action becomes m, within the box."""
        actions = input_spec["full_action_spec"]
        shape = (*actions.shape, len(self.low))
        actions["action"] = Bounded(self.low.expand(shape), self.high.expand(shape), shape)
        return input_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds ``held_steps``, after a trial action of the policy with an m of this size.

        Raises:
            BMRLError: if the policy was made for an m of another size.
        """
        trial = observation_spec.zero()
        try:
            with torch.random.fork_rng(devices=[]):
                self._act(trial, self.low.expand(*trial.batch_size, -1))
        except (RuntimeError, IndexError) as error:
            size = len(self.low)
            raise BMRLError(f"the policy does not act with an m of size {size}: {error}") from error
        shape = (*observation_spec.shape, 1)
        observation_spec["held_steps"] = Unbounded(shape, dtype=torch.int64)
        return observation_spec
