"""Updates as one piece that runs eagerly, compiled, or as a captured CUDA graph."""

from __future__ import annotations

import ctypes
import logging
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
"""Eager updates before a capture: kernels are chosen and memory is taken in them."""


def make_adam(params: Iterable[Tensor], lr: float) -> Adam:
    """Adam for :func:`gradient_step`: one fused kernel, its step and learning rate on the device.

    A scheduler changes the learning rate in place, which neither a compiled nor a captured update
    takes for another program.

    Args:
        params: what is trained, on one device.
        lr: learning rate.

    Raises:
        BMRLError: for a parameter that is an expanded or strided view: the fused kernel goes
            through its memory from the first element on, and would hit others.

    Example:
        >>> optimizer = make_adam(torch.nn.Linear(2, 1).parameters(), lr=1e-3)
        >>> optimizer.param_groups[0]["lr"]
        tensor(0.0010)
    """
    params = list(params)
    if not params:
        raise BMRLError("no parameters; valid: at least one that is trained")
    for param in params:
        if not torch.ops.aten.is_non_overlapping_and_dense(param):
            raise BMRLError(
                f"a parameter of the shape {tuple(param.shape)} has the strides {param.stride()}; "
                "valid: one without gaps and overlaps, such as its contiguous()"
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


def keep_freed_memory() -> bool:
    """Has the C library keep what PyTorch frees, and give it out again.

    glibc returns large blocks to the system, and every update takes them anew, page by page: a
    seventh of its time on a CPU at batch 128. The process holds on to its largest footprint.

    Returns:
        whether it could be set; the C library of other systems than Linux has no such setting.

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
    """Takes over what ``state_dict()`` gave, onto the optimizer's own device."""
    optimizer.load_state_dict(state)
    for group in optimizer.param_groups:
        group["lr"] = torch.as_tensor(group["lr"]).to(group["params"][0].device)
        for param in group["params"]:
            held = optimizer.state[param]
            for name in ("exp_avg", "exp_avg_sq"):
                held[name] = _laid_out_as(param, held[name])


def get_rng_state(device: str = "cpu") -> dict[str, Tensor]:
    """State of PyTorch's random numbers, on the CPU and on a GPU that is the device.

    Args:
        device: that trains, such as ``"cpu"`` or ``"cuda:0"``.

    Returns:
        the states, under ``"cpu"`` and, for a GPU, ``"cuda"``.

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
    """Takes over what :func:`get_rng_state` gave.

    Args:
        state: of that function.
        device: that trains; where the state has one of a GPU, this GPU takes it over.

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
    """Does what ``loss.sum().backward()`` and ``optimizer.step()`` do, in one compiled program.

    Compiled, those two are programs of their own with what surrounds them in Python between.

    Args:
        optimizer: of :func:`make_adam`.
        loss: shape ``()``, or of a :class:`~torchrl_bmrl.objectives.StackedLoss` ``[N]``.
        max_norm: bound on the norm of the gradient, of each member for itself.

    Raises:
        BMRLError: for an optimizer with several groups of parameters, options that this step does
            not take, or a loss that does not depend on its parameters.

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
            "the loss does not depend on the optimizer's parameters; valid: the loss's own, such "
            "as loss.qvalue_network_params.parameters(), not those of a module that it copied"
        )
    # As torch's Adam: a parameter that the loss does not depend on stays, and its momentum with it.
    params = [param for param, grad in zip(params, grads, strict=True) if grad is not None]
    grads = [grad for grad in grads if grad is not None]
    # The fused kernel goes through memory as the parameter lies; gradients may lie otherwise.
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
    """The optimizer's parameters and options; refuses what would be left out in silence."""
    if len(optimizer.param_groups) != 1 or not isinstance(optimizer.param_groups[0]["lr"], Tensor):
        raise BMRLError(
            f"an optimizer with {len(optimizer.param_groups)} groups of parameters and lr "
            f"{optimizer.param_groups[0]['lr']}; valid: one of make_adam"
        )
    (group,) = optimizer.param_groups
    for name in ("weight_decay", "amsgrad", "maximize"):
        if group[name]:
            raise BMRLError(f"{name} of the optimizer is {group[name]}; valid: 0, as of make_adam")
    return group


def _laid_out_as(param: Tensor, value: Tensor) -> Tensor:
    """The value with the strides of a parameter."""
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
    """The fused kernel's equations; that kernel the compiler cannot join with what is around it."""
    torch._foreach_add_(steps, 1.0)
    # Once, since they count alike, and as the fused kernel in float64: of 1 - 0.999 float32 has
    # four digits.
    count = steps[0].double()
    rate = lr.double() / (1.0 - beta1**count)
    root = (1.0 - beta2**count).rsqrt()
    for param, grad, mean, square in zip(params, grads, means, squares, strict=True):
        mean.lerp_(grad, 1.0 - beta1)
        square.mul_(beta2).addcmul_(grad, grad, value=1.0 - beta2)
        scale = square.sqrt() * root.to(param.dtype) + eps
        param.sub_(rate.to(param.dtype) * mean / scale)


def _clipped(grads: list[Tensor], max_norm: float, members: int) -> list[Tensor]:
    """As ``clip_grad_norm_``, over each member's gradients."""
    squares = [grad.square().flatten(members).sum(-1) for grad in grads]
    norm = torch.stack(squares).sum(0).sqrt()
    scale = (max_norm / (norm + 1e-6)).clamp(max=1.0)
    return [grad * scale.view(*scale.shape, *[1] * (grad.ndim - members)) for grad in grads]


def accelerate(
    update: Update, *, compiled: bool = False, captured: bool = False, device: str = "cpu"
) -> Update:
    """An update that is compiled, or captured as a CUDA graph, or both.

    Where that fails, at the first call or for want of a GPU, one message says why and the update
    runs as it is. The first call takes the time of the compilation, about half a minute.

    On CPU a compiled update draws random numbers as the eager one does, so that their results are
    equal. Compiling makes tensordicts no pytrees any more in the whole process, as
    ``tensordict.nn.CudaGraphModule`` does.

    Args:
        update: takes a batch, changes parameters in place and returns metrics. It must not look at
            numbers (``item()``), and when captured its batches must all have one shape.
        compiled: whether to use :func:`torch.compile`.
        captured: whether to record what it does on the GPU after some eager updates, and then
            replay that. The metrics of a replay lie where those of the one before it lay.
        device: that the update runs on.

    Example:
        >>> weight = torch.nn.Parameter(torch.ones(1))
        >>> optimizer = make_adam([weight], lr=0.1)
        >>> def update(batch):
        ...     loss = (weight * batch["x"]).square().sum()
        ...     gradient_step(optimizer, loss)
        ...     return {"loss": loss.detach()}
        >>> from tensordict import TensorDict
        >>> update = accelerate(update, captured=True)  # no GPU: says so and goes on
        >>> update(TensorDict({"x": torch.ones(1)}, []))["loss"]
        tensor(1.)
    """
    on_gpu = torch.device(device).type == "cuda"
    if captured and not on_gpu:
        log.warning(f"device={device} has no CUDA graphs; the updates run without")
        captured = False
    if not compiled and not captured:
        return update
    fast = update
    if compiled:
        log.info("compiling the updates, which takes about half a minute")
        fast = _Compiled(update, on_gpu)
    return _WithFallback(_Captured(fast) if captured else fast, update)


class _Compiled:
    """One compiled program of an update, its gradients in it."""

    def __init__(self, update: Update, on_gpu: bool) -> None:
        import torch._dynamo
        from tensordict.nn.functional_modules import _exclude_td_from_pytree

        # Said again whenever an update is compiled anew, and nothing that a user could act on.
        warnings.filterwarnings("ignore", r"Using lock_\(\) inside a compiled graph")
        # vmap over tensordicts does this at every call, and each would be compiled anew.
        _exclude_td_from_pytree().set()
        self.config = torch._dynamo.config
        # The compiler's own random numbers are slow on CPU.
        options: dict[str, Any] = {"fallback_random": not on_gpu}
        self.update = torch.compile(update, fullgraph=True, options=options)

    def __call__(self, batch: TensorDictBase) -> Metrics:
        # Not for the whole process: in a function that is compiled in several pieces and calls
        # backward(), PyTorch 2.13 then leaves the gradients out without a word.
        with self.config.patch(trace_autograd_ops=True):
            return self.update(batch)


class _WithFallback:
    """Runs the fast version; if its first calls fail, the plain one from then on."""

    def __init__(self, fast: Update, plain: Update) -> None:
        self.fast, self.plain, self.left = fast, plain, WARM_UP + 1

    def __call__(self, batch: TensorDictBase) -> Metrics:
        if not self.left:
            return self.fast(batch)
        self.left -= 1
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # what compilers say about tensordict's internals
                return self.fast(batch)
        except Exception as error:
            # A program that cannot be made has not run in part; what an eager update before a
            # capture cannot do, the plain one cannot either, and it says so itself.
            reason = str(error).strip().partition("\n")[0]
            log.warning(
                f"updates are not accelerated ({type(error).__name__}: {reason}); they run as is"
            )
            self.fast, self.left = self.plain, 0
            return self.plain(batch)


class _Captured:
    """A CUDA graph of an update.

    tensordict's CudaGraphModule waits for the device before every replay; this does not.
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
