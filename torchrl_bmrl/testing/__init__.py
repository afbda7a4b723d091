"""Tests that every loss must pass, for your own losses; they need pytest (extra ``[test]``).

The core does not import this package.
"""

from torchrl_bmrl.extras import needs

with needs("test"):
    import pytest

# Before the import, so that a failed check shows the compared values.
pytest.register_assert_rewrite(f"{__name__}.contract", f"{__name__}.measures")

from torchrl_bmrl.testing.case import Case, discrete_transitions, transitions  # noqa: E402
from torchrl_bmrl.testing.contract import KeyedLossContract, OfflineLossContract  # noqa: E402

__all__ = [
    "Case",
    "KeyedLossContract",
    "OfflineLossContract",
    "discrete_transitions",
    "transitions",
]
