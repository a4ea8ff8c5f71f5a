"""All that a fit remembers between two steps, as tensors by name and numbers for JSON."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from splatseg.errors import FileFormatError
from splatseg.fit._parameters import Parameters


class Part(Protocol):
    """Something of a fit that remembers: exposures, pose corrections, statistics.

    What is not in `state` is lost when a fit is resumed, and the resumed fit then differs.
    """

    def state(self) -> dict[str, Tensor]:
        """Everything it remembers, by name. The names are always the same ones."""
        ...

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Go on from what `state` gave. The tensors are on the fit's device, and its own now."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitState:
    """State of a fit between two steps."""

    tensors: Mapping[str, Tensor]
    """By name, parts of a name divided by slashes."""

    content: Mapping[str, Any]
    """The rest; JSON holds it."""

    where: str = "fit"
    """What it was read from: messages begin with it."""

    def group(
        self, name: str, expected: Iterable[str], *, device: torch.device
    ) -> dict[str, Tensor]:
        """The tensors under ``name/`` without that prefix, on a device.

        Raises:
            FileFormatError: If they are others than expected.
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
            FileFormatError: If it is not there.
        """
        if name not in self.tensors:
            raise FileFormatError(f"{self.where}: expected a tensor {name!r}, got none.")
        return self.tensors[name]

    def number(self, name: str) -> float:
        """A number of the content.

        Raises:
            FileFormatError: If it is not there, or no number.
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
        FileFormatError: If their shapes do not fit each other.
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
