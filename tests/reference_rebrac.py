"""One update of ReBRAC in plain numpy, from the parts of :mod:`reference`."""

from __future__ import annotations

import numpy as np
from numpy import ndarray
from reference import State, Update, ensemble, network, train_critics


def rebrac(
    state: State,
    data: State,
    noise: State,
    *,
    gamma: float,
    actor_penalty: float,
    critic_penalty: float,
    normalise_q: bool,
    policy_noise: float,
    noise_clip: float,
    bounds: tuple[ndarray, ndarray],
    loss_function: str,
) -> Update:
    """Tarasov et al. 2023, one update of everything; the noise is named ``action``."""
    update = Update(state)
    low, high = bounds

    def act(state: State, observation: ndarray, prefix: str = "") -> ndarray:
        return np.tanh(network(state, f"{prefix}actor_network", observation))

    after = data["next_observation"]
    step = (policy_noise * noise["action"]).clip(-noise_clip, noise_clip) * (high - low) / 2
    action = (act(update.state, after, "target_") + step).clip(low, high)
    q = ensemble(update.state, "target_qvalue_network", after, action)[..., 0]
    next_value = q.min(0) - critic_penalty * ((action - data["next_action"]) ** 2).sum(-1)

    def predict(state: State) -> ndarray:
        return ensemble(state, "qvalue_network", data["observation"], data["action"])[..., 0]

    train_critics(update, data, next_value, predict, gamma=gamma, loss_function=loss_function)

    def value(state: State) -> ndarray:
        now = data["observation"]
        return ensemble(state, "qvalue_network", now, act(state, now))[..., 0].min(0)

    size = np.abs(value(update.state)).mean() if normalise_q else 1.0  # not differentiated

    def loss(state: State) -> float:
        error = ((act(state, data["observation"]) - data["action"]) ** 2).sum(-1)
        return (actor_penalty * error - value(state) / size).mean()

    update.descend("actor", loss, ("actor_network",))
    update.follow()
    return update
