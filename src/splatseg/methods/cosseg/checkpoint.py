"""Checkpoints of encoders and of whole networks: our own files, and those of others.

Our own say in the header of safetensors, as text, what they are.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import torch
from torch import Tensor, nn

from splatseg.core import JSON
from splatseg.core.boundary import boundary
from splatseg.core.json_values import plain_object
from splatseg.errors import FileFormatError, InputError, MissingFileError, quoted
from splatseg.io.foreign import is_file
from splatseg.io.json_files import json_text, parse_object
from splatseg.io.schema import structured
from splatseg.io.tensor_table import COUNTER, TensorTable, with_state
from splatseg.io.tensors import read_safetensors, read_tensors, read_torch_file, write_tensors
from splatseg.methods.cosseg.foreign import foreign_encoder, layout_of
from splatseg.methods.cosseg.network import RandlaEncoder, RandlaNet
from splatseg.methods.cosseg.pyramid import PointInputs, RandlaConfig

Part = Literal["encoder", "network"]
FORMAT = "splatseg.point_network"
VERSION = "1"


@dataclass(frozen=True, slots=True, kw_only=True)
class About:
    """The facts of a checkpoint."""

    part: Part
    """What its tensors are: an encoder, or a network with decoder and head."""

    config: RandlaConfig
    """The network's shape."""

    inputs: PointInputs
    """How it is fed."""

    recipe: dict[str, Any]
    """How it was trained, in words and numbers of whoever trained it."""

    def metadata(self) -> dict[str, str]:
        """Text for the header of a file."""
        content = {
            "part": self.part,
            "config": asdict(self.config),
            "inputs": asdict(self.inputs),
            "recipe": self.recipe,
        }
        return {"format": FORMAT, "version": VERSION, "about": json_text("facts", content)}


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
    return structured(parse_object(metadata.get("about", ""), where=where), About, where=where)


SHIPPED = Path(__file__).parent / "weights" / "randla.safetensors"
"""The encoder that comes with the package."""

M = TypeVar("M", RandlaEncoder, RandlaNet)
_DECODER = ("middle.", "steps.", "head.")
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
    """Whose file it is: ``splatseg``, or a name of `layouts`."""

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
    """An encoder from a checkpoint; where that is of a whole network, of its encoder.

    Read are files of `save_point_encoder` and `save_point_network`, and tensors of other
    implementations (see `layouts`) as ``torch.save`` or safetensors wrote them, of which nothing
    is run. Tensors of decoder and head are not looked at.

    Args:
        path: The file; None is the one that comes with the package.
        inputs: How the network was fed, where a file of others is of a network that was not
            trained as its public configuration says: those files hold nothing of it.

    Raises:
        MissingFileError: If there is no such file, or none came with the package.
        FileFormatError: If it is damaged, of an unknown layout, or a tensor is missing, has
            another shape or does not belong to it.
    """
    if path is None and not is_file(SHIPPED):
        raise MissingFileError(
            f"{SHIPPED.name}: this installation has no weights of a point network; give the file "
            "of a checkpoint: one of Open3D-ML's RandLA-Net, or of save_point_encoder."
        )
    file = SHIPPED if path is None else path
    tensors, about = _read(file)
    if about is not None:
        table = TensorTable(tensors, file)
        prefix = "encoder." if about.part == "network" else ""
        encoder = _restored(RandlaEncoder, about.config, table, prefix)
        table.check_none_left(_DECODER if about.part == "network" else ())
        layout, recipe, assumed, fed = "splatseg", about.recipe, (), about.inputs
    else:
        found = layout_of(tensors, file)
        encoder = foreign_encoder(tensors, file, found)
        layout, recipe, assumed = found.name, {}, ("neighbours", "ratios")
        fed = found.colour_inputs if encoder.config.colour else found.plain_inputs
        assumed += ("inputs",) if inputs is None else ()
    return PointEncoder(
        encoder=encoder.eval().requires_grad_(requires_grad=False),
        inputs=fed if inputs is None else inputs,
        source=file.name,
        layout=layout,
        recipe=recipe,
        assumed=assumed,
    )


@boundary
def save_point_encoder(
    encoder: RandlaEncoder, path: Path, *, inputs: PointInputs, facts: Mapping[str, Any]
) -> None:
    """Write an encoder: matrices as float16, the rest as float32, and the facts in the header.

    One of the published shape takes 5.9 MB. `load_point_encoder` is the inverse, but for the
    rounding of matrices.

    Args:
        encoder: As it is trained.
        path: The file, ``.safetensors``.
        inputs: How it was fed.
        facts: How it was trained: values that JSON holds.

    Raises:
        InputError: If a weight is not finite or too large for float16, or the facts hold
            something that JSON has no word for.
        OutputError: If it cannot be written.
    """
    state = {
        name: _halved(name, tensor) if tensor.ndim == 2 else tensor.float()
        for name, tensor in _state(encoder).items()
    }
    write_tensors(state, path, metadata=_metadata("encoder", encoder.config, inputs, facts))


@boundary
def save_point_network(
    network: RandlaNet, path: Path, *, inputs: PointInputs, facts: Mapping[str, Any]
) -> None:
    """Write a whole network as float32, to train on. `load_point_network` is the inverse.

    Args:
        network: As it is trained.
        path: The file, ``.safetensors``.
        inputs: How it was fed.
        facts: How it was trained: values that JSON holds.

    Raises:
        InputError: If the facts hold something that JSON has no word for.
        OutputError: If it cannot be written.
    """
    state = {name: tensor.float() for name, tensor in _state(network).items()}
    write_tensors(state, path, metadata=_metadata("network", network.config, inputs, facts))


@boundary
def load_point_network(path: Path) -> RandlaNet:
    """A whole network that `save_point_network` wrote, in training mode.

    Raises:
        MissingFileError: If there is no such file.
        FileFormatError: If it is damaged or something else.
    """
    tensors, about = _read(path)
    if about is None or about.part != "network":
        raise FileFormatError(
            f"{path}: expected a whole network of splatseg, got an encoder or another's file."
        )
    table = TensorTable(tensors, path)
    network = _restored(RandlaNet, about.config, table, "")
    table.check_none_left(())
    return network


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


def _restored(kind: type[M], config: RandlaConfig, table: TensorTable, prefix: str) -> M:
    with torch.device("meta"):
        module = kind(config)
    state: dict[str, Tensor] = {}
    for name, wanted in module.state_dict().items():
        if name.endswith(COUNTER):
            state[name] = torch.zeros((), dtype=torch.int64)
        elif name.endswith("running_var"):
            state[name] = table.take_variances(prefix + name, len(wanted))
        else:
            state[name] = table.take(prefix + name, wanted.shape)
    return with_state(module, state)


def _state(module: nn.Module) -> dict[str, Tensor]:
    """Tensors that matter, by name."""
    found = module.state_dict()
    return {name: tensor for name, tensor in found.items() if not name.endswith(COUNTER)}


def _halved(name: str, tensor: Tensor) -> Tensor:
    half = tensor.half()
    if not bool(torch.isfinite(half).all()):
        raise InputError(
            f"encoder: {name}: expected weights that float16 holds, "
            f"got {float(tensor.abs().max()):g}."
        )
    return half


def _metadata(
    part: Part, config: RandlaConfig, inputs: PointInputs, facts: Mapping[str, Any]
) -> dict[str, str]:
    about = About(part=part, config=config, inputs=inputs, recipe=plain_object("facts", facts))
    return about.metadata()
