"""The library transformers, imported so that a broken torchvision does no harm; its networks."""

import importlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any, cast

from splatseg.core.models import Model
from splatseg.errors import FileFormatError, MissingPackageError
from splatseg.io.json_files import read_json
from splatseg.models._family import Checkpoint, Loading, ModelFamily
from splatseg.models._sources import What

_SOME = 3

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
    """The weights' config.json, of one of these kinds.

    Args:
        place: The weights.
        kinds: Values of ``model_type`` that are taken.

    Raises:
        FileFormatError: If the weights are of another network.
    """
    path = place.folder / "config.json"
    content = read_json(path)
    kind = content.get("model_type")
    if kind not in kinds:
        raise FileFormatError(
            f"{path}: expected weights of {' or '.join(kinds)}, got those of {kind!r:.60}."
        )
    return content


def network(place: Loading, class_name: str, *, unused: Sequence[str] = (), **options: Any) -> Any:
    """A network with its weights, in evaluation mode, where it is to run.

    Args:
        place: The weights.
        class_name: The class of the library.
        unused: How the names of tensors begin that the class has and no answer needs; published
            weights may lack them.
        options: For its configuration.

    Raises:
        FileFormatError: If the weights are broken, or lack tensors of the network.
    """
    cls = getattr(library(), class_name)
    broken = importlib.import_module("safetensors").SafetensorError
    logger = library().utils.logging
    before, bars = logger.get_verbosity(), logger.is_progress_bar_enabled()
    logger.set_verbosity_error()  # what is missing is an error below, and nothing else is news
    logger.disable_progress_bar()
    try:
        made, about = cls.from_pretrained(
            place.folder, dtype=place.dtype, local_files_only=True, output_loading_info=True,
            **options,
        )  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, broken) as error:
        words = str(error).strip().splitlines()
        raise FileFormatError(
            f"{place.folder}: the weights cannot be loaded as {class_name} "
            f"({words[0][:160] if words else type(error).__name__})."
        ) from error
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
    return made.to(place.device).eval()


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
