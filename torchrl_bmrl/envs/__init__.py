"""The tabletop tasks for gymnasium and TorchRL; importing this package registers their ids."""

from contextlib import suppress

from torchrl_bmrl.envs.registration import register
from torchrl_bmrl.errors import MissingExtraError

with suppress(MissingExtraError):  # skills and transforms need no gymnasium
    register()

__all__ = ["register"]
