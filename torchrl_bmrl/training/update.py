"""Updates that run eagerly, compiled, or as a captured CUDA graph, and their optimizer step."""

from __future__ import annotations

import ctypes
import logging
import math
import warnings
from collections.abc import Callable, Iterable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.optim import Adam
from torch.optim.adam import adam

from torchrl_bmrl.errors import BMRLError

log = logging.getLogger(__name__)

Metrics = dict[str, Tensor]
Update = Callable[[TensorDictBase], Metrics]

WARM_UP = 3
"""Eager updates before a capture, in which kernels are chosen and memory is allocated."""


def make_adam(params: Iterable[Tensor], lr: float) -> Adam:
    """Returns an Adam for :func:`gradient_step`, with a fused kernel.

    The step and the learning rate are tensors on the device. A scheduler changes the learning rate
    in place, so that a compiled or captured update stays valid.

    Args:
        params: the parameters, on one device.
        lr: learning rate.

    Raises:
        BMRLError: for a parameter that is an expanded or strided view: the fused kernel assumes
            dense memory and would write into other elements.

    Example:
        >>> optimizer = make_adam(torch.nn.Linear(2, 1).parameters(), lr=1e-3)
        >>> optimizer.param_groups[0]["lr"]
        tensor(0.0010)
    """
    params = list(params)
    if not params:
        raise BMRLError("no parameters; valid: at least one")
    for param in params:
        if not torch.ops.aten.is_non_overlapping_and_dense(param):
            raise BMRLError(
                f"a parameter of shape {tuple(param.shape)} has strides {param.stride()}; "
                "valid: dense memory, such as contiguous() returns"
            )
    rate = torch.tensor(lr, device=params[0].device)
    optimizer = Adam(params, lr=rate, fused=True)
    for param in params:
        optimizer.state[param] = {
            "step": torch.zeros((), device=param.device),
            "exp_avg": torch.zeros_like(param),
            "exp_avg_sq": torch.zeros_like(param),
        }
    return optimizer


def decay(optimizer: Adam, lr: float, update: int, total: int) -> None:
    """Sets the learning rate of an update, which decays to zero as a cosine.

    Args:
        optimizer: of :func:`make_adam`.
        lr: learning rate of the first update.
        update: number of the update; the first is 1.
        total: number of the last update.

    Example:
        >>> optimizer = make_adam(torch.nn.Linear(2, 1).parameters(), lr=1.0)
        >>> decay(optimizer, 1.0, update=51, total=100)
        >>> round(optimizer.param_groups[0]["lr"].item(), 6)
        0.5
    """
    share = (update - 1) / total
    optimizer.param_groups[0]["lr"].fill_(lr * (1 + math.cos(math.pi * share)) / 2)


def keep_freed_memory() -> bool:
    """Keeps freed memory in the allocator, so that the next update reuses it without page faults.

    By default glibc returns large blocks to the system. Allocating them again takes a fifth of
    a BCQ update on one CPU core at batch 128. The memory of the process never shrinks afterwards.

    Returns:
        whether the option was set; only glibc has it.

    Example:
        >>> keep_freed_memory() in (True, False)
        True
    """
    trim_threshold, mmap_threshold = -1, -3  # M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of malloc.h
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    return bool(mallopt(mmap_threshold, 32 * 2**20) and mallopt(trim_threshold, 2**30))


def load_adam(optimizer: Adam, state: dict[str, Any]) -> None:
    """Loads a ``state_dict()`` onto the optimizer's own device."""
    optimizer.load_state_dict(state)
    for group in optimizer.param_groups:
        group["lr"] = torch.as_tensor(group["lr"]).to(group["params"][0].device)
        for param in group["params"]:
            own = optimizer.state[param]
            for name in ("exp_avg", "exp_avg_sq"):
                own[name] = _laid_out_as(param, own[name])


def get_rng_state(device: str = "cpu") -> dict[str, Tensor]:
    """Returns the states of PyTorch's random number generators, ``"cpu"`` and for a GPU ``"cuda"``.

    Args:
        device: device of the training, such as ``"cpu"`` or ``"cuda:0"``.

    Example:
        >>> state = get_rng_state()
        >>> first = torch.rand(2)
        >>> set_rng_state(state)
        >>> torch.equal(torch.rand(2), first)
        True
    """
    state = {"cpu": torch.get_rng_state()}
    if torch.device(device).type == "cuda":
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


def set_rng_state(state: dict[str, Tensor], device: str = "cpu") -> None:
    """Restores the states that :func:`get_rng_state` returned.

    Args:
        state: the states.
        device: device of the training; gets the GPU's state, if there is one.

    Example:
        >>> before = get_rng_state()
        >>> set_rng_state(before)
        >>> torch.equal(get_rng_state()["cpu"], before["cpu"])
        True
    """
    torch.set_rng_state(state["cpu"])
    if "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"], device)


