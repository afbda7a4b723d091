"""The six Sawyer tasks for gymnasium and TorchRL; importing this package registers their ids."""

from torchrl_bmrl.envs.registration import register

register()

__all__ = ["register"]
