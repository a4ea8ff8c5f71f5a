"""The classes of the generated room, and a builder that places solids object by object."""

import math
from dataclasses import dataclass, field

import numpy as np

from splatseg.core import ClassInfo, ClassTable
from splatseg.synthetic.solids import ObjectInfo, Primitive, ShapeName, Texture, TextureName, Vector

ROOM_CLASSES = ClassTable(
    rows=tuple(
        ClassInfo(id=i + 1, name=name, isthing=thing, colour=colour)
        for i, (name, thing, colour) in enumerate(
            (
                ("wall", False, (174, 181, 196)),
                ("floor", False, (140, 96, 58)),
                ("ceiling", False, (232, 228, 214)),
                ("window", True, (92, 190, 240)),
                ("rug", True, (198, 60, 74)),
                ("picture", True, (246, 132, 28)),
                ("table", True, (226, 190, 60)),
                ("chair", True, (64, 150, 76)),
                ("sofa", True, (46, 84, 190)),
                ("cushion", True, (206, 110, 220)),
                ("shelf", True, (110, 66, 150)),
                ("books", True, (30, 170, 160)),
                ("lamp", True, (255, 238, 110)),
                ("plant", True, (140, 220, 70)),
                ("vase", True, (250, 130, 160)),
                ("ball", True, (130, 20, 40)),
            )
        )
    )
)
"""The sixteen classes of `room`, ids 1 to 16."""

RELATED = (
    ("wall", "ceiling", "picture", "window"),
    ("floor", "rug"),
    ("table", "shelf", "chair"),
    ("chair", "sofa", "table"),
    ("cushion", "sofa", "ball"),
    ("books", "shelf", "picture"),
    ("lamp", "vase", "plant"),
    ("ball", "vase", "cushion"),
)
"""Groups of classes that a network takes for one another."""

WOODS = (
    ((0.36, 0.22, 0.12), (0.55, 0.36, 0.20), (0.70, 0.50, 0.30)),
    ((0.52, 0.36, 0.20), (0.74, 0.56, 0.36), (0.86, 0.71, 0.50)),
    ((0.22, 0.14, 0.10), (0.38, 0.24, 0.17), (0.50, 0.34, 0.24)),
    ((0.60, 0.48, 0.36), (0.80, 0.70, 0.56), (0.92, 0.85, 0.74)),
)
_ACCENTS: tuple[Vector, ...] = (
    (0.80, 0.22, 0.20),
    (0.16, 0.48, 0.62),
    (0.90, 0.66, 0.18),
    (0.24, 0.52, 0.34),
    (0.55, 0.28, 0.58),
    (0.88, 0.46, 0.36),
    (0.20, 0.28, 0.52),
)


def shades(colour: Vector, *, spread: float = 0.45) -> tuple[Vector, Vector, Vector]:
    """Dark, as it is, light."""
    r, g, b = colour
    dark = (r * (1 - spread), g * (1 - spread), b * (1 - spread))
    return (dark, colour, (r + (1 - r) * spread, g + (1 - g) * spread, b + (1 - b) * spread))


@dataclass(slots=True, kw_only=True)
class Builder:
    """Collects objects and their solids. Solids are placed in the frame of their object."""

    rng: np.random.Generator
    classes: ClassTable = ROOM_CLASSES
    primitives: list[Primitive] = field(default_factory=list[Primitive])
    objects: list[ObjectInfo] = field(default_factory=list[ObjectInfo])
    frame: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def object(
        self,
        class_name: str,
        name: str,
        *,
        at: Vector = (0.0, 0.0, 0.0),
        yaw: float = 0.0,
        parent: int | None = None,
    ) -> int:
        """Begin an object; `at` is the middle of its foot. Returns its id."""
        self.frame = (*at, yaw)
        self.objects.append(
            ObjectInfo(
                id=len(self.objects) + 1,
                class_id=self.classes.by_name(class_name).id,
                name=name,
                parent=parent,
            )
        )
        return len(self.objects)

    def solid(
        self,
        shape: ShapeName,
        centre: Vector,
        half_size: Vector,
        texture: Texture,
        *,
        yaw: float = 0.0,
        tilt: float = 0.0,
        taper: float = 1.0,
    ) -> None:
        """Add a solid to the object begun last; `centre` is in the object's frame."""
        self.primitives.append(
            Primitive(
                shape=shape,
                centre=self.spot(centre),
                half_size=half_size,
                instance=len(self.objects),
                yaw=self.frame[3] + yaw,
                tilt=tilt,
                taper=taper,
                texture=texture,
            )
        )

    def legs(
        self, half_x: float, half_y: float, height: float, thick: float, texture: Texture
    ) -> None:
        """Four legs at the corners of what stands on them."""
        for x in (-half_x, half_x):
            for y in (-half_y, half_y):
                self.solid("box", (x, y, height / 2), (thick, thick, height / 2), texture)

    def spot(self, offset: Vector) -> Vector:
        """World position of a place in the frame of the object begun last."""
        x, y, z, turn = self.frame
        c, s = math.cos(turn), math.sin(turn)
        return (x + c * offset[0] - s * offset[1], y + s * offset[0] + c * offset[1], z + offset[2])

    def wood(self, *, scale: float = 0.16) -> Texture:
        """The texture of some wood."""
        return Texture(kind="wood", palette=WOODS[self.rng.integers(len(WOODS))], scale=scale)

    def cloth(self, *, kind: TextureName = "weave", scale: float = 0.12) -> Texture:
        """The texture of some cloth."""
        return Texture(kind=kind, palette=shades(self.accent()), scale=scale)

    def accent(self) -> Vector:
        """A strong colour."""
        return _ACCENTS[self.rng.integers(len(_ACCENTS))]

    def jitter(self, size: float) -> float:
        """A number between -size and size."""
        return float(self.rng.uniform(-size, size))
