"""A family of 2D models: what its options are, which weights it takes, how one of it is loaded.

Nothing is imported or read to know a family; `ModelFamily.load` does that.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from splatseg.core.boundary import convert_fields
from splatseg.core.models import Model
from splatseg.errors import RangeError
from splatseg.models._sources import What

if TYPE_CHECKING:
    import torch

_GPU_BATCH = 16

Precision = Literal["float32", "float16", "bfloat16"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Checkpoint:
    """Weights that somebody published, on the Hugging Face hub or elsewhere."""

    id: str
    """OWNER/NAME on the hub; the name of the file elsewhere."""

    megabytes: int
    """What is fetched, MB; of weights elsewhere, what of them is used."""

    licence: str
    """As the model card names it."""

    note: str = ""
    """What else one should know, such as that access must be asked for, or where the file is."""

    on_hub: bool = True
    """Whether the hub has them; nothing is fetched from elsewhere."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadOptions:
    """Which weights a model gets, and where and how it runs."""

    weights: str | None = None
    """Folder of the weights, or their id on the Hugging Face hub, of which only what is on this
    machine is taken; a file where a model's weights are one. None takes the default of the
    model."""

    download: bool = False
    """Fetch weights from the hub that are not on this machine; what and how much is said before."""

    device: str = "auto"
    """Where the network runs: cpu, cuda, cuda:1. auto takes cuda where there is one."""

    dtype: Precision = "float32"
    """Precision of the network."""

    batch: int | None = None
    """Images that pass the network together. None takes one on a CPU and as many as memory holds
    on a GPU. Changes time, and answers by rounding at most."""

    size: int | None = None
    """Side of the image that the network sees, pixels: the longer one, or both where the network
    takes squares. None takes what the weights were made for."""

    def __post_init__(self) -> None:
        convert_fields(self)
        for name in ("batch", "size"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise RangeError(f"{name}: expected 1 or more, got {value}.")


@dataclass(frozen=True, slots=True, kw_only=True)
class Loading:
    """Weights that are on this machine, and where the network is to run."""

    folder: Path
    """Folder of the weights."""

    name: str
    """What they are called: an id of the hub, or the name of the folder."""

    digest: str
    """SHA-256 of configuration and weights."""

    device: "torch.device"
    dtype: "torch.dtype"
    batch: int | None
    size: int | None
    report: Callable[[str], None]
    """Told in a sentence what the user should know."""

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
    """Models that are loaded in the same way and asked the same."""

    name: str
    """As `see --model NAME` asks for it."""

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

    packages: tuple[str, ...] = field(default=())
    """What must be installed besides splatseg."""

    single_file: bool = False
    """Weights are one file in a layout of its own, without config.json; `Loading.file` is it."""

    instead: str = ""
    """What serves where its weights are not to be had; a clause, lower case."""

    @property
    def needs_weights(self) -> bool:
        """Whether a model of it has weights."""
        return bool(self.checkpoints)
