"""From what is asked for to weights on this machine, a device and a precision."""

from collections.abc import Callable

import torch

from splatseg.errors import BackendError, InputError
from splatseg.models._family import Loading, LoadOptions, ModelFamily
from splatseg.models._weights import digest_of, find_weights

_TYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}


def loading_of(
    family: ModelFamily, options: LoadOptions, *, report: Callable[[str], None]
) -> Loading:
    """The weights of a model, found or fetched, and where it is to run.

    Raises:
        BackendError: If there is no such device.
        InputError: If it is no device at all.
        MissingFileError: If the weights are not on this machine and are not to be fetched.
    """
    device = _device(options.device)
    found, name = find_weights(family, options, report=report)
    return Loading(
        folder=found.parent if family.single_file else found,
        file=found if family.single_file else None,
        name=name,
        digest=digest_of(found),
        device=device,
        dtype=_TYPES[options.dtype],
        batch=options.batch,
        size=options.size,
        report=report,
    )


def _device(name: str) -> torch.device:
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise InputError(f"device: expected cpu, cuda or cuda:N, got {name!r:.40}.") from error
    if device.type not in ("cpu", "cuda"):
        raise InputError(f"device: expected cpu, cuda or cuda:N, got {name!r:.40}.")
    count = torch.cuda.device_count()
    if device.type == "cuda" and (device.index or 0) >= count:
        raise BackendError(f"device: expected one of {count} GPUs that PyTorch sees, got {name}.")
    return device
