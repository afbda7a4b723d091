#!/usr/bin/env bash
# mushroom-rl 1.10.2: LSPI, its batch policy iteration (Lagoudakis and Parr 2003), and terminal states.
#
# Guess: a step into an absorbing state is worth its reward, as in FQI and DoubleFQI of the same package.
#        Actions that end the episode with rewards of 1 and 2 are worth 1 and 2.
# Seen:  with a discount of 0.9 they are worth 10 and 11. The values of the state after are set to 0 to
#        choose its action, but its features stay in the equations, so that it is worth what its
#        features say for action 0. An action that ends the episode with a reward of 2 is preferred to one
#        that goes on with 1 a step, which is worth 10. No warning. It does not show where a terminal
#        state shares no feature with others, as in tables; constants, polynomials, radial functions and
#        tilings share them. (LSPI.fit in algorithms/value/batch_td/lspi.py)
#
# Of what the package pins, torch 2.5.1 is replaced by a newer one, and opencv by its headless build.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-deps mushroom-rl==1.10.2
"$folder/venv/bin/pip" install --quiet torch==2.13.0 numpy==1.24.4 scipy==1.15.2 scikit-learn==1.6.1 \
    matplotlib==3.10.1 joblib==1.4.2 tqdm==4.67.1 pygame==2.6.1 opencv-python-headless==4.11.0.86

"$folder/venv/bin/python" -W ignore - <<'PY' | grep -v '^pygame\|^Hello'
from importlib.metadata import version

import numpy as np
from mushroom_rl.algorithms.value import LSPI
from mushroom_rl.core import MDPInfo
from mushroom_rl.features import Features
from mushroom_rl.features.basis import PolynomialBasis
from mushroom_rl.policy import EpsGreedy
from mushroom_rl.utils.spaces import Box, Discrete

GAMMA = 0.9


def values(rewards, ends):
    """What LSPI makes of the two actions, each of which always has this reward and end."""
    rng = np.random.default_rng(0)
    rows = []
    for i in range(400):
        now, after = rng.uniform(-1, 1, (2, 1))
        a = i % 2
        rows.append((now, np.array([a]), rewards[a], after, ends[a], ends[a]))
    features = Features(basis_list=PolynomialBasis.generate(1, 1))  # 1 and the state
    sizes = {"input_shape": (features.size,), "output_shape": (2,), "n_actions": 2}
    agent = LSPI(
        MDPInfo(Box(-1, 1, (1,)), Discrete(2), GAMMA, 100),
        EpsGreedy(epsilon=0.0),
        approximator_params=sizes,
        features=features,
        epsilon=1e-6,
    )
    agent.fit(rows)
    return agent.approximator.predict(features(np.zeros(1)).reshape(1, -1))[0]


print(f"mushroom-rl {version('mushroom-rl')}, LSPI, discount {GAMMA}: values of two actions")
found = values((1.0, 2.0), (True, True))
print(f"  both end the episode, rewards 1 and 2: {found.round(2)}, in truth [1. 2.]")
assert np.allclose(found, [10, 11], atol=0.1), "absorbing states are worth 0 now"

found = values((1.0, 2.0), (False, True))
print(f"  the first goes on with 1 a step, the second ends with 2: {found.round(2)}, in truth [10. 2.]")
assert found[1] > found[0] > 11, "going on is preferred now"

found = values((1.0, 2.0), (False, False))
print(f"  both go on: {found.round(2)}, in truth [19. 20.]")
assert np.allclose(found, [19, 20], atol=0.1)
PY
