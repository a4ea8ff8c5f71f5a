"""What a generated scene is: solids, the objects they belong to, classes, and the sun."""

from dataclasses import dataclass

from splatseg._check import check_range
from splatseg.core import ClassTable
from splatseg.core.boundary import convert_fields
from splatseg.errors import InputError
from splatseg.synthetic._shapes import Primitive, Vector


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectInfo:
    """One object of a generated scene."""

    id: int
    """Instance id, from 1."""

    class_id: int
    name: str
    """A phrase that tells it from the others: ``the red chair by the window``."""

    parent: int | None = None
    """Instance that it stands or hangs on; None for the room itself."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SyntheticScene:
    """Solids with exact class and instance, inside a box; metres, z up."""

    name: str
    seed: int
    primitives: tuple[Primitive, ...]
    objects: tuple[ObjectInfo, ...]
    classes: ClassTable

    related_classes: tuple[tuple[str, ...], ...] = ()
    """Groups of classes that a network takes for one another."""

    bounds: tuple[Vector, Vector] = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    """Lowest and highest corner of the space where light is computed and cameras stand."""

    sun: Vector | None = None
    """Direction towards the sun; None is a night, or overcast. In a room it shines in through the
    planes that glow."""

    is_outdoor: bool = False
    """Whether there is a sky instead of walls around `bounds`: the sun shines everywhere."""

    drive: tuple[Vector, ...] = ()
    """Corners of a line on the ground that a vehicle with cameras follows; none in a room."""

    ambient: float = 1.0
    """Brightness of the light that comes from everywhere; 1 suits a room with a window."""

    def __post_init__(self) -> None:
        convert_fields(self)
        check_range("ambient", self.ambient, 0.0, 100.0)
        ids = [item.id for item in self.objects]
        if len(set(ids)) != len(ids):
            raise InputError(f"objects: expected distinct ids, got {sorted(ids)}.")
        unknown = sorted({p.instance for p in self.primitives} - set(ids))
        if unknown:
            raise InputError(f"primitives: expected instances of `objects`, got {unknown} as well.")
        known = {row.id for row in self.classes.rows}
        strange = sorted({item.class_id for item in self.objects} - known)
        if strange:
            raise InputError(f"objects: expected classes of `classes`, got {strange} as well.")

    def class_of(self, instance: int) -> int:
        """Class id of an instance.

        Raises:
            InputError: If there is no such instance.
        """
        for item in self.objects:
            if item.id == instance:
                return item.class_id
        raise InputError(f"instance: expected one of 1 to {len(self.objects)}, got {instance}.")
