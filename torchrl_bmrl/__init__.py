"""Compositional skill learning with batch meta RL, as TorchRL components.

The core (:mod:`torchrl_bmrl.objectives`, :mod:`torchrl_bmrl.modules` and
:mod:`torchrl_bmrl.data.replay`) needs torch, tensordict and torchrl only; everything else is
imported from its own subpackage and comes with an extra.
"""

__version__ = "0.1.0"
