"""Checkpoints of encoders: our own files, and those of Open3D-ML.

Our own say in the header of safetensors, as text, what they are.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import torch
from torch import Tensor

from splatseg.core import JSON
from splatseg.core.boundary import boundary
from splatseg.errors import FileFormatError, MissingFileError, quoted
from splatseg.io.foreign import is_file
from splatseg.io.json_files import parse_object
from splatseg.io.schema import structured
from splatseg.io.tensor_table import COUNTER, TensorTable, with_state
from splatseg.io.tensors import read_safetensors, read_tensors, read_torch_file
from splatseg.methods.cosseg.foreign import COLOUR_INPUTS, PLAIN_INPUTS, open3d_encoder
from splatseg.methods.cosseg.network import RandlaEncoder
from splatseg.methods.cosseg.pyramid import PointInputs, RandlaConfig

FORMAT = "splatseg.point_network"
VERSION = "1"


@dataclass(frozen=True, slots=True, kw_only=True)
class About:
    """The facts of a checkpoint."""

    part: Literal["encoder"]
    """What its tensors are."""

    config: RandlaConfig
    """The network's shape."""

    inputs: PointInputs
    """How it is fed."""

    recipe: dict[str, Any]
    """How it was trained, in words and numbers of whoever trained it."""


def parse_about(metadata: Mapping[str, str], path: Path) -> About | None:
    """The facts of a file, None if it is not ours.

    Raises:
        FileFormatError: If it is, and they cannot be read.
    """
    if metadata.get("format") != FORMAT:
        return None
    if metadata.get("version") != VERSION:
        raise FileFormatError(
            f"{path}: expected version {VERSION} of {FORMAT}, "
            f"got {quoted(metadata.get('version'))}; a newer splatseg may read it."
        )
    where = f"{path}: about"
    content = parse_object(metadata.get("about", ""), where=where)
    config = content.get("config")
    if isinstance(config, dict) and "variant" in config:  # as version 0.1 wrote it
        own = structured(config["variant"], _Variant, where=f"{where}: config.variant")
        content["config"] = {**config, "sum_slope": own.sum_slope}
    return structured(content, About, where=where)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Variant:
    """What version 0.1 knew of other implementations; of these, one is left."""

    distance: Literal["euclidean"]
    second_encoding: Literal["chained"]
    paired_features: Literal["neighbour"]
    sampling: Literal["max"]
    sum_slope: float


SHIPPED = Path(__file__).parent / "weights" / "randla.safetensors"
"""The encoder that comes with the package."""

_STATES = ("model_state_dict", "state_dict")
_PARALLEL = "module."


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointEncoder:
    """A frozen encoder, and how it is to be fed."""

    encoder: RandlaEncoder
    """It evaluates and has no gradients."""

    inputs: PointInputs
    """Unit, origin and range of colours that it was trained on."""

    source: str
    """The file's name."""

    layout: str
    """Whose file it is: ``splatseg`` or ``open3d``."""

    recipe: Mapping[str, JSON]
    """How it was trained, as far as the file says."""

    assumed: tuple[str, ...]
    """What the file does not say, and was taken from the public configurations."""

    @property
    def trained_on(self) -> str:
        """In words, what the network was trained on, so that ours is not taken for a published one.

        Example:
            >>> load_point_encoder().trained_on
            '120 generated rooms and 24 generated streets, 5500 steps; not S3DIS'
        """
        recipe = self.recipe.get("recipe")
        facts = recipe if isinstance(recipe, Mapping) else {}
        rooms, streets = facts.get("rooms"), facts.get("streets")
        steps = [facts.get(name) for name in ("steps", "settling_steps")]
        if not (isinstance(rooms, int) and isinstance(streets, int)):
            return "what the file does not say"
        total = sum(one for one in steps if isinstance(one, int))
        return f"{rooms} generated rooms and {streets} generated streets, {total} steps; not S3DIS"

    @property
    def config(self) -> RandlaConfig:
        """Its shape."""
        return self.encoder.config

    @property
    def colour(self) -> bool:
        """Whether it takes red, green and blue."""
        return self.config.colour


@boundary
def load_point_encoder(
    path: Path | None = None, *, inputs: PointInputs | None = None
) -> PointEncoder:
    """An encoder from a checkpoint.

    Read are our own files, and tensors of Open3D-ML's RandLA-Net as ``torch.save`` or safetensors
    wrote them, of which nothing is run. Tensors of decoder and head are not looked at.

    Args:
        path: The file; None is the one that comes with the package.
        inputs: How the network was fed, where a file of others is of a network that was not
            trained as its public configuration says: those files hold nothing of it.

    Raises:
        MissingFileError: If there is no such file, or none came with the package.
        FileFormatError: If it is damaged, another network's, or a tensor is missing, has another
            shape or does not belong to it.
    """
    if path is None and not is_file(SHIPPED):
        raise MissingFileError(
            f"{SHIPPED.name}: this installation has no weights of a point network; give the file "
            "of a checkpoint: one of Open3D-ML's RandLA-Net, or of scripts/train_point_network."
        )
    file = SHIPPED if path is None else path
    tensors, about = _read(file)
    if about is not None:
        table = TensorTable(tensors, file)
        encoder = _restored(about.config, table)
        table.check_none_left(())
        layout, recipe, assumed, fed = "splatseg", about.recipe, (), about.inputs
    else:
        encoder = open3d_encoder(tensors, file)
        layout, recipe, assumed = "open3d", {}, ("neighbours", "ratios")
        fed = COLOUR_INPUTS if encoder.config.colour else PLAIN_INPUTS
        assumed += ("inputs",) if inputs is None else ()
    return PointEncoder(
        encoder=encoder.eval().requires_grad_(requires_grad=False),
        inputs=fed if inputs is None else inputs,
        source=file.name,
        layout=layout,
        recipe=recipe,
        assumed=assumed,
    )


def _read(path: Path) -> tuple[Mapping[str, Tensor], About | None]:
    """Tensors of a file by name, and the facts of it if it is ours."""
    if path.suffix == ".safetensors":
        tensors, metadata = read_safetensors(path)
        about = parse_about(metadata, path)
        return (tensors if about is not None else _single(tensors)), about
    if path.suffix == ".npz":
        return _single(read_tensors(path)), None
    content = read_torch_file(path)
    for key in _STATES:
        if isinstance(content, Mapping) and key in content:
            content = cast(Mapping[object, object], content)[key]
            break
    named = cast(Mapping[object, object], content) if isinstance(content, Mapping) else {}
    found = {str(name): value for name, value in named.items() if isinstance(value, Tensor)}
    if not found:
        raise FileFormatError(f"{path}: expected tensors by name or a state_dict, got none.")
    return _single(found), None


def _single(tensors: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """Tensors without the name that networks on several GPUs have before theirs."""
    if not all(name.startswith(_PARALLEL) for name in tensors):
        return tensors
    return {name.removeprefix(_PARALLEL): tensor for name, tensor in tensors.items()}


def _restored(config: RandlaConfig, table: TensorTable) -> RandlaEncoder:
    with torch.device("meta"):
        module = RandlaEncoder(config)
    state: dict[str, Tensor] = {}
    for name, wanted in module.state_dict().items():
        if name.endswith(COUNTER):
            state[name] = torch.zeros((), dtype=torch.int64)
        elif name.endswith("running_var"):
            state[name] = table.take_variances(name, len(wanted))
        else:
            state[name] = table.take(name, wanted.shape)
    return with_state(module, state)
