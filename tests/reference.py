"""One full update of every loss in plain numpy, written from the papers' equations.

Nothing here knows torch or the library. A state is a dict of arrays, ``"network.layer.weight"``;
networks have one hidden tanh layer. Gradients are finite differences of the loss in each weight,
so a term that must not send a gradient somewhere is computed from the state before the step.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy import ndarray

State = Mapping[str, ndarray]

LEARNING_RATE = 0.1
TAU = 0.1
STEP = 3e-4  # of the differences, whose error is of fourth order in it
# PyTorch's distance adds this to every difference, so that its root has a gradient at zero.
DISTANCE_EPSILON = 1e-6


# -- networks ----------------------------------------------------------------------------------


def linear(state: State, name: str, x: ndarray) -> ndarray:
    return x @ state[f"{name}.weight"].T + state[f"{name}.bias"]


def network(state: State, name: str, *inputs: ndarray) -> ndarray:
    hidden = np.tanh(linear(state, f"{name}.hidden", np.concatenate(inputs, -1)))
    return linear(state, f"{name}.output", hidden)


def posterior(state: State, *inputs: ndarray) -> tuple[ndarray, ndarray]:
    """Mean and standard deviation of q(z | s, a)."""
    loc, log_scale = np.split(network(state, "generator.encoder", *inputs), 2, -1)
    return loc, np.exp(log_scale)


def decoded(state: State, observation: ndarray, latent: ndarray) -> ndarray:
    """G(s, z)."""
    return np.tanh(network(state, "generator.decoder", observation, latent))


def ensemble(state: State, name: str, *inputs: ndarray) -> ndarray:
    """Outputs of all critics, stacked in front."""
    count = len({key.split(".")[1] for key in state if key.startswith(f"{name}.")})
    return np.stack([network(state, f"{name}.{j}", *inputs) for j in range(count)])


# -- one update --------------------------------------------------------------------------------


def slopes(function: Callable[[State], float], state: State, names: tuple[str, ...]) -> State:
    """Gradient of a function in the weights of the named networks, by five-point differences."""
    result = {}
    for key, value in state.items():
        if not key.startswith(tuple(f"{name}." for name in names)):
            continue
        result[key] = np.zeros_like(value)
        for index in np.ndindex(value.shape):
            for offset, coefficient in ((-2, 1), (-1, -8), (1, 8), (2, -1)):
                moved = value.copy()
                moved[index] += offset * STEP
                result[key][index] += coefficient * function({**state, key: moved}) / (12 * STEP)
    return result


@dataclass
class Update:
    """The state on its way through an update, and what was met on it."""

    state: State
    values: dict[str, Any] = field(default_factory=dict)
    gradients: dict[str, State] = field(default_factory=dict)

    def descend(
        self, loss: str, function: Callable[[State], float], names: tuple[str, ...]
    ) -> None:
        """One step of gradient descent of the named networks."""
        self.values[f"loss_{loss}"] = function(self.state)
        self.gradients[loss] = slopes(function, self.state, names)
        moved = {
            key: self.state[key] - LEARNING_RATE * g for key, g in self.gradients[loss].items()
        }
        self.state = {**self.state, **moved}

    def follow(self) -> None:
        """Moves every target towards its network."""
        self.state = {
            key: (1 - TAU) * value + TAU * self.state[key.removeprefix("target_")]
            if key.startswith("target_")
            else value
            for key, value in self.state.items()
        }


def distance(error: ndarray, loss_function: str) -> ndarray:
    if loss_function == "l2":
        return error**2
    size = np.abs(error)
    return size if loss_function == "l1" else np.where(size < 1, error**2 / 2, size - 0.5)


def soft_clipped(q: ndarray, lmbda: float) -> ndarray:
    return lmbda * q.min(0) + (1 - lmbda) * q.max(0)


def perturbed(
    state: State,
    name: str,
    observation: ndarray,
    action: ndarray,
    max_perturbation: float,
    bounds: tuple[ndarray, ndarray],
) -> ndarray:
    """a + φ h ξ(s, a) within the bounds, h half their distance; a itself without a network."""
    if f"{name}.output.bias" not in state:
        return action
    xi = np.tanh(network(state, name, observation, action))
    moved = action + max_perturbation * (bounds[1] - bounds[0]) / 2 * xi
    return np.minimum(np.maximum(moved, bounds[0]), bounds[1])


def train_autoencoder(
    update: Update, data: State, noise: ndarray, *, kl_weight: float, kl_reduction: str
) -> None:
    def terms(state: State) -> tuple[ndarray, ndarray]:
        loc, scale = posterior(state, data["observation"], data["action"])
        reconstruction = decoded(state, data["observation"], loc + scale * noise)
        error = ((reconstruction - data["action"]) ** 2).mean(-1)
        divergence = (loc**2 + scale**2 - 1) / 2 - np.log(scale)
        return error, divergence.sum(-1) if kl_reduction == "sum" else divergence.mean(-1)

    def loss(state: State) -> float:
        error, divergence = terms(state)
        return (error + kl_weight * divergence).mean()

    error, divergence = terms(update.state)
    update.values["reconstruction_error"] = error.mean()
    update.values["kl_divergence"] = divergence.mean()
    update.descend("generator", loss, ("generator",))


def train_critics(
    update: Update,
    data: State,
    next_value: ndarray,
    predict: Callable[[State], ndarray],
    *,
    gamma: float,
    loss_function: str,
) -> None:
    target = data["reward"] + gamma * (1 - data["terminated"]) * next_value
    predicted = predict(update.state)
    update.values |= {
        "td_error": (predicted - target) ** 2,
        "pred_value": predicted.mean(),
        "target_value": target.mean(),
        "next_state_value": next_value.mean(),
    }

    def loss(state: State) -> float:
        return distance(predict(state) - target, loss_function).sum(0).mean()

    update.descend("qvalue", loss, ("qvalue_network",))


# -- the algorithms ----------------------------------------------------------------------------


def bcq(
    state: State,
    data: State,
    noise: State,
    *,
    gamma: float,
    lmbda: float,
    latent_clip: float | None,
    kl_weight: float,
    kl_reduction: str,
    max_perturbation: float,
    bounds: tuple[ndarray, ndarray],
    value_bounds: tuple[float, float] | None,
    loss_function: str,
) -> Update:
    """Fujimoto et al. 2019, algorithm 1; z has the noise's names ``candidates``, ``proposal``."""
    update = Update(state)
    train_autoencoder(
        update, data, noise["posterior"], kl_weight=kl_weight, kl_reduction=kl_reduction
    )

    limit = np.inf if latent_clip is None else latent_clip
    latent = noise["candidates"].clip(-limit, limit)  # (B, candidates, z)
    after = data["next_observation"][:, None] + np.zeros((*latent.shape[:2], 1))
    action = decoded(update.state, after, latent)
    name = "target_perturbation_network"
    action = perturbed(update.state, name, after, action, max_perturbation, bounds)
    q = ensemble(update.state, "target_qvalue_network", after, action)[..., 0]
    next_value = soft_clipped(q, lmbda).max(-1)
    if value_bounds is not None:
        next_value = next_value.clip(*value_bounds)

    def predict(state: State) -> ndarray:
        return ensemble(state, "qvalue_network", data["observation"], data["action"])[..., 0]

    train_critics(update, data, next_value, predict, gamma=gamma, loss_function=loss_function)

    if "perturbation_network.output.bias" in state:
        now = data["observation"]
        proposal = decoded(update.state, now, noise["proposal"].clip(-limit, limit))

        def loss(state: State) -> float:
            name = "perturbation_network"
            action = perturbed(state, name, now, proposal, max_perturbation, bounds)
            return -ensemble(state, "qvalue_network", now, action)[0].mean()

        update.descend("perturbation", loss, ("perturbation_network",))
    update.follow()
    return update


