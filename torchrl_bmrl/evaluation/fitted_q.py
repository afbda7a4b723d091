"""Fitted Q evaluation: the return of a policy, estimated from demonstrations alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate

from torchrl_bmrl.data import make_replay_buffer
from torchrl_bmrl.modules import make_qvalue_network
from torchrl_bmrl.objectives import FQELoss
from torchrl_bmrl.training.fit import Every, fit
from torchrl_bmrl.training.health import check_metrics, largest_metric
from torchrl_bmrl.training.update import gradient_step, make_adam


def estimate_return(
    policy: TensorDictModuleBase,
    data: TensorDictBase,
    *,
    updates: int,
    gamma: float,
    tau: float = 0.1,
    lr: float = 1e-3,
    batch_size: int = 128,
    num_cells: Sequence[int] = (256, 256),
    device: str = "cpu",
    where: str = "fitted Q evaluation",
    report: Callable[[int], object] = lambda updates: None,
) -> float:
    """Discounted return of a policy from the starts of the demonstrations.

    Args:
        policy: writes ``action``; it acts once in every state, before the critic is trained.
        data: transitions ``[N]`` with ``step`` and the policy's inputs, now and under ``"next"``.
        updates: of the critic.
        gamma: discount factor.
        tau: of the target network. BCQ's 0.005 would need twenty times as many updates.
        lr: learning rate.
        batch_size: of the updates.
        num_cells: widths of the critic's hidden layers.
        device: that trains.
        where: names the evaluation in errors.
        report: called with 1 after every update.

    Raises:
        BMRLError: if the critic diverges.

    Example:
        >>> from tensordict import TensorDict
        >>> step = {"observation": torch.zeros(4, 3)}
        >>> after = {"reward": torch.ones(4, 1), "done": torch.zeros(4, 1, dtype=torch.bool)}
        >>> after |= step | {"terminated": after["done"]}
        >>> data = {**step, "action": torch.zeros(4, 2), "step": torch.arange(4), "next": after}
        >>> policy = TensorDictModule(nn.Linear(3, 2), ["observation"], ["action"])
        >>> value = estimate_return(policy, TensorDict(data, [4]), updates=5, gamma=0.9)
    """
    sizes = data["observation"].shape[-1], data["action"].shape[-1]
    critic = make_qvalue_network(*sizes, num_cells=num_cells)
    acts = TensorDictModule(nn.Identity(), in_keys=["policy_action"], out_keys=["action"])
    loss = FQELoss(acts, critic, gamma=gamma).to(device)
    optimizer = make_adam(loss.qvalue_network_params.parameters(), lr)
    targets = SoftUpdate(loss, tau=tau)
    starts = _with_actions(policy, data[data["step"] == 0])
    data = data.copy().set("next", _with_actions(policy, data["next"]))
    buffer = make_replay_buffer(data, batch_size=batch_size, device=device)
    largest = largest_metric(data["next", "reward"])

    def step(update: int, batch: TensorDictBase) -> dict[str, Tensor]:
        value, metrics = loss.qvalue_loss(batch)
        gradient_step(optimizer, value)
        targets.step()
        return {"loss_qvalue": value.detach(), "pred_value": metrics["pred_value"]}

    def check(
        update: int, metrics: dict[str, Tensor], batch: TensorDictBase, logging: bool
    ) -> None:
        check_metrics(metrics, f"{where}, update {update}", largest=largest)

    fit(
        step,
        lambda: buffer.sample().select(*loss.in_keys),
        total=updates,
        every=Every(log=100, save=updates),
        check=check,
        save=lambda update: None,
        report=report,
    )
    return loss.policy_value(starts.to(device)).item()


def _with_actions(policy: TensorDictModuleBase, states: TensorDictBase) -> TensorDictBase:
    """States with the policy's action in each.

    The policy does not change, so that it need not act anew in every update, which would take
    three times as long.
    """
    parts = [policy(part.select(*policy.in_keys))["action"] for part in states.split(1000)]
    return states.copy().set("policy_action", torch.cat(parts))
