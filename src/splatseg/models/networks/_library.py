"""The library transformers, imported so that a broken torchvision does no harm; its networks."""

import copy
import functools
import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import torch

from splatseg.core.models import Model
from splatseg.errors import (
    FileFormatError,
    MissingPackageError,
    SplatsegError,
    quoted,
    reason,
)
from splatseg.models._encoded import is_lack_of_memory
from splatseg.models._family import Checkpoint, Loading, ModelFamily
from splatseg.models._sources import What
from splatseg.models._weights import weight_files
from splatseg.models.networks._config import (
    checked_config,
    library_config,
    offline,
    refused_by_library,
)

_SOME = 3
_FREE = 1 << 24
"""Numbers that a network may have besides its weights: tables of positions and the like."""

_UNNEEDED = "torchvision"


def library() -> Any:
    """The module ``transformers``.

    A torchvision that cannot be imported, as one that is of another build than torch, is hidden
    from it: it looks only whether there is one, and then fails at every model.

    Raises:
        MissingPackageError: If it is not installed, or too old.
    """
    if _UNNEEDED not in sys.modules:
        try:
            importlib.import_module(_UNNEEDED)
        except (ImportError, RuntimeError, OSError):
            sys.modules[_UNNEEDED] = cast(Any, None)
    try:
        return importlib.import_module("transformers")
    except ImportError as error:
        raise MissingPackageError(
            "this model needs a package that is not installed (transformers). "
            "Try: pip install 'splatseg[models]'."
        ) from error


def configuration(place: Loading, kinds: Sequence[str]) -> dict[str, Any]:
    """What the weights' config.json says, of one of these kinds; see `checked_config`.

    Args:
        place: The weights.
        kinds: Values of ``model_type`` that are taken.

    Raises:
        FileFormatError: If the weights are of another network, or their file says what none may.
    """
    library()
    return checked_config(place.folder / "config.json", tuple(kinds))


def network(
    place: Loading,
    class_name: str,
    content: Mapping[str, Any],
    *,
    unused: Sequence[str] = (),
    **options: Any,
) -> Any:
    """A network with its weights, in evaluation mode, where it is to run.

    Args:
        place: The weights.
        class_name: The class of the library.
        content: What `configuration` gives.
        unused: How the names of tensors begin that the class has and no answer needs; published
            weights may lack them.
        options: For its configuration.

    Raises:
        FileFormatError: If the weights are broken, or lack tensors of the network.
    """
    cls = getattr(library(), class_name)
    path = place.folder / "config.json"
    logger = library().utils.logging
    before, bars = logger.get_verbosity(), logger.is_progress_bar_enabled()
    logger.set_verbosity_error()  # what is missing is an error below, and nothing else is news
    logger.disable_progress_bar()
    try:
        config, rest = library_config(path, content, cls, **options)
        _check_size(place, path, cls, config, rest)
        with offline(), refused_by_library(place.folder, f"weights of {class_name}"):
            made, about = cls.from_pretrained(
                place.folder, config=config, dtype=place.dtype, local_files_only=True,
                output_loading_info=True, **rest,
            )  # fmt: skip
    finally:
        logger.set_verbosity(before)
        if bars:
            logger.enable_progress_bar()
    lacking = [str(key) for key in (*about["missing_keys"], *about["mismatched_keys"])]
    lacking = [key for key in lacking if not key.startswith(tuple(unused))]
    if lacking:
        more = ", ..." if len(lacking) > _SOME else ""
        raise FileFormatError(
            f"{place.folder}: expected all weights of {class_name}, got none or others for "
            f"{len(lacking)} of its tensors ({', '.join(sorted(lacking)[:_SOME])}{more})."
        )
    for part in (made, *made.children()):
        part.forward = answering(place.folder, part.forward)
    return made.to(place.device).eval()


def answering(folder: Path, forward: Callable[..., Any]) -> Callable[..., Any]:
    """A pass through a network, or a part of it, that says why it fails.

    Sizes that fit the weights may not fit each other, such as steps that leave nothing of an image.
    """

    @functools.wraps(forward)
    def answer(*words: Any, **more: Any) -> Any:
        try:
            return forward(*words, **more)
        except SplatsegError:
            raise
        except (RuntimeError, ValueError, TypeError, ArithmeticError, LookupError) as error:
            if is_lack_of_memory(error) or "CUDA" in str(error):
                raise
            raise FileFormatError(
                f"{folder}: expected a network that takes an image as its configuration says, but "
                f"it fails ({reason(error)})."
            ) from error

    return answer


def _check_size(
    place: Loading, path: Path, cls: Any, config: Any, options: Mapping[str, Any]
) -> None:
    """Refuse a network with more numbers than its weights have bytes, before any is allocated."""
    options = {name: value for name, value in options.items() if name != "key_mapping"}
    with refused_by_library(path, f"a configuration of {cls.__name__}"), torch.device("meta"):
        made = cls(copy.deepcopy(config), **options)
    most = sum(one.stat().st_size for one in weight_files(place.folder)) + _FREE
    count = sum(one.numel() for one in (*made.parameters(), *made.buffers()))
    if count > most:
        raise FileFormatError(
            f"{path}: expected a network of the size of its weights, got one of {count} numbers "
            f"for {most - _FREE} bytes."
        )


def side_of(folder: Path, value: object) -> int:
    """A side in pixels of what a network takes, or of its patches, out of its configuration.

    Args:
        folder: The weights.
        value: One number, or those of rows and columns, of which the larger counts.

    Raises:
        FileFormatError: If it is none above 0.
    """
    sides = cast("Sequence[object]", value) if isinstance(value, list | tuple) else [value]
    whole = [side for side in sides if isinstance(side, int) and side > 0]
    if not whole or len(whole) < len(sides):
        raise FileFormatError(
            f"{folder / 'config.json'}: expected sides in pixels, got {quoted(value)}."
        )
    return max(whole)


def network_family(
    name: str,
    summary: str,
    *checkpoints: Checkpoint,
    reference: str,
    gives: tuple[What, ...],
    options: type[Any],
    make: Callable[[str, Any, Loading], Model],
) -> ModelFamily:
    """A family of networks of this library.

    Args:
        name: As it is asked for.
        summary: One line.
        checkpoints: Published weights, the default first.
        reference: The paper.
        gives: What such a model can be asked for.
        options: Dataclass of its options.
        make: Makes the model of the family's name, options and weights.
    """
    return ModelFamily(
        name=name,
        summary=summary,
        reference=reference,
        gives=gives,
        options=options,
        load=lambda chosen, place: make(name, chosen, cast(Loading, place)),
        checkpoints=checkpoints,
        packages=("transformers",),
    )


def settings_of(
    options: Any, place: Loading, *, size: int, unrecorded: Sequence[str] = ()
) -> dict[str, Any]:
    """What changes a network's answers: its options, weights, precision and size of the input.

    Args:
        options: The dataclass of its options.
        place: The weights.
        size: Side of the input, pixels.
        unrecorded: Names of options that change no answer.
    """
    chosen = {name: value for name, value in asdict(options).items() if name not in unrecorded}
    return chosen | {
        "weights": place.digest,
        "dtype": str(place.dtype).removeprefix("torch."),
        "size": size,
    }
