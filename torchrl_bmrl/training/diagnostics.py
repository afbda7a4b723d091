"""Diagnostics of BCQ: do the candidates vary as the data do, and is the critic fooled by them?"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_bmrl.functional import ensemble_value, gaussian_kl
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.objectives import BCQLoss
from torchrl_bmrl.rows import number, read_rows, whole, write_rows

ACTIVE = 0.01
"""A latent dimension with a larger mean KL divergence [nats] is active."""
COLLAPSED = 0.2
"""Candidates with a smaller ``spread_ratio`` have collapsed: the policy clones the data."""
USUAL = 0.99
"""Share of the data's actions, nearest to the mean candidate first, that count as inside."""
FEWEST = 10
"""Candidates that are drawn for the spread even if the policy chooses among fewer."""
OUTSIDE = 0.5
"""With a larger ``outside_share`` most chosen actions leave the data."""
_COLUMNS = {
    "epoch": whole,
    "update": whole,
    **dict.fromkeys(
        ("candidate_spread", "spread_ratio", "qvalue_gap", "qvalue_std", "outside_share"), number
    ),
    "latent_kl": lambda text: tuple(map(number, text.split())) or None,
}


@dataclass(frozen=True, kw_only=True)
class Diagnostics:
    """Diagnostics of an agent on demonstrations.

    Attributes:
        candidate_spread: root-mean-square deviation of a state's candidates from their mean, in
            units of half the action's range.
        spread_ratio: ``candidate_spread`` over the deviation of the data's action from that mean. A
            generator that models the data exactly has 1, one that ignores its noise 0.
        qvalue_gap: mean of Q(s, chosen action) - Q(s, action of the data), with Q the value that
            the policy chooses by.
        qvalue_std: standard deviation of Q over the data.
        outside_share: share of the chosen actions that are farther from their state's mean
            candidate than :data:`USUAL` of the data's are.
        latent_kl: mean KL divergence of each latent dimension [nats]; ``None`` without an encoder.

    Example:
        >>> numbers = {"qvalue_gap": 0.3, "qvalue_std": 1.0, "outside_share": 0.01}
        >>> seen = Diagnostics(
        ...     candidate_spread=0.01, spread_ratio=0.05, latent_kl=(0.2, 0.0), **numbers
        ... )
        >>> seen.collapsed, seen.outside, seen.active_latents
        (True, False, 1)
    """

    candidate_spread: float
    spread_ratio: float
    qvalue_gap: float
    qvalue_std: float
    outside_share: float
    latent_kl: tuple[float, ...] | None

    @property
    def active_latents(self) -> int | None:
        """Number of latent dimensions that carry information; ``None`` without an encoder."""
        return None if self.latent_kl is None else sum(kl > ACTIVE for kl in self.latent_kl)

    @property
    def relative_gap(self) -> float:
        """``qvalue_gap`` in standard deviations of the data's values."""
        return self.qvalue_gap / self.qvalue_std if self.qvalue_std else math.nan

    @property
    def collapsed(self) -> bool:
        """Whether the candidates vary much less than the data."""
        return self.spread_ratio < COLLAPSED

    @property
    def outside(self) -> bool:
        """Whether most chosen actions lie outside the data."""
        return self.outside_share > OUTSIDE

    def metrics(self) -> dict[str, float]:
        """Returns numbers by name for a logger, with those of the latent if there is an encoder."""
        named = {name: x for name, x in vars(self).items() if name != "latent_kl"}
        if self.latent_kl is not None:
            named["active_latents"] = self.active_latents
            named["largest_latent_kl"] = max(self.latent_kl)
        return named


@torch.no_grad()
def diagnose(loss: BCQLoss, data: TensorDictBase, *, num_candidates: int = 100) -> Diagnostics:
    r"""Measures an agent's candidates and critic on demonstrations.

    With :math:`N` candidates :math:`a_i` of a state, their mean :math:`\bar a` and the data's
    action :math:`a`, the spread ratio is :math:`S / D`, where

    .. math:: S^2 = \tfrac{1}{N - 1} \sum_i (a_i - \bar a)^2,\quad
              D^2 = \tfrac{N}{N + 1} (a - \bar a)^2,

    each averaged over states and dimensions. If :math:`a` and :math:`a_i` have one distribution,
    both have the same expectation.

    An action's distance to :math:`\bar a` is the root mean square over its dimensions, each in
    units of the data's deviation. The plain range of the data's actions would not do: once the
    demonstrator's noise reaches the bounds, it contains every action.

    PyTorch's random state is the same after the call as before.

    Args:
        loss: an agent, with any generator; for one of a stack, ``stack.member(index)``.
        data: demonstrations, batch ``[*B]``, with the action and the entries of a state that the
            loss reads. Rows that a mask marks as padding do not count.
        num_candidates: candidates among which the policy chooses.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
        >>> loss = BCQLoss(ActionVAE(3, 2), make_qvalue_network(3, 2), bounds=(-1.0, 1.0))
        >>> data = TensorDict(
        ...     {"observation": torch.randn(64, 3), "action": torch.rand(64, 2)}, [64]
        ... )
        >>> seen = diagnose(loss, data)
        >>> seen.collapsed, len(seen.latent_kl)  # untrained, it ignores its noise
        (True, 4)
    """
    key, data = loss.tensor_keys.action, data.reshape(-1)
    if (valid := loss.valid_rows(data, data.batch_size)) is not None:
        data = data[valid]
    action, states = data.get(key), data.select(*loss.observation_keys)
    half = (loss.action_high - loss.action_low) / 2
    half = torch.where(half > 0, half, 1.0)
    with torch.random.fork_rng([action.device] if action.device.type == "cuda" else []):
        proposals = loss.propose(states, max(num_candidates, FEWEST))
    candidates = proposals.get(key)
    count, mean = candidates.shape[1], candidates.mean(1)
    spread = (candidates.var(1) / half**2).mean().sqrt()
    policy = BCQPolicy.frozen(loss, num_candidates=num_candidates)
    chosen = policy.choose(proposals[:, :num_candidates])
    value, best = (
        ensemble_value(loss.qvalue(states.copy().set(key, x)), loss.acting_rule)
        for x in (action, chosen)
    )
    error = (action - mean) / half
    scale = _rms(error, 0).clamp(min=1e-6) * half
    usual, distance = (_rms((x - mean) / scale, -1) for x in (action, chosen))
    distance = distance * ((count + 1) / (count - 1)) ** 0.5  # a chosen action is part of the mean
    return Diagnostics(
        candidate_spread=spread.item(),
        spread_ratio=(spread / _rms(error) / (count / (count + 1)) ** 0.5).item(),
        qvalue_gap=(best - value).mean().item(),
        qvalue_std=value.std().item(),
        outside_share=(distance > usual.quantile(USUAL)).float().mean().item(),
        latent_kl=_latent_kl(loss, data),
    )


