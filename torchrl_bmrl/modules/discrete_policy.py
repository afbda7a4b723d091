"""The policy of discrete BCQ."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch.nn.functional import one_hot

from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.functional import likely_actions
from torchrl_bmrl.modules.following import (
    LossPolicy,
    Made,
    as_number,
    dispatched,
    key_options,
    link,
)
from torchrl_bmrl.ownership import check_trained


class DiscreteBCQPolicy(LossPolicy):
    r"""Chooses the action with the highest value among those that are likely enough.

    .. math:: \pi(s) = \arg\max_a \{Q_1(s, a) : G(a|s) / \max_{a'} G(a'|s) > \tau\}

    Reference: Fujimoto et al. 2019, https://arxiv.org/abs/1910.01708. :meth:`~LossPolicy.live` and
    :meth:`~LossPolicy.frozen` make the policy of a loss.

    Args:
        generator: classifier of the data's actions (observation) → ``logits``.
        qvalue_network: (observation) → ``action_value``.

    Keyword Args:
        threshold: τ.
        action_space: ``"one-hot"``, actions ``(*B, n)``, or ``"categorical"``, ``(*B,)``.
        action_key, logits_key, action_value_key: names of these entries in the networks.

    Keys read: ``observation``. Key written: ``action``, int64. A call with keywords returns it.

    Raises:
        BMRLError: for another action space, a critic that a loss has copied and trains elsewhere,
            or at a call for networks with different numbers of actions.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import MLP
        >>> generator, critic = (
        ...     TensorDictModule(MLP(3, 4), in_keys=["observation"], out_keys=[key])
        ...     for key in ("logits", "action_value")
        ... )
        >>> policy = DiscreteBCQPolicy(generator, critic)
        >>> policy(TensorDict({"observation": torch.zeros(5, 3)}, [5]))["action"].sum(-1)
        tensor([1, 1, 1, 1, 1])
    """

    def __init__(
        self,
        generator: TensorDictModule,
        qvalue_network: TensorDictModule,
        *,
        threshold: float = 0.3,
        action_space: str = "one-hot",
        action_key: NestedKey = "action",
        logits_key: NestedKey = "logits",
        action_value_key: NestedKey = "action_value",
    ) -> None:
        super().__init__()
        check_trained("qvalue_network", qvalue_network)
        action_space = str(action_space).replace("_", "-")
        if action_space not in ("one-hot", "categorical"):
            raise UnknownNameError("action_space", action_space, ("one-hot", "categorical"))
        self.logits_key = logits_key
        self.action_value_key = action_value_key
        self.generator = generator
        self.qvalue_network = qvalue_network
        self.threshold = threshold
        self.action_space = action_space
        self.in_keys = list(dict.fromkeys([*generator.in_keys, *qvalue_network.in_keys]))
        self.out_keys = [action_key]

    @classmethod
    def _from(cls, loss: Any, live: bool, **options: Any) -> Made[DiscreteBCQPolicy]:
        generator = link(loss, "generator", live)
        critic = link(loss, "qvalue_network", live, critic="first")
        policy = cls(
            generator.module,
            critic.module,
            threshold=as_number(loss.threshold),
            action_space=loss.action_space,
            **key_options(loss, "action", "logits", "action_value"),
            **options,
        )
        return policy, (generator, critic), ("threshold",)

    @dispatched
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action``.

        Raises:
            BMRLError: if generator and critic have different numbers of actions.
        """
        self.follow()
        data = self.qvalue_network(self.generator(tensordict.select(*self.in_keys)))
        logits, value = data.get(self.logits_key), data.get(self.action_value_key)
        if logits.shape != value.shape:
            raise BMRLError(
                f"{self.logits_key!r} has the shape {tuple(logits.shape)} and "
                f"{self.action_value_key!r} {tuple(value.shape)}; valid: equal shapes"
            )
        value = value.masked_fill(~likely_actions(logits, self.threshold), -torch.inf)
        action = value.argmax(-1)
        if self.action_space == "one-hot":
            action = one_hot(action, value.shape[-1])
        return tensordict.set(self.out_keys[0], action)
