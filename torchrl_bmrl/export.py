"""Exports policies as ONNX files, which need neither this library nor PyTorch."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.export import Dim

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import write_atomic
from torchrl_bmrl.generators import candidates
from torchrl_bmrl.modules import BCQPolicy, ChunkPolicy, DiscreteBCQPolicy, PLASPolicy


def export_policy(
    policy: BCQPolicy | PLASPolicy | DiscreteBCQPolicy,
    path: str | Path,
    example: TensorDictBase,
    *,
    loc: Tensor | None = None,
    scale: Tensor | None = None,
    observation_key: NestedKey = "observation",
    metadata: Mapping[str, Any] | None = None,
) -> None:
    """Writes a policy as an ONNX file, which runs with ONNX Runtime alone.

    The inputs are the policy's ``in_keys``, nested keys joined by ``_``, with one batch dimension.
    A :class:`~torchrl_bmrl.modules.BCQPolicy` also has the input ``action_latent (B, N,
    latent_dim)``: the caller draws a latent z for each candidate, and the file is deterministic. B
    and N are free. The output is ``action (B, action_dim)``.

    The metadata entry ``policy`` is a JSON text with the policy's ``kind`` and, for a BCQPolicy,
    ``num_candidates``, ``latent_dim`` and ``latent_clip`` for drawing the latents.

    Needs the extra ``[export]``.

    Args:
        policy: a policy whose networks ``torch.export`` supports, as it does all of this library's.
        path: the file.
        example: the policy's input with any batch size, such as ``env.reset()``; only shapes and
            types matter.

    Keyword Args:
        loc: mean ``(obs_dim,)`` of TorchRL's ``ObservationNorm(loc, scale, standard_normal=True)``
            if the policy was trained behind one; the file then reads the observation before it.
        scale: its standard deviation.
        observation_key: key of the normalised observation.
        metadata: JSON-compatible entries that are added to ``policy``.

    Raises:
        BMRLError: if only one of ``loc`` and ``scale`` is given, the scale is not finite and
            positive, the policy does not read ``observation_key`` or plays chunks, the example
            lacks a key, or the generator's actions are not a function of a latent.
        MissingExtraError: without the packages that write ONNX.

    Example:
        >>> import tempfile
        >>> from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
        >>> policy = BCQPolicy(ActionVAE(3, 2), make_qvalue_network(3, 2))
        >>> path = Path(tempfile.mkdtemp()) / "policy.onnx"
        >>> export_policy(policy, path, TensorDict({"observation": torch.zeros(3)}))
        >>> path.stat().st_size > 500_000
        True
    """
    with needs("export"):
        for package in ("onnx", "onnxscript"):
            import_module(package)
    acting = _Acting(policy, loc, scale, observation_key)
    inputs = acting.example(example)
    batch, number = Dim("batch"), Dim("candidates", min=2)
    shapes = [{0: batch} for _ in inputs]
    if acting.draws:
        shapes[-1][1] = number
    dynamic = {"inputs": tuple(shapes)}
    names = ["_".join(key) if isinstance(key, tuple) else key for key in acting.keys]
    with _quiet():
        program = torch.export.export(acting, inputs, dynamic_shapes=dynamic)
        onnx = torch.onnx.export(
            program,
            input_names=names,
            output_names=["action"],
            dynamic_shapes=dynamic,
            verbose=False,
        )
    assert onnx is not None  # for mypy; only torch's older exporter returns None
    graph = onnx.model.graph
    for part in (graph, *graph, *graph.initializers.values()):
        part.metadata_props.clear()  # paths of source files on this machine
    description = {"kind": type(policy).__name__} | acting.draws | dict(metadata or {})
    onnx.model.metadata_props["policy"] = json.dumps(description)
    write_atomic(path, onnx.model_proto.SerializeToString(deterministic=True))


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppresses the exporters' warnings, which are about operators that no policy has."""
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(level)


class _Acting(nn.Module):
    """A policy as a function of tensors, including the latents of its candidates."""

    loc: Tensor | None
    scale: Tensor | None

    def __init__(
        self,
        policy: BCQPolicy | PLASPolicy | DiscreteBCQPolicy,
        loc: Tensor | None,
        scale: Tensor | None,
        observation_key: NestedKey,
    ) -> None:
        super().__init__()
        if (loc is None) != (scale is None):
            raise BMRLError(f"loc is {loc} and scale is {scale}; valid: both, or neither")
        if scale is not None and not (scale.isfinite() & (scale > 0)).all():
            raise BMRLError(f"scale is {scale.tolist()}; valid: finite numbers above 0")
        if loc is not None and observation_key not in policy.in_keys:
            raise BMRLError(
                f"observation_key is {observation_key!r}; valid: keys of the policy, "
                f"{policy.in_keys}"
            )
        if isinstance(policy, ChunkPolicy):
            raise BMRLError(
                "a ChunkPolicy remembers its chunk between calls, which a file cannot; valid: its "
                "policy, whose action is the whole chunk"
            )
        self.policy = deepcopy(policy).cpu().eval().requires_grad_(False)
        self.observation_key = observation_key
        self.register_buffer("loc", loc)
        self.register_buffer("scale", scale)
        self.keys = list(policy.in_keys)
        self.draws: dict[str, Any] = {}
        if isinstance(policy, BCQPolicy):
            generator = policy.generator
            if hasattr(generator, "propose") and not hasattr(generator, "decode"):
                raise BMRLError(
                    f"generator {type(generator).__name__} has no 'decode'; valid: one with "
                    "actions that are a function of a latent, or a decoder"
                )
            clip = policy.latent_clip
            self.draws = {
                "num_candidates": policy.num_candidates,
                "latent_dim": policy.latent_dim,
                "latent_clip": None if clip is None else float(clip),
            }
            self.keys.append(policy.keys.action_latent)

    def example(self, example: TensorDictBase) -> tuple[Tensor, ...]:
        """Returns two rows of each input of :meth:`forward`."""
        missing = [key for key in self.policy.in_keys if example.get(key, None) is None]
        if missing:
            raise BMRLError(f"example has no {missing[0]!r}; valid: {self.policy.in_keys}")
        rows = example.select(*self.policy.in_keys).cpu().reshape(-1)[:1].expand(2)
        inputs = [rows.get(key).clone() for key in self.policy.in_keys]
        if self.draws:
            weight = next(self.policy.parameters())
            inputs.append(torch.zeros(2, 3, self.draws["latent_dim"], dtype=weight.dtype))
        return tuple(inputs)

    @torch.no_grad()
    def forward(self, *inputs: Tensor) -> Tensor:
        """Returns the action of each row."""
        values = dict(zip(self.keys, inputs, strict=True))
        if self.loc is not None:
            values[self.observation_key] = (values[self.observation_key] - self.loc) / self.scale
        state = TensorDict({key: values[key] for key in self.policy.in_keys}, inputs[0].shape[:1])
        if not self.draws:
            return self.policy(state).get(self.policy.out_keys[0])
        latent, keys, generator = inputs[-1], self.policy.keys, self.policy.generator
        drawn = candidates(state, latent.shape[1]).copy().set(keys.action_latent, latent)
        return self.policy.choose(
            generator.decode(drawn, keys) if hasattr(generator, "decode") else generator(drawn)
        )
