"""Checks of torch.compile."""

from __future__ import annotations

from typing import Any

import torch

from torchrl_bmrl.testing.case import Case
from torchrl_bmrl.testing.measures import gradients, run, total


def check_compiled(case: Case, **options: Any) -> None:
    """Fails for a graph break, different values or gradients, or a second compilation.

    Args:
        case: the loss.
        **options: of :func:`torch.compile`.
    """
    torch._dynamo.reset()
    loss, data, other = case.make(), case.batch(), case.batch()
    expected = run(loss, data)
    total(expected).backward()
    expected_gradients = gradients(loss)
    loss.zero_grad()
    compiled = torch.compile(loss, fullgraph=True, **options)
    losses = run(compiled, other)
    total(losses).backward()
    torch.testing.assert_close(losses.detach().to_dict(), expected.detach().to_dict())
    torch.testing.assert_close(gradients(loss), expected_gradients)
    key = loss.tensor_keys.priority
    torch.testing.assert_close(other[key], data[key])
    with torch._dynamo.config.patch(error_on_recompile=True):
        compiled(case.batch())


class CompileChecks:
    """Checks of compilation, for every loss."""

    def test_a_compiled_loss_has_no_graph_break_and_the_same_values(self, case: Case) -> None:
        """Python code that depends on the numbers breaks the graph."""
        check_compiled(case, backend="eager")  # draws the same numbers as the uncompiled loss