def gradient_step(optimizer: Adam, loss: Tensor, max_norm: float | None = None) -> None:
    """Does ``loss.sum().backward()`` and ``optimizer.step()`` so that they compile as one program.

    Args:
        optimizer: from :func:`make_adam`.
        loss: shape ``()``, or ``[N]`` of a :class:`~torchrl_bmrl.objectives.StackedLoss`.
        max_norm: bound on the gradient's norm, separately for each member.

    Raises:
        BMRLError: for an optimizer with several groups of parameters or unsupported options, or a
            loss that does not depend on its parameters.

    Example:
        >>> weight = torch.nn.Parameter(torch.ones(1))
        >>> gradient_step(make_adam([weight], lr=0.1), weight.square())
        >>> weight.data
        tensor([0.9000])
    """
    group = _only_group(optimizer)
    params = group["params"]
    grads = torch.autograd.grad(loss.sum(), params, allow_unused=True)
    if all(grad is None for grad in grads):
        raise BMRLError(
            "the loss does not depend on the optimizer's parameters; valid: parameters of the "
            "loss, such as loss.qvalue_network_params.parameters(), not of a module that it copied"
        )
    # As in torch's Adam, a parameter without gradient stays unchanged, and so does its momentum.
    params = [param for param, grad in zip(params, grads, strict=True) if grad is not None]
    grads = [grad for grad in grads if grad is not None]
    # The fused kernel reads memory in the parameter's order; gradients may have other strides.
    grads = [_laid_out_as(param, grad) for param, grad in zip(params, grads, strict=True)]
    state = [optimizer.state[param] for param in params]
    means, squares, steps = (
        [each[name] for each in state] for name in ("exp_avg", "exp_avg_sq", "step")
    )
    rates = {"lr": group["lr"], "eps": group["eps"]}
    beta1, beta2 = group["betas"]
    with torch.no_grad():
        if max_norm is not None:
            grads = _clipped(grads, max_norm, loss.ndim)
        if torch.compiler.is_compiling():
            _traced_adam(params, grads, means, squares, steps, beta1, beta2, **rates)
            return
        adam(
            params,
            grads,
            means,
            squares,
            [],
            steps,
            fused=True,
            amsgrad=False,
            beta1=beta1,
            beta2=beta2,
            weight_decay=0.0,
            maximize=False,
            **rates,
        )


def _only_group(optimizer: Adam) -> dict[str, Any]:
    """Returns the optimizer's only group; refuses options that would be ignored."""
    if len(optimizer.param_groups) != 1 or not isinstance(optimizer.param_groups[0]["lr"], Tensor):
        raise BMRLError(
            f"the optimizer has {len(optimizer.param_groups)} groups of parameters and lr "
            f"{optimizer.param_groups[0]['lr']}; valid: an optimizer of make_adam"
        )
    (group,) = optimizer.param_groups
    for name in ("weight_decay", "amsgrad", "maximize"):
        if group[name]:
            raise BMRLError(f"{name} of the optimizer is {group[name]}; valid: 0, as in make_adam")
    return group


def _laid_out_as(param: Tensor, value: Tensor) -> Tensor:
    """Returns the value with the strides of a parameter."""
    if value.stride() == param.stride():
        return value
    return torch.empty_like(param, dtype=value.dtype, requires_grad=False).copy_(value)


def _traced_adam(
    params: list[Tensor],
    grads: list[Tensor],
    means: list[Tensor],
    squares: list[Tensor],
    steps: list[Tensor],
    beta1: float,
    beta2: float,
    *,
    lr: Tensor,
    eps: float,
) -> None:
    """The fused kernel's equations, since the compiler cannot fuse that kernel with other code."""
    torch._foreach_add_(steps, 1.0)
    # All steps are equal. In float64, as in the fused kernel: float32 has four digits of 1 - 0.999.
    count = steps[0].double()
    rate = lr.double() / (1.0 - beta1**count)
    root = (1.0 - beta2**count).rsqrt()
    for param, grad, mean, square in zip(params, grads, means, squares, strict=True):
        mean.lerp_(grad, 1.0 - beta1)
        square.mul_(beta2).addcmul_(grad, grad, value=1.0 - beta2)
        scale = square.sqrt() * root.to(param.dtype) + eps
        param.sub_(rate.to(param.dtype) * mean / scale)


def _clipped(grads: list[Tensor], max_norm: float, members: int) -> list[Tensor]:
    """Clips as ``clip_grad_norm_`` does, separately for each member."""
    squares = [grad.square().flatten(members).sum(-1) for grad in grads]
    norm = torch.stack(squares).sum(0).sqrt()
    scale = (max_norm / (norm + 1e-6)).clamp(max=1.0)
    return [grad * scale.view(*scale.shape, *[1] * (grad.ndim - members)) for grad in grads]


