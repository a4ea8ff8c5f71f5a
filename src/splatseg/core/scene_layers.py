"""The layers of a scene folder as a mapping: ``scene.layers["semantic"]``."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from splatseg.core.instance_tree import Layer
from splatseg.core.late import late
from splatseg.errors import InputError


class SceneLayers(Mapping[str, Layer]):
    """Layers by name, read from the scene's folder each time one is asked for.

    A scene that was not saved has none. What another program writes meanwhile is seen.

    Raises:
        InputError: If there is no layer of the name; the message lists those there are.
    """

    def __init__(self, root: Path | None) -> None:
        self._root = root

    def _names(self) -> tuple[str, ...]:
        return () if self._root is None else late("io.scene", "scene_layer_names")(self._root)

    def __getitem__(self, name: str) -> Layer:
        where = "a scene that was not saved" if self._root is None else self._root
        if self._root is None or name not in self._names():
            known = ", ".join(self._names()) or "it has none"
            raise InputError(f"layer: expected one of {where} ({known}), got {name!r}.")
        return late("io.scene", "load_scene_layer")(self._root, name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names())

    def __len__(self) -> int:
        return len(self._names())

    def __contains__(self, name: object) -> bool:
        return name in self._names()

    def __repr__(self) -> str:
        return f"SceneLayers({', '.join(self._names()) or 'none'})"
