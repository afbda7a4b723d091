"""Description of a loss for the contract, and data to run it on."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn.functional import one_hot

CRITIC = "qvalue_network"
Edit = Callable[[str, TensorDictModuleBase], TensorDictModuleBase]


def transitions(
    *batch: int,
    observation_dim: int = 3,
    action_dim: int = 2,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
) -> TensorDict:
    """Random transitions; the first row is terminated, the second truncated.

    Args:
        *batch: shape of the batch.
        observation_dim: size of ``observation``.
        action_dim: size of ``action``, whose entries lie within ±1.
        dtype: of observation, action and reward.
        seed: of the numbers.

    Example:
        >>> transitions(8)["next", "reward"].shape
        torch.Size([8, 1])
    """
    generator = torch.Generator().manual_seed(seed)

    def randn(size: int) -> Tensor:
        return torch.randn(*batch, size, dtype=dtype, generator=generator)

    row = torch.arange(batch[-1]).expand(batch).unsqueeze(-1)
    return TensorDict(
        {
            "observation": randn(observation_dim),
            "action": randn(action_dim).tanh(),
            "next": {
                "observation": randn(observation_dim),
                "reward": randn(1),
                "done": row < 2,
                "terminated": row == 0,
                "truncated": row == 1,
            },
        },
        batch_size=batch,
    )


def discrete_transitions(
    *batch: int,
    observation_dim: int = 3,
    num_actions: int = 3,
    action_space: str = "one-hot",
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
) -> TensorDict:
    """Random transitions with discrete actions.

    Args:
        *batch: shape of the batch.
        observation_dim: size of ``observation``.
        num_actions: number of actions.
        action_space: ``"one-hot"`` for actions ``(*B, num_actions)``, ``"categorical"`` for
            ``(*B,)``.
        dtype: of observation and reward.
        seed: of the numbers.

    Example:
        >>> discrete_transitions(8)["action"].sum(-1)
        tensor([1, 1, 1, 1, 1, 1, 1, 1])
    """
    data = transitions(*batch, observation_dim=observation_dim, dtype=dtype, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    action = torch.randint(num_actions, batch, generator=generator)
    data["action"] = one_hot(action, num_actions) if action_space == "one-hot" else action
    return data


def unchanged(name: str, network: TensorDictModuleBase) -> TensorDictModuleBase:
    """The edit that changes no network."""
    return network


@dataclass(frozen=True)
class Case:
    """A loss, how to build it, and its properties.

    The contract builds the loss many times, as in
    ``loss(**networks(), **options, reduction="none")``: with networks of another dtype or with a
    shared torso, with one critic or several, and with other options.

    Attributes:
        loss: class of the loss, or a function that builds it. It takes the networks by the names
            that ``networks`` gives them, and passes options on to its base.
        networks: makes new, small networks by the names of the loss's arguments; one critic under
            ``"qvalue_network"``, of which the contract makes as many as it needs.
        trains: by term, in update order, the networks that its gradient reaches. The term
            ``"actor"`` is returned as ``loss_actor`` and computed by the method ``actor_loss``.
        targets: networks that have a target network.
        options: further arguments of the loss.
        data: makes a batch from its shape, ``data(*shape, dtype=...)``.
        shape: shape of a batch.
        need_not_fall: terms that training may increase, because they follow another network.
        mixes_rows: whether a row's losses depend on other rows of its batch, for example by a
            context that is drawn from the batch.
        by_task: whether row i of a batch ``[num_tasks, B]`` belongs to task i, so that rows cannot
            be in one dimension; such a loss mixes rows.

    Example:
        >>> from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
        >>> from torchrl_bmrl.objectives import BCQLoss
        >>> def networks():
        ...     return {"generator": ActionVAE(3, 2), "qvalue_network": make_qvalue_network(3, 2)}
        >>> case = Case(
        ...     BCQLoss,
        ...     networks,
        ...     trains={"generator": {"generator"}, "qvalue": {"qvalue_network"}},
        ...     targets={"qvalue_network"},
        ...     options={"bounds": (-1.0, 1.0)},
        ... )
        >>> case.make(reduction="none")(case.batch())["loss_qvalue"].shape
        torch.Size([8])
    """

    loss: Callable[..., Any]
    networks: Callable[[], dict[str, Any]]
    trains: Mapping[str, Collection[str]]
    targets: Collection[str] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    data: Callable[..., TensorDict] = field(default_factory=lambda: transitions)
    shape: tuple[int, ...] = (8,)
    need_not_fall: Collection[str] = ("actor", "perturbation")
    mixes_rows: bool = False
    by_task: bool = False

    def batch(self, *shape: int, dtype: torch.dtype = torch.float64) -> TensorDict:
        """A batch of the case's data.

        Args:
            *shape: shape of the batch, by default the case's.
            dtype: of the numbers.
        """
        return self.data(*(shape or self.shape), dtype=dtype)

    def critics(self, number: int, *, dtype: torch.dtype = torch.float64) -> list[Any]:
        """New critics, each with its own initialisation.

        Args:
            number: how many.
            dtype: of their parameters.
        """
        return [self.networks()[CRITIC].to(dtype) for _ in range(number)]

    def make(
        self,
        *,
        num_critics: int = 2,
        critics: Any = None,
        dtype: torch.dtype = torch.float64,
        seed: int = 0,
        edit: Edit = unchanged,
        **options: Any,
    ) -> Any:
        """Builds the loss and moves its target networks away from the trained ones.

        Args:
            num_critics: number of critics.
            critics: critics to use unchanged, instead of new ones.
            dtype: of the networks' parameters.
            seed: of the networks' parameters.
            edit: called with the name and each network; returns the network for the loss.
            **options: further arguments of the loss.
        """
        torch.manual_seed(seed)
        networks = self.networks()
        if CRITIC in networks and critics is None:
            more = [self.networks()[CRITIC] for _ in range(num_critics - 1)]
            networks[CRITIC] = [networks[CRITIC], *more]
        elif critics is not None:
            del networks[CRITIC]
        networks = {
            name: _edited(network, dtype, lambda part, name=name: edit(name, part))
            for name, network in networks.items()
        }
        if critics is not None:
            networks[CRITIC] = critics
        loss = self.loss(**networks, **{**self.options, **options})
        for name, target in loss.named_children():
            if name.startswith("target_"):
                for value in target.values(True, True):
                    if value.is_floating_point():
                        value.data.add_(torch.randn_like(value), alpha=0.3)
        return loss


def _edited(value: Any, dtype: torch.dtype, edit: Callable[..., Any]) -> Any:
    """A network, or a list of networks, with another dtype and edited."""
    if isinstance(value, (list, tuple)):
        return [_edited(each, dtype, edit) for each in value]
    if not isinstance(value, nn.Module):
        return value
    value = value.to(dtype)
    if hasattr(value, "row_loss") and not hasattr(value, "encoder"):
        return value  # a generator without parts has no keys to edit
    parts = [name for name in ("encoder", "decoder") if hasattr(value, name)]
    for name in parts:  # a loss uses the parts of a generator
        setattr(value, name, edit(getattr(value, name)))
    return edit(value) if isinstance(value, TensorDictModuleBase) and not parts else value