def _rms(x: Tensor, dim: int | None = None) -> Tensor:
    return x.square().mean(dim).sqrt()


def _latent_kl(loss: BCQLoss, data: TensorDictBase) -> tuple[float, ...] | None:
    """Returns the mean KL divergence of each latent dimension; ``None`` without an encoder."""
    if not hasattr(loss.generator, "encode"):
        return None
    keys = loss.tensor_keys
    encoded = loss.encode(data)
    kl = gaussian_kl(encoded.get(keys.action_latent_loc), encoded.get(keys.action_latent_scale))
    return tuple(kl.flatten(0, -2).mean(0).tolist())


# -- files and messages ----------------------------------------------------------------------------


def write_diagnostics(
    path: str | os.PathLike[str], found: Diagnostics, *, epoch: int, update: int
) -> None:
    """Adds a row to a CSV file of diagnostics; rows of this update and later ones are replaced.

    Args:
        path: ``diagnostics.csv`` of an agent.
        found: the diagnostics.
        epoch: the epoch after which they were measured.
        update: number of the last update.

    Raises:
        DataError: if the file exists and contains something else.

    Example:
        >>> import tempfile
        >>> numbers = {"qvalue_gap": 0.3, "qvalue_std": 1.0, "outside_share": 0.01}
        >>> found = Diagnostics(candidate_spread=0.01, spread_ratio=0.05, latent_kl=None, **numbers)
        >>> path = Path(tempfile.mkdtemp()) / "diagnostics.csv"
        >>> write_diagnostics(path, found, epoch=1, update=1000)
        >>> read_diagnostics(path)[1000] == found
        True
    """
    path = Path(path)
    rows = read_rows(path, _COLUMNS) if path.is_file() else []
    rows = [row for row in rows if row["update"] < update]
    rows.append({"epoch": epoch, "update": update, **asdict(found)})
    write_rows(path, [{**row, "latent_kl": _joined(row["latent_kl"])} for row in rows])


def _joined(latent_kl: tuple[float, ...] | None) -> str:
    return " ".join(map(str, latent_kl or ()))


def read_diagnostics(path: str | os.PathLike[str]) -> dict[int, Diagnostics]:
    """Reads an agent's diagnostics by update, in the order of the updates.

    Args:
        path: ``diagnostics.csv`` of an agent.

    Raises:
        DataError: if the file is missing, or a column or a value is not valid.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "diagnostics.csv"
        >>> numbers = dict.fromkeys(("qvalue_gap", "qvalue_std", "outside_share"), 0.5)
        >>> found = Diagnostics(candidate_spread=0.1, spread_ratio=1.0, latent_kl=None, **numbers)
        >>> write_diagnostics(path, found, epoch=2, update=2000)
        >>> list(read_diagnostics(path))
        [2000]
    """
    rows = read_rows(path, _COLUMNS)
    return {
        row["update"]: Diagnostics(**{k: x for k, x in row.items() if k not in ("epoch", "update")})
        for row in rows
    }


def collapse_message(found: Mapping[str, Diagnostics]) -> str:
    """Returns a line that names the agents whose candidates have collapsed, empty without any.

    Args:
        found: diagnostics by agent.

    Example:
        >>> collapse_message({})
        ''
    """
    return _message(
        {name: x.spread_ratio for name, x in found.items() if x.collapsed},
        "the candidates of {names} vary less than the demonstrations (spread_ratio {span}, below "
        f"{COLLAPSED}), so these policies clone; to improve on the demonstrations try "
        "bcq.generator=gaussian, mixture or flow, or, with the autoencoder, a lower bcq.kl_weight "
        "and bcq.latent_clip=null",
    )


def outside_message(found: Mapping[str, Diagnostics]) -> str:
    """Returns a line that names the agents whose actions leave the data, empty without any.

    Args:
        found: diagnostics by agent.

    Example:
        >>> outside_message({})
        ''
    """
    return _message(
        {name: x.outside_share for name, x in found.items() if x.outside},
        "{names}: most chosen actions are unlike the demonstrations (outside_share {span}, above "
        f"{OUTSIDE}), so the critics may be fooled; try fewer candidates (evaluate.num_candidates, "
        "bcq.num_candidates) or a narrower generator (with the autoencoder a higher bcq.kl_weight, "
        "bcq.latent_clip=0.5)",
    )


def _message(values: Mapping[str, float], text: str) -> str:
    """Fills in the names and the range of their values; empty without names."""
    if not values:
        return ""
    low, high = (f"{x:.2f}" for x in (min(values.values()), max(values.values())))
    return text.format(names=", ".join(values), span=low if low == high else f"{low} to {high}")
