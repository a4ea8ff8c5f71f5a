"""Products of matrices as another library for them would round them."""

import os
import threading
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

VARIABLE = "SPLATSEG_TEST_PRODUCTS"
"""Of the environment: set by scripts/machines for tests of the machine `reordered`."""

aten = torch.ops.aten


def _begun_elsewhere(left: Tensor, right: Tensor, product: Callable[..., Tensor]) -> Tensor:
    """A product whose sums begin inside, at a place that changes with its size.

    Libraries choose the order of a sum by the processor, by the number of threads and by the
    shape: rows of a product need not be the product of these rows.
    """
    inner = right.shape[-2] if right.ndim > 1 else right.shape[0]
    if inner > 1 and (left.is_floating_point() or left.is_complex()):
        shift = 1 + (7 * left.shape[-2 if left.ndim > 1 else 0] + 3 * right.shape[-1]) % (inner - 1)
        left = left.roll(-shift, -1)
        right = right.roll(-shift, -2 if right.ndim > 1 else 0)
    return product(left, right)


def _added(start: Tensor, left: Tensor, right: Tensor, product: Any, beta: Any, alpha: Any) -> Any:
    found = _begun_elsewhere(left, right, product)
    found = found if alpha == 1 else alpha * found
    if beta == 0:  # then what `start` holds does not count, not even where it is NaN
        return found
    return found + (start if beta == 1 else beta * start)


_PLAIN = {
    aten.mm.default: aten.mm.default,
    aten.bmm.default: aten.bmm.default,
    aten.mv.default: aten.mv.default,
    aten.dot.default: aten.dot.default,
}
_ADDED = {
    aten.addmm.default: aten.mm.default,
    aten.baddbmm.default: aten.bmm.default,
    aten.addmv.default: aten.mv.default,
}
_WRITTEN = {aten.mm.out: aten.mm.default, aten.bmm.out: aten.bmm.default}


class ReorderedProducts(TorchDispatchMode):
    """While it is entered, matrix products of torch are added up in another order.

    A test that passes with and without it does not hang on the order, and so neither on the
    processor. Products of other processes and of NumPy stay as they are.
    """

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        if func in _PLAIN:
            return _begun_elsewhere(*args, product=_PLAIN[func])
        if func in _ADDED:
            beta, alpha = kwargs.get("beta", 1), kwargs.get("alpha", 1)
            return _added(*args, product=_ADDED[func], beta=beta, alpha=alpha)
        if func in _WRITTEN:
            return kwargs["out"].copy_(_begun_elsewhere(*args, product=_WRITTEN[func]))
        if torch.is_inference_mode_enabled() and func is not aten.detach.default:
            # There composite functions come whole: their products are found by taking them apart.
            with self:
                parts = func.decompose(*args, **kwargs)
            if parts is not NotImplemented:
                return parts
        return func(*args, **kwargs)


def reordered() -> bool:
    """Whether these tests are of the machine whose products are reordered."""
    return bool(os.environ.get(VARIABLE))


def reorder_all_products() -> None:
    """Enter `ReorderedProducts` for good, in this thread and in all that start from now on."""
    run = threading.Thread.run

    def run_reordered(thread: threading.Thread) -> None:
        with ReorderedProducts():
            run(thread)

    threading.Thread.run = run_reordered  # type: ignore[method-assign]
    ReorderedProducts().__enter__()
