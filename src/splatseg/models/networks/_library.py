"""The library transformers, imported so that a broken torchvision does no harm; its networks."""

import copy
import functools
import importlib
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Generic, Literal, TypeVar, cast

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core.models import Image
from splatseg.errors import (
    FileFormatError,
    RangeError,
    SplatsegError,
    import_package,
    quoted,
    reason,
)
from splatseg.models._images import (
    Frame,
    LastImages,
    Normalisation,
    is_lack_of_memory,
    network_input,
)
from splatseg.models._weights import Loading, weight_files
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
    return import_package("transformers", "this model", "models")


def configuration(place: Loading, kinds: Sequence[str]) -> dict[str, Any]:
    """What the weights' config.json says, of one of these values of ``model_type``."""
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
    for part in made.modules():
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
        except (
            RuntimeError, ValueError, TypeError, ArithmeticError, LookupError, AttributeError,
        ) as error:  # fmt: skip
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
    """A side in pixels, or the larger of two, out of the configuration of weights in a folder."""
    sides = cast("Sequence[object]", value) if isinstance(value, list | tuple) else [value]
    whole = [side for side in sides if isinstance(side, int) and side > 0]
    if not whole or len(whole) < len(sides):
        raise FileFormatError(
            f"{folder / 'config.json'}: expected sides in pixels, got {quoted(value)}."
        )
    return max(whole)


class NetworkModel:
    """What adapters of networks have in common: name, note and settings.

    Args:
        name: Name of the family.
        options: Its options.
        place: The weights, and where the network runs.
    """

    _unrecorded: ClassVar[tuple[str, ...]] = ()
    """Names of options that change no answer."""

    _constants: ClassVar[Mapping[str, Any]] = {}
    """Settings that were options once. They are recorded, so that work of then can go on."""

    _normalisation: Normalisation
    _input_size: int = 0
    """Side of the input, pixels, as it is recorded; 0 where the weights say it of each image."""

    _more_settings: Mapping[str, Any] = MappingProxyType({})
    """What else changes the answers, such as the tokenizer's digest."""

    def __init__(self, name: str, options: Any, place: Loading) -> None:
        self.name = name
        self.note = f"weights {place.name}"
        self._options = options
        self._place = place

    @property
    def settings(self) -> Mapping[str, Any]:
        """Options, weights, precision and size of the input."""
        return self.settings_of(self._options)

    @property
    def default_settings(self) -> Mapping[str, Any]:
        """The same with default options."""
        return self.settings_of(type(self._options)())

    def settings_of(self, options: Any) -> Mapping[str, Any]:
        """What changes the answers, with other options."""
        chosen = {
            name: value for name, value in asdict(options).items() if name not in self._unrecorded
        }
        return {
            **self._constants,
            **chosen,
            "weights": self._place.digest,
            "dtype": str(self._place.dtype).removeprefix("torch."),
            "size": self._input_size,
            **self._more_settings,
        }

    def _check_size(self, size: int) -> None:
        """Refuse another size than the only one that a network takes."""
        if self._place.size not in (None, size):
            raise RangeError(
                f"size: {self._place.name} takes {size} alone, got {self._place.size}."
            )

    def _input(
        self,
        images: Sequence[Image],
        frame: Frame,
        *,
        mode: Literal["bilinear", "bicubic"] = "bilinear",
        padding: Literal["mean", "black"] = "mean",
    ) -> Float[Tensor, "images 3 height width"]:
        """`network_input`, where the network runs and in its precision."""
        place = self._place
        return network_input(
            images, frame, self._normalisation,
            device=place.device, dtype=place.dtype, mode=mode, padding=padding,
        )  # fmt: skip


_A = TypeVar("_A")


class BatchedNetwork(NetworkModel, ABC, Generic[_A]):
    """A network that sees several images at once, and keeps what it made of the last ones."""

    _resizable: ClassVar[bool] = True
    """Whether it takes inputs of another size."""

    def __init__(self, name: str, options: Any, place: Loading) -> None:
        super().__init__(name, options, place)
        self.batch_size = place.images_together
        self._last = LastImages[_A](self._encode, resizable=self._resizable)

    def encode(self, images: Sequence[Image]) -> None:
        """Pass images of one size through the network at once."""
        self._last.encode(images)

    @abstractmethod
    def _encode(self, images: Sequence[Image]) -> Sequence[_A]:
        """What the network makes of images of one size."""
