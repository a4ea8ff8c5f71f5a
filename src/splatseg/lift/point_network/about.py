"""What our checkpoints say of themselves, as text in the header of safetensors."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, TypeVar, cast, get_args

from splatseg.core import JSON
from splatseg.core.json_values import is_json_number
from splatseg.errors import FileFormatError, quoted
from splatseg.io.foreign import made_from
from splatseg.io.json_files import json_text, parse_object
from splatseg.lift.point_network.config import RandlaConfig, RandlaVariant
from splatseg.lift.point_network.inputs import PointInputs

Part = Literal["encoder", "network"]
FORMAT = "splatseg.point_network"
VERSION = "1"
T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class About:
    """The facts of a checkpoint."""

    part: Part
    """What its tensors are: an encoder, or a network with decoder and head."""

    config: RandlaConfig
    """The network's shape."""

    inputs: PointInputs
    """How it is fed."""

    recipe: Mapping[str, JSON]
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
    content = parse_object(metadata.get("about", ""), where=where)
    part, config, recipe = (content.get(key) for key in ("part", "config", "recipe"))
    if part not in get_args(Part):
        raise FileFormatError(f"{where}: expected encoder or network, got {quoted(part)}.")
    if not isinstance(config, dict) or not isinstance(recipe, dict):
        raise FileFormatError(f"{where}: expected objects config and recipe, got none.")
    shape = cast("dict[str, Any]", config)
    shape |= {"variant": _made(RandlaVariant, shape.get("variant"), f"{where}: variant")}
    return About(
        part=cast("Part", part),
        config=_made(RandlaConfig, shape, f"{where}: config"),
        inputs=_made(PointInputs, content.get("inputs"), f"{where}: inputs"),
        recipe=cast("dict[str, JSON]", recipe),
    )


def _made(kind: type[T], value: object, where: str) -> T:
    """A value of a dataclass from its fields in JSON."""
    names = {one.name for one in fields(cast(Any, kind))}
    if not isinstance(value, dict) or set(cast("dict[str, Any]", value)) != names:
        raise FileFormatError(f"{where}: expected {', '.join(sorted(names))}, got {quoted(value)}.")
    given = cast("dict[str, Any]", value)
    for name, one in given.items():
        for number in cast("list[object]", one) if isinstance(one, list) else [one]:
            if isinstance(number, int | float) and not is_json_number(number):
                raise FileFormatError(
                    f"{where}: {name}: expected finite numbers, got {quoted(number)}."
                )
    with made_from(where):
        return kind(**given)