def plas(
    state: State,
    data: State,
    noise: State,
    *,
    gamma: float,
    lmbda: float,
    kl_weight: float,
    kl_reduction: str,
    max_perturbation: float,
    bounds: tuple[ndarray, ndarray],
    max_latent: float,
    loss_function: str,
) -> Update:
    """Zhou et al. 2020, algorithm 1, the generator trained along."""
    update = Update(state)
    train_autoencoder(
        update, data, noise["posterior"], kl_weight=kl_weight, kl_reduction=kl_reduction
    )

    def act(state: State, observation: ndarray, prefix: str = "") -> ndarray:
        latent = max_latent * np.tanh(network(state, f"{prefix}actor_network", observation))
        action = decoded(state, observation, latent)
        name = f"{prefix}perturbation_network"
        return perturbed(state, name, observation, action, max_perturbation, bounds)

    after = data["next_observation"]
    action = act(update.state, after, "target_")
    q = ensemble(update.state, "target_qvalue_network", after, action)[..., 0]

    def predict(state: State) -> ndarray:
        return ensemble(state, "qvalue_network", data["observation"], data["action"])[..., 0]

    train_critics(
        update, data, soft_clipped(q, lmbda), predict, gamma=gamma, loss_function=loss_function
    )

    def loss(state: State) -> float:
        now = data["observation"]
        return -ensemble(state, "qvalue_network", now, act(state, now))[0].mean()

    update.descend("actor", loss, ("actor_network", "perturbation_network"))
    update.follow()
    return update


