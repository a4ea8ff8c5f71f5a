"""State of a fit between two steps: tensors by name, and numbers in JSON."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from splatseg.errors import FileFormatError
from splatseg.fit._parameters import Parameters


class StatefulModule(Protocol):
    """A module of a fit with state: exposures, refined poses, densification statistics.

    A resumed fit equals an uninterrupted one only if `state` is complete.
    """

    def state(self) -> dict[str, Tensor]:
        """Its tensors by name. The names do not change."""
        ...

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Restore what `state` returned. The tensors are on the fit's device and may be kept."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitState:
    """State of a fit between two steps."""

    tensors: Mapping[str, Tensor]
    """By name, groups separated by slashes."""

    content: Mapping[str, Any]
    """Everything else, in values that JSON holds."""

    where: str = "fit"
    """The file that it was read from, for messages."""

    def group(
        self, name: str, expected: Iterable[str], *, device: torch.device
    ) -> dict[str, Tensor]:
        """The tensors under ``name/`` without that prefix, on a device.

        Raises:
            FileFormatError: If their names are not the expected ones.
        """
        prefix = f"{name}/"
        found = {
            key.removeprefix(prefix): tensor.to(device)
            for key, tensor in self.tensors.items()
            if key.startswith(prefix)
        }
        wanted = sorted(expected)
        if sorted(found) != wanted:
            raise FileFormatError(
                f"{self.where}: expected {', '.join(wanted) or 'nothing'} in {name}, "
                f"got {', '.join(sorted(found)) or 'nothing'}."
            )
        return found

    def tensor(self, name: str) -> Tensor:
        """One tensor.

        Raises:
            FileFormatError: If it is missing.
        """
        if name not in self.tensors:
            raise FileFormatError(f"{self.where}: expected a tensor {name!r}, got none.")
        return self.tensors[name]

    def number(self, name: str) -> float:
        """A number of the content.

        Raises:
            FileFormatError: If it is missing, or not a number.
        """
        value = self.content.get(name)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise FileFormatError(f"{self.where}: expected a number {name!r}, got {value!r:.40}.")
        return value


def named(group: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors under ``group/``, on the CPU."""
    return {f"{group}/{name}": tensor.detach().cpu() for name, tensor in tensors.items()}


def parameters_of(state: FitState, group: str, device: torch.device) -> Parameters:
    """Parameters or moments of a state.

    Raises:
        FileFormatError: If their shapes do not agree.
    """
    widths = {"means": 3, "log_scales": 3, "rotations": 4, "logits": 1, "sh": None}
    tensors = state.group(group, widths, device=device)
    count = tensors["means"].shape[0] if tensors["means"].ndim else 0
    for name, width in widths.items():
        tensor = tensors[name]
        fits = tensor.ndim == 2 and tensor.shape[0] == count and width in (None, tensor.shape[1])
        if not fits or tensor.dtype != torch.float32:
            raise FileFormatError(
                f"{state.where}: expected {group}/{name} of type float32 and shape "
                f"({count}, {width or 'any'}), got {tensor.dtype} of {tuple(tensor.shape)}."
            )
    return Parameters(**tensors)
