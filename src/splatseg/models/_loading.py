"""From what is asked for to weights on this machine, a device and a precision."""

from collections.abc import Callable
from dataclasses import replace

import torch

from splatseg.errors import BackendError, InputError
from splatseg.models._family import Loading, LoadOptions, ModelFamily
from splatseg.models._weights import digest_of, find_weights

_TYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}


def loading_of(
    family: ModelFamily,
    options: LoadOptions,
    *,
    report: Callable[[str], None],
    flag: str = "--weights",
) -> Loading:
    """The weights of a model, found or fetched, and where it is to run.

    Args:
        family: The model's family.
        options: Which weights, and where and how they run.
        report: Told in a sentence what the user should know.
        flag: Where the weights are named, for the sentence that they are not there.

    Raises:
        BackendError: If there is no such device.
        InputError: If it is no device at all.
        MissingFileError: If the weights are not on this machine and are not to be fetched.
    """
    device = _device(options.device)
    found, name = find_weights(family, options, report=report, flag=flag)
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
        download=options.download,
    )


def second_loading(
    family: ModelFamily, weights: str | None, place: Loading, *, flag: str
) -> Loading:
    """The weights of a second network of a model, found by the same rules as those of the first.

    Args:
        family: The second network's family.
        weights: Folder or id of its weights; None takes the default of its family.
        place: The first network's; the second runs there and in the same precision.
        flag: Where the weights are named.

    Raises:
        MissingFileError: If they are not on this machine and are not to be fetched.
        InputError: If what is named is neither a folder nor an id.
    """
    return replace(
        loading_of(
            family,
            LoadOptions(
                weights=weights,
                download=place.download,
                device=str(place.device),
                batch=place.batch,
            ),
            report=place.report,
            flag=flag,
        ),
        dtype=place.dtype,
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
