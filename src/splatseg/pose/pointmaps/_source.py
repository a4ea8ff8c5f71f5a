"""Who answers for pairs of photographs: a folder, or a network whose answers go to one."""

import hashlib
import json
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splatseg.core.json_values import plain_json
from splatseg.core.models import Image, Pointmap, PointmapModel
from splatseg.errors import InputError
from splatseg.io.pointmaps import RecordedPointmaps, create_pointmaps
from splatseg.pose._photographs import Photograph, read_reduced

_IMAGES_KEPT = 64
"""Images that stay in memory: at 512 pixels they take half a megabyte each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkPairs:
    """A network, asked once for each pair; what it says goes to a folder and is read from there."""

    model: PointmapModel
    photographs: Sequence[Photograph]
    longest: int
    kept: RecordedPointmaps
    _images: OrderedDict[str, Image] = field(default_factory=OrderedDict[str, Image], repr=False)

    def pointmaps(self, first: str, second: str) -> tuple[Pointmap, Pointmap]:
        """Points of both photographs in the frame of the first one's camera.

        Raises:
            InputError: If the model answers something else.
        """
        if not self.kept.holds(first, second):
            answer: Any = self.model.pointmaps(self._image(first), self._image(second))
            if not (
                isinstance(answer, tuple)
                and len(answer) == 2  # pyright: ignore[reportUnknownArgumentType]
                and all(isinstance(one, Pointmap) for one in answer)  # pyright: ignore[reportUnknownVariableType]
            ):
                raise InputError(
                    f"model {self.model.name}: expected two Pointmaps for two images, got "
                    f"{type(answer).__name__}."  # pyright: ignore[reportUnknownArgumentType]
                )
            self.kept.save(first, second, (answer[0], answer[1]))
        # As it was written, so that a run that goes on gives what one in one piece gives.
        return self.kept.pointmaps(first, second)

    def _image(self, name: str) -> Image:
        if name not in self._images:
            photograph = next(one for one in self.photographs if one.path.name == name)
            self._images[name] = read_reduced(photograph, longest=self.longest)
        self._images.move_to_end(name)
        while len(self._images) > _IMAGES_KEPT:
            self._images.popitem(last=False)
        return self._images[name]


def network_pairs(
    model: PointmapModel, photographs: Sequence[Photograph], folder: Path, *, longest: int
) -> NetworkPairs:
    """A network whose answers are kept in a folder; those that are there are not asked again.

    Raises:
        InputError: If the folder holds answers of another model, or about other photographs.
    """
    kept = create_pointmaps(
        folder,
        photographs=[one.path.name for one in photographs],
        metadata={
            "model": model.name,
            "settings": plain_json("settings", dict(model.settings)),
            "longest": longest,
        },
    )
    return NetworkPairs(model=model, photographs=photographs, longest=longest, kept=kept)


def source_digest(source: PointmapModel | RecordedPointmaps) -> str:
    """What the answers of a source depend on: the model and its settings, or the files there."""
    if isinstance(source, RecordedPointmaps):
        files = [(p.name, p.stat().st_size) for p in sorted(source.folder.iterdir())]
        what: Any = [str(source.folder.absolute()), files]
    else:
        what = [source.name, plain_json("settings", dict(source.settings))]
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()
