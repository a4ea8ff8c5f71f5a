"""Stand-ins for 2D models that need no weights: colour, gradients and nothing else.

They run with nothing downloaded and know nothing of what things are. `Classical` has masks,
prompts and features behind the protocols; the functions are there by themselves too.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from numpy.typing import NDArray
from torch import Tensor

from splatseg.core import FeatureMap, MaskSet
from splatseg.core.boundary import boundary
from splatseg.core.models import DeepFeatures, Embedding, Image, Prompt
from splatseg.errors import ShapeError
from splatseg.models._merge_tree import one_thread
from splatseg.models._regions import SUPERPIXEL_SIZE, WORKING_SIZE, reduced
from splatseg.models._regions import ClassicalOptions as ClassicalOptions
from splatseg.models._regions import partition as partition
from splatseg.models._regions import region_masks as region_masks

ALGORITHM = 1
"""Grows when the same settings give other answers, so that cached ones are not taken for new."""

_LIGHTNESS_WEIGHT = 0.5
"""L against a and b: shading changes L from view to view, the object's colour does not."""

_DIRECTIONS = 8
CELL_SIZE = 8
"""Pixels of the photograph a cell of features."""

REACHES = (1.0, 3.0)
"""Widths of the neighbourhoods, in cells, that are described: one depth each, the deepest last."""

CUT_ROUNDS = 5
"""Rounds of fitting colour mixtures and cutting the graph."""

POINT_RADIUS = 0.012
"""Radius of the disc that a point stands for, as a share of the image's longest side."""

_SEED = 20240817


@dataclass(frozen=True, slots=True, kw_only=True)
class Classical:
    """Automatic masks by merging superpixels, prompted ones by GrabCut, features of colour."""

    regions: ClassicalOptions = field(default_factory=ClassicalOptions)

    @property
    def name(self) -> str:
        """``classical``."""
        return "classical"

    @property
    def settings(self) -> Mapping[str, Any]:
        """The options, the constants that were options once, and the version of the algorithm."""
        sizes = {"working_size": WORKING_SIZE, "superpixel_size": SUPERPIXEL_SIZE}
        return {
            "algorithm": ALGORITHM,
            "regions": sizes | asdict(self.regions) | {"cuts": list(self.regions.cuts)},
            "cut": {"cut_rounds": CUT_ROUNDS, "point_radius": POINT_RADIUS},
            "descriptor": {"cell_size": CELL_SIZE, "reaches": list(REACHES)},
        }

    @property
    def default_settings(self) -> Mapping[str, Any]:
        """The settings of a model that was made without options."""
        return Classical().settings

    @property
    def note(self) -> str:
        """That it is a stand-in."""
        return "a stand-in without weights: it goes by colour and edges, not by what things are"

    @property
    def concurrent(self) -> bool:
        """An image takes one thread."""
        return True

    def masks(self, image: Image) -> MaskSet:
        """Nested masks of several granularities: `region_masks`."""
        return region_masks(image, self.regions)

    def embed(self, image: Image) -> Embedding:
        """The image at the working size."""
        return Embedding(
            model=self.name,
            height=int(image.shape[0]),
            width=int(image.shape[1]),
            arrays={"image": torch.from_numpy(reduced(image, WORKING_SIZE).copy())},
        )

    def prompted_masks(self, embedding: Embedding, prompt: Prompt) -> MaskSet:
        """The mask of what the prompt means: `grab_cut`."""
        embedding.check_model(self.name)
        size = (embedding.height, embedding.width)
        return grab_cut(embedding.arrays["image"].numpy(), prompt, size=size)

    def features(self, image: Image) -> DeepFeatures:
        """Colour and gradients per cell: `colour_gradient_features`."""
        return colour_gradient_features(image)


def make_classical(_name: str, options: ClassicalOptions, _place: object) -> Classical:
    """The model of the family's options."""
    return Classical(regions=options)


