"""What is selected of a scene, and what is done with it."""

from pathlib import Path
from typing import Literal

from splatseg.core.options import Natural, options
from splatseg.errors import InputError

Triple = tuple[float, float, float]

_CONDITIONS = ("layer", "box", "sphere", "opacity", "size", "colour_near", "component_at")
_NOTHING_SELECTED = "expected `layer`, `box` or another condition of what is meant, got none."


@options(
    removed={
        "colour_shift": "scale or set the colour, or call splatseg.edit.recolour",
        "measure": "pictures=0 leaves out what is measured, too",
    }
)
class EditOptions:
    """What is selected, and what is done with it."""

    extract: bool = False
    """Keep what is selected, and nothing else."""

    remove: bool = False
    """Leave out what is selected."""

    duplicate: bool = False
    """Add a copy of what is selected, moved by `move`, `rotate` and `scale`."""

    merge: Path | None = None
    """Add the Gaussians and layers of another scene folder. Its ids that clash get new numbers,
    except where both scenes have the same name for an id."""

    undo: bool = False
    """Write SCENE as it was before its last edit: all others are done again on the scene that
    was edited first, which must still be where it was."""

    layer: str | None = None
    """Layer that names what is selected: labels, with `ids` or `names`, or a selection."""

    ids: tuple[int, ...] = ()
    """Ids of the layer."""

    names: tuple[str, ...] = ()
    """Names of ids, in the layer or the scene's classes. All ids of a name are meant."""

    box: tuple[float, float, float, float, float, float] | None = None
    """Least x, y, z and largest x, y, z of a box in the world, scene units."""

    sphere: tuple[float, float, float, float] | None = None
    """Centre x, y, z and radius of a ball in the world, scene units."""

    opacity: tuple[float, float] | None = None
    """Least and largest opacity, in [0, 1]."""

    size: tuple[float, float] | None = None
    """Least and largest size: the standard deviation along the longest axis, scene units. The
    largest may be inf."""

    colour_near: tuple[float, float, float, float] | None = None
    """Red, green, blue in [0, 1] and the largest distance of a mean colour from it."""

    largest_component: bool = False
    """Of what fits all else, only the connected piece of the most Gaussians."""

    component_at: Triple | None = None
    """Of what fits all else, only the connected piece nearest to this point, world."""

    match: Literal["all", "any"] = "all"
    """Whether all conditions of the selection must hold, or one of them is enough. What is
    selected by any of several is not cut."""

    invert: bool = False
    """Select all others instead."""

    move: Triple | None = None
    """Shift along x, y, z, scene units."""

    rotate: tuple[float, float, float, float] | None = None
    """Axis x, y, z and angle in degrees, right-handed."""

    scale: float = 1.0
    """Factor of the size."""

    about: Triple | None = None
    """The point that `rotate` and `scale` leave where it is, world. None is the median
    of what is selected, and the origin of OTHER for `merge`."""

    colour: Triple | None = None
    """Red, green, blue in [0, 1] that the mean colour of every Gaussian becomes."""

    colour_scale: Triple | None = None
    """Factors of red, green, blue."""

    flat_colour: bool = False
    """Drop what of the colour changes with the direction it is seen from."""

    cut: Literal["auto", "masks", "layer", "box", "off"] = "auto"
    """Where Gaussians that reach over the boundary are cut in two. masks: at the label maps that
    the layer was made from; layer: at the boundary that the layer itself draws in training views;
    box: at the box only; off: nowhere. auto: masks where the layer knows them and nothing was
    edited yet, else layer, and always the box."""

    evidence: str | None = None
    """Name of the label maps for `cut` masks. None takes those the layer was made from."""

    specks: Natural = 30
    """With `remove` of a layer's ids: small connected pieces that touch nothing but what is
    removed go along, up to this many Gaussians each, unless they are most of another thing of
    the layer. 0 leaves them."""

    pictures: Natural = 3
    """Views drawn before and after, those that change most, for reports/edit.html and edit.png
    of the new scene. 0 draws none, and leaves out by how much a cut alone changes renders."""

    def __post_init__(self) -> None:
        action = self._action()
        selecting = bool(self.conditions)
        if action in ("extract", "remove", "duplicate") and not selecting:
            raise InputError(f"{action}: {_NOTHING_SELECTED}")
        if action in ("merge", "undo") and selecting:
            raise InputError(f"{action}: takes no selection.")
        if action in ("remove", "undo") and self.moves:
            raise InputError(f"{action}: takes no `move`, `rotate` or `scale`.")
        if action in ("remove", "duplicate", "merge", "undo") and self.recolours:
            raise InputError(f"{action}: takes no colours; colour in an edit of its own.")
        if (self.ids or self.names) and self.layer is None:
            raise InputError("ids, names: expected `layer` that they are of, got none.")
        if action is None and not self.moves and not self.recolours:
            raise InputError(
                "edit: expected something to do, such as `remove` or `move`, got nothing."
            )
        if self.invert and not selecting:
            raise InputError(f"invert: {_NOTHING_SELECTED}")
        if self.match == "any" and len(self.conditions) < 2:
            raise InputError("match: any needs two conditions or more to choose among.")

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the conditions of the selection that are given."""
        given = (name for name in _CONDITIONS if getattr(self, name) is not None)
        pieces = ("largest_component",) if self.largest_component else ()
        return (*given, *pieces)

    def _action(self) -> str | None:
        actions = {
            "extract": self.extract,
            "remove": self.remove,
            "duplicate": self.duplicate,
            "merge": self.merge is not None,
            "undo": self.undo,
        }
        given = [name for name, on in actions.items() if on]
        if len(given) > 1:
            raise InputError(f"{given[0]}, {given[1]}: expected one of the two, got both.")
        return given[0] if given else None

    @property
    def moves(self) -> bool:
        """Whether something changes its pose or size."""
        return self.move is not None or self.rotate is not None or self.scale != 1

    @property
    def recolours(self) -> bool:
        """Whether something changes its colour."""
        return self.flat_colour or self.colour is not None or self.colour_scale is not None