def discrete_bcq(
    state: State,
    data: State,
    *,
    gamma: float,
    threshold: float,
    logits_weight: float,
    loss_function: str,
) -> Update:
    """Fujimoto et al. 2019, discrete; ``gaps`` tells how far its decisions are from a tie."""
    update = Update(state)
    rows = np.arange(len(data["action"]))

    def log_likelihood(state: State, observation: ndarray) -> tuple[ndarray, ndarray]:
        logits = network(state, "generator", observation)
        return logits, logits - np.log(np.exp(logits).sum(-1, keepdims=True))

    def cross_entropy(state: State) -> ndarray:
        return -log_likelihood(state, data["observation"])[1][rows, data["action"]]

    def loss(state: State) -> float:
        logits, _ = log_likelihood(state, data["observation"])
        return (cross_entropy(state) + logits_weight * (logits**2).mean(-1)).mean()

    update.values["cross_entropy"] = cross_entropy(update.state).mean()
    update.descend("generator", loss, ("generator",))

    after = data["next_observation"]
    likelihood = np.exp(log_likelihood(update.state, after)[1])
    ratio = likelihood / likelihood.max(-1, keepdims=True)
    q = ensemble(update.state, "qvalue_network", after).min(0)
    q = np.where(ratio > threshold, q, -np.inf)
    best = q.argmax(-1)
    next_value = ensemble(update.state, "target_qvalue_network", after).min(0)[rows, best]
    first, second = np.sort(q, -1)[:, :-3:-1].T
    gaps = [np.abs(ratio - threshold).min(), (first - second).min()]

    def predict(state: State) -> ndarray:
        return ensemble(state, "qvalue_network", data["observation"])[:, rows, data["action"]]

    train_critics(update, data, next_value, predict, gamma=gamma, loss_function=loss_function)
    update.follow()
    assert min(gaps) > 1e-3, f"an action's likelihood or value is too near a tie: {gaps}"
    return update


def meta_distillation(
    state: State,
    data: State,
    noise: State,
    *,
    latent_clip: float | None,
    qvalue_loc: ndarray,
    qvalue_scale: ndarray,
    classification_weight: float,
    generator_weight: float,
    direction_weight: float,
    qvalue_weight: float,
    latent_norm_weight: float,
    metric_weight: float,
    metric_margin: float,
    encoder_terms: tuple[str, ...],
) -> Update:
    """Section 6.2 of the paper; the triplet's rows are noise too. Data are (tasks, B, ...)."""
    update = Update(state)
    observation, task = data["observation"], data["task"]
    limit = np.inf if latent_clip is None else latent_clip
    latent = noise["latent"].clip(-limit, limit)
    taught, judged = [], []
    for i, (s, z) in enumerate(zip(observation, latent, strict=True)):
        taught.append(np.tanh(network(state, f"teacher_generators.{i}", s, z)))
        value = network(state, f"teacher_qvalue_networks.{i}", s, taught[-1])
        judged.append((value - qvalue_loc[i]) / qvalue_scale[i])
    g, q = np.stack(taught), np.stack(judged)[..., 0]

    def embedded(state: State) -> ndarray:
        keys = ("observation", "action", "reward", "next_observation")
        return network(state, "task_encoder", *(data[key] for key in keys))

    def imitated(state: State, m: ndarray) -> ndarray:
        return np.tanh(network(state, "student_generator", observation, latent, m))

    fixed_m = embedded(state)
    fixed_action = imitated(state, fixed_m)

    def terms(state: State) -> dict[str, ndarray]:
        m = embedded(state)

        def reaching(term: str) -> ndarray:
            return m if term in encoder_terms else fixed_m

        logits = linear(state, "task_classifier", reaching("classification"))
        chosen = np.take_along_axis(logits, task[..., None], -1)[..., 0]
        action = imitated(state, reaching("direction"))
        lengths = np.linalg.norm(action, axis=-1) * np.linalg.norm(g, axis=-1)
        q_hat = network(
            state, "student_qvalue_network", observation, fixed_action, reaching("qvalue")
        )[..., 0]
        result = {
            "classification": classification_weight * (np.log(np.exp(logits).sum(-1)) - chosen),
            "generator": generator_weight
            * ((imitated(state, reaching("generator")) - g) ** 2).sum(-1),
            "direction": direction_weight * (1 - (action * g).sum(-1) / lengths),
            "qvalue": qvalue_weight * (q_hat - q) ** 2,
            "latent_norm": latent_norm_weight * (m**2).sum(-1),
        }
        if metric_weight:
            anchor = reaching("metric")
            near = anchor[:, noise["near_row"]] - anchor
            far = anchor[noise["far_task"], noise["far_row"]] - anchor
            near, far = (
                np.linalg.norm(offset - DISTANCE_EPSILON, axis=-1) for offset in (near, far)
            )
            result["metric"] = metric_weight * np.maximum(0, near - far + metric_margin)
        return result

    for name, term in terms(state).items():
        update.values[f"loss_{name}"] = term.mean()
    update.values["td_error"] = sum(terms(state).values())
    logits = linear(state, "task_classifier", fixed_m)
    update.values["accuracy"] = (logits.argmax(-1) == task).mean()
    update.values["latent_norm"] = np.sqrt((fixed_m**2).sum(-1).mean())
    update.descend(
        "total",
        lambda state: sum(term.mean() for term in terms(state).values()),
        ("task_encoder", "task_classifier", "student_generator", "student_qvalue_network"),
    )
    return update
