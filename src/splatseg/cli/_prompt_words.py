"""Prompts as people type them: ``200,150`` in the view of --view, or ``front:200,150``."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from splatseg.core import Scene, View
from splatseg.errors import InputError
from splatseg.io.foreign import reading
from splatseg.io.images import open_image
from splatseg.prompting.prompts import Lasso, ViewPrompt

_T = TypeVar("_T")


@dataclass
class _Gathered:
    """What was said of one view."""

    view: View
    points: list[list[float]] = field(default_factory=list[list[float]])
    positive: list[bool] = field(default_factory=list[bool])
    box: list[float] | None = None
    mask: Tensor | None = None
    scribble: Tensor | None = None
    negative_scribble: Tensor | None = None

    def prompt(self) -> ViewPrompt:
        return ViewPrompt(
            view=self.view,
            points=torch.tensor(self.points).reshape(-1, 2),
            positive=torch.tensor(self.positive, dtype=torch.bool),
            box=None if self.box is None else torch.tensor(self.box),
            mask=self.mask,
            scribble=self.scribble,
            negative_scribble=self.negative_scribble,
        )


class PromptWords:
    """Reads prompts and gathers them by view.

    Args:
        scene: The scene, whose views they name.
        view: The view of what names none.
    """

    def __init__(self, scene: Scene, view: str | None) -> None:
        self._scene = scene
        self._names = {one.name for one in scene.views}
        self._view = None if view is None else scene.view(view)
        self._gathered: dict[str, _Gathered] = {}

    def add_points(self, flag: str, words: Sequence[str], *, positive: bool) -> None:
        """Points of one sign."""
        for word in words:
            view, rest = self._of_view(flag, word)
            self._in(view).points.append(_numbers(flag, rest, 2))
            self._in(view).positive.append(positive)

    def add_boxes(self, flag: str, words: Sequence[str]) -> None:
        """Boxes x0, y0, x1, y1, at most one a view."""
        for word in words:
            view, rest = self._of_view(flag, word)
            self._in(view).box = self._once(flag, view, self._in(view).box, _numbers(flag, rest, 4))

    def add_images(self, flag: str, name: str, words: Sequence[str]) -> None:
        """Masks or strokes from images: what is not black, and not transparent.

        Args:
            flag: The flag, for messages.
            name: The field of `ViewPrompt`.
            words: Files, at most one a view.
        """
        for word in words:
            view, rest = self._of_view(flag, word)
            held = getattr(self._in(view), name)
            setattr(self._in(view), name, self._once(flag, view, held, _read_mask(Path(rest))))

    def lassos(self, flag: str, words: Sequence[str]) -> list[Lasso]:
        """Polygons of views: x, y, x, y and so on."""
        found: list[Lasso] = []
        for word in words:
            view, rest = self._of_view(flag, word)
            numbers = _numbers(flag, rest, None)
            if len(numbers) % 2 or len(numbers) < 6:
                raise InputError(
                    f"{flag}: expected X,Y of three corners or more, got {len(numbers)} numbers."
                )
            found.append(Lasso(view=view, polygon=torch.tensor(numbers).reshape(-1, 2)))
        return found

    def prompts(self) -> list[ViewPrompt]:
        """One a view, in the order that views were named in."""
        return [gathered.prompt() for gathered in self._gathered.values()]

    def _in(self, view: View) -> _Gathered:
        return self._gathered.setdefault(view.name, _Gathered(view=view))

    def _of_view(self, flag: str, word: str) -> tuple[View, str]:
        """The view that a word names, or the common one, and the rest of the word."""
        name, colon, rest = word.rpartition(":")
        if colon and (name in self._names or not Path(word).exists()):
            return self._scene.view(name), rest
        if self._view is None:
            raise InputError(f"{flag}: expected --view, or VIEW:{word}, got neither.")
        return self._view, word

    @staticmethod
    def _once(flag: str, view: View, held: object, new: _T) -> _T:
        if held is not None:
            raise InputError(f"{flag}: expected at most one in view {view.name}, got two.")
        return new


def _numbers(flag: str, text: str, count: int | None) -> list[float]:
    wanted = "numbers" if count is None else f"{count} numbers"
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    fits = numbers and all(map(math.isfinite, numbers)) and count in (None, len(numbers))
    if not fits:
        raise InputError(f"{flag}: expected {wanted} joined by commas, got {text!r}.")
    return numbers


def _read_mask(path: Path) -> Tensor:
    """Pixels of an image that are neither black nor transparent."""
    with open_image(path) as image, reading(path, "an image"):
        has_alpha = "A" in image.getbands() or "transparency" in image.info
        colours = np.asarray(image.convert("RGBA" if has_alpha else "RGB"))
    lit = colours[..., :3].max(axis=2) > 0
    return torch.from_numpy(lit & (colours[..., 3] > 0) if has_alpha else lit)
