"""Tensors of a file by name, each taken with the shape that it must have, and none left over."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor, nn

from splatseg.errors import FileFormatError, brief

COUNTER = "num_batches_tracked"
"""Steps that a batch norm saw, which nothing depends on."""

M = TypeVar("M", bound=nn.Module)


class TensorTable:
    """What a file holds.

    Args:
        tensors: By name.
        path: The file, which messages begin with.
    """

    def __init__(self, tensors: Mapping[str, Tensor], path: Path) -> None:
        self._tensors = tensors
        self._path = path
        self._taken: set[str] = set()

    def __contains__(self, name: str) -> bool:
        return name in self._tensors

    def names(self) -> tuple[str, ...]:
        """All names, in the order of the file."""
        return tuple(self._tensors)

    def matrix_shape(self, name: str) -> tuple[int, int]:
        """Rows and columns of a matrix, further sides of 1 left out.

        Raises:
            FileFormatError: If it is missing or no matrix.
        """
        shape = tuple(self._found(name, "a matrix").shape)
        if len(shape) < 2 or any(side != 1 for side in shape[2:]):
            raise self._error(name, "a matrix", f"shape {shape}")
        return shape[0], shape[1]

    def take(self, name: str, shape: Sequence[int]) -> Tensor:
        """A copy of a tensor as float32, further sides of 1 (those of a convolution) left out.

        Raises:
            FileFormatError: If it is missing, has another shape, or values that are not finite.
        """
        wanted = tuple(shape)
        tensor = self._found(name, f"shape {wanted}")
        got, rest = tuple(tensor.shape[: len(wanted)]), tensor.shape[len(wanted) :]
        if got != wanted or any(side != 1 for side in rest):
            raise self._error(name, f"shape {wanted}", str(tuple(tensor.shape)))
        if not tensor.is_floating_point():
            raise self._error(name, "floating-point numbers", str(tensor.dtype))
        values = tensor.detach().to(torch.float32, copy=True).reshape(wanted)
        if not bool(torch.isfinite(values).all()):
            raise self._error(name, "finite numbers", "NaN or infinite ones")
        self._taken.add(name)
        return values

    def take_variances(self, name: str, count: int) -> Tensor:
        """The same of variances.

        Raises:
            FileFormatError: If one is negative, besides what `take` raises.
        """
        values = self.take(name, (count,))
        if bool((values < 0).any()):
            raise self._error(name, "variances of 0 or more", f"{float(values.min()):g}")
        return values

    def leave(self, *names: str) -> None:
        """Allow tensors that are of no use."""
        self._taken |= set(names)

    def check_none_left(self, ignored: Sequence[str]) -> None:
        """Refuse tensors that were neither taken nor left.

        Args:
            ignored: What names begin with that are no concern of the encoder.

        Raises:
            FileFormatError: If there is one.
        """
        for name in self._tensors:
            if name not in self._taken and not name.startswith(tuple(ignored)):
                got = f"one of shape {tuple(self._tensors[name].shape)}"
                raise self._error(name, "no tensor of this name in such a network", got)

    def _found(self, name: str, expected: str) -> Tensor:
        tensor = self._tensors.get(name)
        if tensor is None:
            raise self._error(name, expected, "no such tensor")
        return tensor

    def _error(self, name: str, expected: str, got: str) -> FileFormatError:
        return FileFormatError(f"{self._path}: {brief(name)}: expected {expected}, got {got}.")


def with_state(module: M, state: Mapping[str, Tensor]) -> M:
    """A network that was made without memory (on ``meta``), with a tensor for each of its names."""
    module.load_state_dict(dict(state), strict=True, assign=True)
    return module