def accelerate(
    update: Update, *, compiled: bool = False, captured: bool = False, device: str = "cpu"
) -> Update:
    """Compiles an update, captures it as a CUDA graph, or both.

    If this fails, or there is no GPU to capture on, a warning gives the reason and the update runs
    eagerly. The first call takes about half a minute to compile.

    On CPU a compiled update draws the same random numbers as the eager one, so that the results are
    equal. After compiling, tensordicts are no longer pytrees in the whole process, as with
    ``tensordict.nn.CudaGraphModule``.

    Args:
        update: takes a batch, changes parameters in place and returns metrics. It must not read
            values (``item()``); a captured one needs batches of one shape.
        compiled: whether to use :func:`torch.compile`.
        captured: whether to capture the update after some eager calls and then replay the graph.
            Each replay overwrites the metrics of the one before.
        device: device of the update.

    Example:
        >>> weight = torch.nn.Parameter(torch.ones(1))
        >>> optimizer = make_adam([weight], lr=0.1)
        >>> def update(batch):
        ...     loss = (weight * batch["x"]).square().sum()
        ...     gradient_step(optimizer, loss)
        ...     return {"loss": loss.detach()}
        >>> from tensordict import TensorDict
        >>> update = accelerate(update, captured=True)  # without a GPU: a warning, and eager
        >>> update(TensorDict({"x": torch.ones(1)}, []))["loss"]
        tensor(1.)
    """
    on_gpu = torch.device(device).type == "cuda"
    if captured and not on_gpu:
        log.warning(f"device={device} has no CUDA graphs; the updates run without them")
        captured = False
    if not compiled and not captured:
        return update
    fast = update
    if compiled:
        log.info("compiling the updates, which takes about half a minute")
        fast = _Compiled(update, on_gpu)
    return _WithFallback(_Captured(fast) if captured else fast, update)


class _Compiled:
    """An update as one compiled program, including its gradients."""

    def __init__(self, update: Update, on_gpu: bool) -> None:
        import torch._dynamo
        from tensordict.nn.functional_modules import _exclude_td_from_pytree

        # Repeated at every compilation, and users cannot act on it.
        warnings.filterwarnings("ignore", r"Using lock_\(\) inside a compiled graph")
        # vmap over tensordicts sets this at every call, and each call would be compiled again.
        _exclude_td_from_pytree().set()
        self.config = torch._dynamo.config
        # The compiler's own random numbers are slow on CPU.
        options: dict[str, Any] = {"fallback_random": not on_gpu}
        self.update = torch.compile(update, fullgraph=True, options=options)

    def __call__(self, batch: TensorDictBase) -> Metrics:
        # Only here: with this option PyTorch 2.13 silently leaves out the gradients of a function
        # that calls backward() and is compiled in several pieces.
        with self.config.patch(trace_autograd_ops=True):
            return self.update(batch)


class _WithFallback:
    """Runs the fast version, or the plain one from the first calls on if one of them fails."""

    def __init__(self, fast: Update, plain: Update) -> None:
        self.fast, self.plain, self.left = fast, plain, WARM_UP + 1

    def __call__(self, batch: TensorDictBase) -> Metrics:
        if not self.left:
            return self.fast(batch)
        self.left -= 1
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # compilers warn about tensordict's internals
                return self.fast(batch)
        except Exception as error:
            # A compilation that fails has changed nothing, so the update can be repeated. An error
            # in an eager update before a capture is raised again by the plain one.
            reason = str(error).strip().partition("\n")[0]
            log.warning(
                f"updates are not accelerated ({type(error).__name__}: {reason}); they run eagerly"
            )
            self.fast, self.left = self.plain, 0
            return self.plain(batch)


class _Captured:
    """A CUDA graph of an update.

    Unlike tensordict's ``CudaGraphModule``, it does not wait for the device before a replay.
    """

    def __init__(self, update: Update) -> None:
        self.update = update
        self.calls = 0
        self.graph: torch.cuda.CUDAGraph | None = None
        self.batch: TensorDictBase
        self.metrics: Metrics

    def __call__(self, batch: TensorDictBase) -> Metrics:
        if self.graph is not None:
            self.batch.copy_(batch, non_blocking=True)
            self.graph.replay()
            return self.metrics
        self.calls += 1
        if self.calls <= WARM_UP:
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                metrics = self.update(batch)
            torch.cuda.current_stream().wait_stream(stream)
            return metrics
        self.batch = batch.clone()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self.metrics = self.update(self.batch)
        self.graph = graph
        graph.replay()  # recording did not execute it
        return self.metrics
