"""How large a network wants its images: what preprocessor_config.json says, or the user."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from splatseg.errors import FileFormatError, quoted
from splatseg.io.json_files import read_json
from splatseg.models._images import Frame, frame_of, pixels

_MULTIPLES = ("size_divisor", "size_divisibility", "ensure_multiple_of")
"""What the multiple of sides is called in the files of the several networks."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InputSize:
    """Sides of a network's input. Either `sides`, or `shortest` and `longest`."""

    shortest: int | None = None
    """Pixels of the shorter side, where the longer one does not become more than `longest`."""

    longest: int | None = None
    """The most pixels of the longer side."""

    sides: tuple[int, int] | None = None
    """Height and width, whatever the image's proportions are."""

    keeps_proportions: bool = False
    """With `sides`: the image is scaled so that one side fits, the one that changes it less."""

    multiple: int = 1
    """Sides are multiples of this."""

    takes_squares: bool = False
    """The network takes squares only: a size that the user says is both sides."""

    @classmethod
    def of(cls, folder: Path, *, otherwise: "InputSize") -> "InputSize":
        """The one that the weights' preprocessor_config.json says.

        Args:
            folder: The weights.
            otherwise: What holds where the file is not there or does not tell; a size of one
                number is both sides where this has `sides`, else the shorter one.

        Raises:
            FileFormatError: If a size is no number of pixels.
        """
        path = folder / "preprocessor_config.json"
        if not path.is_file():
            return otherwise
        content = read_json(path)
        size = content.get("size")
        multiple = otherwise.multiple
        for name in _MULTIPLES:
            if content.get(name):
                multiple = pixels(path, name, content[name])
        if size is None:
            return cls(
                shortest=otherwise.shortest, longest=otherwise.longest, sides=otherwise.sides,
                keeps_proportions=otherwise.keeps_proportions, multiple=multiple,
            )  # fmt: skip
        given = cast(dict[str, Any], size) if isinstance(size, dict) else {}
        numbers = {key: pixels(path, f"size {key}", value) for key, value in given.items() if value}
        if not isinstance(size, dict):
            one = pixels(path, "size", size)
            square = otherwise.sides is not None
            numbers = {"height": one, "width": one} if square else {"shortest_edge": one}
            if not square and content.get("max_size"):
                numbers["longest_edge"] = pixels(path, "max_size", content["max_size"])
        if "height" in numbers and "width" in numbers:
            return cls(
                sides=(numbers["height"], numbers["width"]),
                keeps_proportions=content.get("keep_aspect_ratio") is True,
                multiple=multiple,
            )
        if not numbers.keys() & {"shortest_edge", "longest_edge"}:
            raise FileFormatError(
                f"{path}: size: expected height and width or the shortest and longest edge, got "
                f"{quoted(size)}."
            )
        return cls(
            shortest=numbers.get("shortest_edge"),
            longest=numbers.get("longest_edge"),
            multiple=multiple,
        )

    def frame(self, height: int, width: int, *, size: int | None = None) -> Frame:
        """How an image is laid into the input, without padding.

        Args:
            height: Rows of the image.
            width: Columns of the image.
            size: The longer side, where the user says it: the proportions are kept unless the
                network takes squares.
        """
        if size is not None and not self.takes_squares:
            return frame_of(height, width, size=size, multiple=self.multiple)
        if size is not None:
            inner = self._whole((size, size))
            return frame_of(height, width, size=inner[0], shape="square")
        if self.sides is not None and not self.keeps_proportions:
            inner = self._whole(self.sides)
        elif self.sides is not None:
            scales = (self.sides[0] / height, self.sides[1] / width)
            scale = min(scales, key=lambda one: abs(1 - one))
            inner = self._whole((height * scale, width * scale))
        else:
            scale = (self.shortest or self.longest or 1) / min(height, width)
            if self.longest is not None:
                scale = min(scale, self.longest / max(height, width))
                if self.shortest is None:
                    scale = self.longest / max(height, width)
            inner = self._whole((height * scale, width * scale))
        return Frame(
            height=height, width=width, inner_height=inner[0], inner_width=inner[1],
            outer_height=inner[0], outer_width=inner[1],
        )  # fmt: skip

    def _whole(self, sides: Sequence[float]) -> tuple[int, int]:
        rows, columns = (max(1, int(side / self.multiple + 0.5)) * self.multiple for side in sides)
        return rows, columns