@boundary
def colour_gradient_features(image: Image) -> DeepFeatures:
    """Mean and spread of Lab and a histogram of gradient directions, per neighbourhood.

    A stand-in for the features of a network: like surfaces get like vectors, but it knows
    nothing of what things are. Channels: mean L (halved), a, b; spread of L, a, b; then the
    gradient energy of eight directions, all scaled to about [-1, 1].

    Returns:
        One map a reach, float32 with 14 channels, and as class token the mean of the deepest.
    """
    import cv2

    height, width = (int(s) for s in image.shape[:2])
    cell = CELL_SIZE
    rows, columns = -(-height // cell), -(-width // cell)
    array = np.ascontiguousarray(image.cpu().numpy())
    # Cells at the lower and right border may reach over the image; it is continued there.
    padded = np.pad(
        array, ((0, rows * cell - height), (0, columns * cell - width), (0, 0)), mode="edge"
    )
    with one_thread():
        scaled = padded.astype(np.float32) / 255
        lab = np.asarray(cv2.cvtColor(scaled, cv2.COLOR_RGB2LAB), np.float32)
        planes = _planes(lab)
        cells = [_by_cell(plane, rows, columns) for plane in planes]
        maps = [_described(cells, reach) for reach in REACHES]
    return DeepFeatures(
        maps=tuple(
            FeatureMap(features=torch.from_numpy(values), stride=cell, height=height, width=width)
            for values in maps
        ),
        depths=tuple(f"reach{reach:g}" for reach in REACHES),
        class_token=torch.from_numpy(maps[-1].mean((0, 1), dtype=np.float64).astype(np.float32)),
    )


def _planes(lab: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Lab, its squares, and the gradient energy of each direction."""
    import cv2

    scaled = lab / np.array([100.0, 50.0, 50.0], np.float32)
    dx = np.asarray(cv2.Scharr(lab[..., 0], cv2.CV_32F, 1, 0)) / 16
    dy = np.asarray(cv2.Scharr(lab[..., 0], cv2.CV_32F, 0, 1)) / 16
    planes = [scaled[..., k] for k in range(3)]
    planes += [scaled[..., k] ** 2 for k in range(3)]
    for k in range(_DIRECTIONS):
        angle = np.pi * k / _DIRECTIONS
        planes.append(np.abs(dx * np.float32(np.cos(angle)) + dy * np.float32(np.sin(angle))))
    return planes


def _by_cell(plane: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float32]:
    height, width = plane.shape
    blocks = plane.reshape(rows, height // rows, columns, width // columns)
    return blocks.mean((1, 3), dtype=np.float64).astype(np.float32)


def _described(cells: list[NDArray[np.float32]], reach: float) -> NDArray[np.float32]:
    import cv2

    def blurred(plane: NDArray[np.float32]) -> Any:
        return cv2.GaussianBlur(plane, (0, 0), reach / 2, borderType=cv2.BORDER_REFLECT)

    means = np.stack([np.asarray(blurred(plane)) for plane in cells], axis=2)
    colour, squares, energy = means[..., :3], means[..., 3:6], means[..., 6:]
    spread = np.sqrt(np.maximum(squares - colour**2, 0))
    weighted = colour * np.array([_LIGHTNESS_WEIGHT, 1.0, 1.0], np.float32)
    values = np.concatenate((weighted, spread, energy / (energy + 4.0)), axis=2)
    return np.ascontiguousarray(values, dtype=np.float32)


@boundary
def grab_cut(
    image: NDArray[np.uint8],
    prompt: Prompt,
    *,
    size: tuple[int, int],
) -> MaskSet:
    """The mask that a prompt means. A stand-in for a learned promptable segmenter.

    What lies outside the box is background. A positive point's disc is foreground, a negative
    one's background. With points alone, a region around them is taken as probable foreground
    and the rest of the image as probable background. Of the cut, the parts that hold a positive
    point stay; without points, parts of at least a tenth of the largest one.

    Args:
        image: The image at the working size.
        prompt: What is meant, in pixels of the photograph.
        size: Height and width of the photograph, which the mask has too.

    Returns:
        One mask, or none where nothing is left of it.
    """
    import cv2

    height, width = size
    if image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise ShapeError(f"image: expected shape (any, any, 3), got {image.shape}.")
    prompt.check_size(height, width)
    trimap = _trimap(image.shape[:2], prompt, size=size)
    sure = np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if not sure.any() or sure.all():
        return _mask_set([], height, width)
    with one_thread():
        cv2.setRNGSeed(_SEED)  # the mixtures start from k-means with cv2's own generator
        background, foreground = np.zeros((1, 65)), np.zeros((1, 65))
        cv2.grabCut(
            np.ascontiguousarray(image[..., ::-1]),
            trimap,
            (0, 0, 1, 1),  # not looked at: the trimap says all
            background,
            foreground,
            CUT_ROUNDS,
            cv2.GC_INIT_WITH_MASK,
        )
    cut = np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD))
    points = _scaled_points(image.shape[:2], prompt, size)[prompt.signs.cpu().numpy()]
    cut = _parts_meant(cut, points)
    if not cut.any():
        return _mask_set([], height, width)
    full = np.asarray(
        cv2.resize(cut.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    )
    return _mask_set([torch.from_numpy(full >= 0.5)], height, width)


def _mask_set(masks: list[Bool[Tensor, "height width"]], height: int, width: int) -> MaskSet:
    dense = torch.stack(masks) if masks else torch.zeros(0, height, width, dtype=torch.bool)
    # Half: GrabCut does not say how sure it is.
    return MaskSet.from_dense(dense, scores=torch.full((len(dense),), 0.5))


def _trimap(shape: tuple[int, ...], prompt: Prompt, *, size: tuple[int, int]) -> NDArray[np.uint8]:
    import cv2

    h, w = shape
    height, width = size
    rows, columns = np.mgrid[:h, :w] + 0.5
    trimap = np.full((h, w), cv2.GC_PR_BGD, np.uint8)
    points = _scaled_points(shape, prompt, size)
    radius = max(1.0, POINT_RADIUS * max(h, w))
    if prompt.mask is not None:
        rough = prompt.mask.cpu().numpy().astype(np.uint8)
        small = np.asarray(cv2.resize(rough, (w, h), interpolation=cv2.INTER_NEAREST))
        _mark_rough(trimap, small > 0)
    elif prompt.box is not None:
        trimap[:] = cv2.GC_PR_FGD
    else:
        for x, y in points[prompt.signs.cpu().numpy()]:
            near = (columns - x) ** 2 + (rows - y) ** 2 <= (4 * radius) ** 2
            trimap[near] = cv2.GC_PR_FGD
    if prompt.box is not None:
        scale = np.array([w / width, h / height, w / width, h / height])
        x0, y0, x1, y1 = prompt.box.double().cpu().numpy() * scale
        inside = (columns > x0) & (columns < x1) & (rows > y0) & (rows < y1)
        trimap[~inside] = cv2.GC_BGD
    for (x, y), positive in zip(points, prompt.signs.tolist(), strict=True):
        disc = (columns - x) ** 2 + (rows - y) ** 2 <= radius**2
        trimap[disc] = cv2.GC_FGD if positive else cv2.GC_BGD
    return trimap


def _mark_rough(trimap: NDArray[np.uint8], rough: NDArray[np.bool_]) -> None:
    """The core of a rough mask is foreground, what is as far outside as it is thick background."""
    import cv2

    if not rough.any() or rough.all():
        trimap[rough] = cv2.GC_PR_FGD
        return
    inside = np.asarray(cv2.distanceTransform(rough.astype(np.uint8), cv2.DIST_L2, 5))
    outside = np.asarray(cv2.distanceTransform((~rough).astype(np.uint8), cv2.DIST_L2, 5))
    trimap[rough] = cv2.GC_PR_FGD
    trimap[inside > 0.6 * inside.max()] = cv2.GC_FGD
    trimap[outside > inside.max()] = cv2.GC_BGD


def _scaled_points(
    shape: tuple[int, ...], prompt: Prompt, size: tuple[int, int]
) -> NDArray[np.float64]:
    """Points of the prompt in pixels at the working size."""
    scale = np.array([shape[1] / size[1], shape[0] / size[0]])
    return prompt.points.double().cpu().numpy() * scale


def _parts_meant(cut: NDArray[np.bool_], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Connected parts that hold a positive point; without points, all but small ones."""
    import cv2

    _, parts = cv2.connectedComponents(cut.astype(np.uint8), connectivity=8)
    areas = np.bincount(parts.reshape(-1))
    areas[0] = 0
    if len(points):
        rows = np.minimum(points[:, 1].astype(int), cut.shape[0] - 1)
        columns = np.minimum(points[:, 0].astype(int), cut.shape[1] - 1)
        keep = np.setdiff1d(np.unique(parts[rows, columns]), 0)
    else:
        keep = np.flatnonzero(areas >= max(1, 0.1 * areas.max()))
    return np.isin(parts, keep)
