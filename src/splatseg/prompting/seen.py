r"""Prompts resolved to Gaussians: the rows of W of the pixels that a person shows.

Row p of W has the blending weight :math:`w_{pi}` of every Gaussian i in the pixel. What a prompt
means in the scene is therefore known without a threshold or a depth: by its rows. Two pixels show
the same Gaussians as far as their rows have light in common,

.. math:: \frac{\sum_i \min(w_{pi}, w_{qi})}{\min(\sum_i w_{pi}, \sum_i w_{qi})},

and prompts that say of the same Gaussians that they are the thing and that they are not are
refused.
"""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from splatseg._check import check_shape
from splatseg.core import (
    Camera,
    Edited,
    Gaussians,
    LabelMap,
    Labels,
    MaskSet,
    View,
    apply_rows,
)
from splatseg.core.boundary import boundary, convert_fields
from splatseg.core.options import Count
from splatseg.errors import InputError
from splatseg.lift.label_maps import view_label_map
from splatseg.lift.voting.segment_masses import view_masses
from splatseg.prompting.prompts import Lasso, Solid, ViewPrompt, pixels_in_box
from splatseg.render import PreparedView, SparseWeights, prepare

_CENTRAL = 0.5
"""Sides of the central part of a box, as a share of its own."""

_MIN_ALPHA = 0.02
"""Least alpha of a pixel that shows something; what has less is sky."""

_MAX_OVERLAP = 0.9
"""Largest share of light that a positive and a negative point may have from the same Gaussians;
with more they contradict each other."""

MAX_PIXELS = 1024
"""Most pixels that a mask, a box or strokes are thinned to."""


class ViewCache:
    r"""Prepared views of some Gaussians, the latest few; a context that releases them.

    To project and sort a view of 330 k Gaussians takes 50 ms, a row of its W then half of one.

    A view may show the Gaussians as an edit made them: with P, which has a 1 where row j of the
    edited ones comes from row i, what it says of the Gaussians is :math:`W P`.

    Args:
        gaussians: The Gaussians; they must stay as they are.
        backend: Rendering backend.
        capacity: How many views are kept, each some tens of megabytes; 1 or more.
        edited: What a view shows instead of the Gaussians, an edit of them without new rows (None
            for what it shows as it is); and what there is in the world, asked without a view. It
            gives the same object while that is the same. Gaussians of opacity 0 are not shown.
    """

    @boundary
    def __init__(
        self,
        gaussians: Gaussians,
        *,
        backend: str = "auto",
        capacity: Count = 4,
        edited: Callable[[View | None], Edited | None] | None = None,
    ) -> None:
        self._gaussians = gaussians
        self._backend = backend
        # A view of a scene in chunks holds what it read, and the memory is for one.
        self._capacity = capacity if gaussians.chunks is None else 1
        self._edited = edited or _as_it_is
        # Camera and edit are kept as long as their numbers are a key, which therefore is nobody
        # else's.
        self._views: OrderedDict[tuple[int, int], tuple[Camera, Edited | None, PreparedView]] = (
            OrderedDict()
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self._views)

    @property
    def gaussians(self) -> Gaussians:
        """Whose views they are."""
        return self._gaussians

    @property
    def backend(self) -> str:
        """Rendering backend."""
        return self._backend

    @boundary
    def prepared(self, view: View) -> PreparedView:
        """The view of what it shows; it stays open until as many others as are kept were asked for.

        Its rows are those of `shown`.
        """
        edited = self._edited(view)
        key = (id(view.camera), id(edited))
        if key in self._views:
            self._views.move_to_end(key)
            return self._views[key][2]
        shown = self._gaussians if edited is None else edited.gaussians
        made = prepare(shown, view.camera, backend=self._backend)
        if edited is not None:
            # An edit that was undone or went on holds a scene of Gaussians; it is let go.
            for other, (_, before, _) in list(self._views.items()):
                if before is not None and before is not edited:
                    self._views.pop(other)[2].close()
        self._views[key] = (view.camera, edited, made)
        while len(self._views) > self._capacity:
            self._views.popitem(last=False)[1][2].close()
        return made

    def shown(self, view: View | None = None) -> Edited:
        """What a view shows, or what there is in the world, and which Gaussian each row is of."""
        edited = self._edited(view)
        return Edited.unchanged(self._gaussians) if edited is None else edited

    def weights(self, view: View, pixels: Int64[Tensor, "p 2"]) -> SparseWeights:
        """Rows of W of pixels of a view, columns and rows, over the Gaussians."""
        found, edited = self.prepared(view).weights(pixels), self._edited(view)
        if edited is None:
            return found
        ids = edited.rows.to(found.ids.device)[found.ids.long()].int()
        return replace(found, ids=ids, gaussians=len(self._gaussians))

    def mask_masses(
        self, view: View, masks: MaskSet
    ) -> tuple[Float[Tensor, "masks n"], Float[Tensor, "n"]]:
        """What a view shows of each Gaussian inside masks, and at all: sums of weights, pixels."""
        # Rows of what the view shows, which after an edit are not the scene's.
        shown = self.shown(view)
        found = view_masses(shown.gaussians, view.camera, masks, backend=self._backend)
        inside = torch.zeros(len(masks), len(self._gaussians))
        rows = shown.rows[found.gaussian]
        inside.index_put_((found.segment, rows), found.weight, accumulate=True)
        visible = torch.zeros(len(self._gaussians))
        visible.index_add_(0, shown.rows, found.visible)
        return inside, visible

    def label_map(self, view: View, labels: Labels) -> LabelMap:
        """What a view shows of labels of the Gaussians."""
        edited = self._edited(view)
        shown = labels if edited is None else apply_rows(labels, edited)
        return view_label_map(self.prepared(view), shown)

    def inside(self, solid: Solid) -> Bool[Tensor, "n"]:
        """Which Gaussians a place has: at least one that is shown of each."""
        edited = self._edited(solid.view if isinstance(solid, Lasso) else None)
        if edited is None:
            return solid.contains(self._gaussians)
        lit = edited.gaussians.opacities > 0
        return edited.rows_before(solid.contains(edited.gaussians) & lit, len(self._gaussians))

    def close(self) -> None:
        """Release all views; they are prepared again when asked for."""
        for _, _, prepared in self._views.values():
            prepared.close()
        self._views.clear()


def _as_it_is(_: View | None) -> None:
    """No view shows an edit."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VisiblePrompt:
    """What a prompt shows in its view: pixels, and the Gaussians seen in them."""

    view: View

    rows: SparseWeights
    """Rows (p, n) of W, one a pixel: the Gaussians that it shows, with their blending weights."""

    pixels: Int64[Tensor, "p 2"]
    """Column and row of each."""

    positive: Bool[Tensor, "p"]
    """Whether each pixel shows the thing, or something else.

    Points and strokes say it of their own pixels, a mask of those inside; nothing is said of what
    is outside. A box says only that the thing lies `inside`: where it comes alone, the positive
    pixels are those of its central part, half as wide and half as high, which is a guess that a
    source may overrule.
    """

    dense: bool
    """True for the pixels of masks, strokes or boxes, of which some may be beside the thing;
    False for points, each of which was meant."""

    inside: Bool[Tensor, "height width"] | None = None
    """The box or mask that the thing lies inside in this view, all its pixels."""

    masked: bool = False
    """Whether a mask was drawn in this view, which `inside` has."""

    guessed: bool = False
    """Whether the positive pixels are those in the middle of a box, and nobody showed them."""

    def __post_init__(self) -> None:
        convert_fields(self)
        count = len(self.rows)
        check_shape("pixels", self.pixels, (count, 2))
        if self.inside is not None:
            check_shape("inside", self.inside, (self.view.camera.height, self.view.camera.width))

    def __len__(self) -> int:
        """Pixels."""
        return len(self.rows)

    @property
    def positive_rows(self) -> SparseWeights:
        """Rows of the pixels that show the thing."""
        return self.rows.select(torch.nonzero(self.positive).squeeze(1))

    @property
    def negative_rows(self) -> SparseWeights:
        """Rows of the pixels that show something else."""
        return self.rows.select(torch.nonzero(~self.positive).squeeze(1))


@boundary
def see_prompts(
    gaussians: Gaussians,
    prompts: Sequence[ViewPrompt],
    *,
    max_pixels: Count = MAX_PIXELS,
    seed: int = 0,
    views: ViewCache | None = None,
    backend: str = "auto",
) -> tuple[VisiblePrompt, ...]:
    """The Gaussians that prompts show.

    Points keep one row each. Masks and strokes are thinned to `max_pixels` pixels, one at random
    in each cell of a grid, and pixels that show nothing are left out; the same seed gives the same
    pixels.

    Args:
        gaussians: The Gaussians of the scene.
        prompts: What is shown, in any views; several may be of one view.
        max_pixels: Most pixels of a mask, a box or strokes; they stay spread over all of it.
        seed: Seed of the pixels that are taken.
        views: Views of the same Gaussians that were prepared before; None prepares them.
        backend: Rendering backend, where `views` is None.

    Returns:
        One a prompt and kind of pixels: points first, then strokes and masks.

    Raises:
        InputError: If a point shows the sky, a mask nothing else, nothing is shown of the thing
            itself, or positive and negative prompts show the same Gaussians.
    """
    if not prompts:
        raise InputError("prompts: expected at least one, got none.")
    cache = ViewCache(gaussians, backend=backend, capacity=1) if views is None else views
    seen: list[VisiblePrompt] = []
    try:
        for prompt in prompts:
            inside = _inside(prompt)
            if len(prompt.points):
                seen.append(_seen_points(cache, prompt, inside))
            if shown := _shown(prompt):
                generator = torch.Generator().manual_seed(seed)
                seen.append(
                    _seen_region(
                        cache, prompt, inside, shown, max_pixels=max_pixels, generator=generator
                    )
                )
    finally:
        if views is None:
            cache.close()
    if not any(bool(one.positive.any()) for one in seen):
        raise InputError("prompts: expected a positive point, a box, a mask or strokes, got none.")
    _check_contradictions(seen)
    return tuple(seen)


def _inside(prompt: ViewPrompt) -> Tensor | None:
    """Where the box and the mask allow the thing to be."""
    inside = prompt.mask
    if prompt.box is not None:
        camera = prompt.view.camera
        within = pixels_in_box(prompt.box, camera.height, camera.width)
        inside = within if inside is None else within & inside
        if not bool(inside.any()):
            raise InputError(
                f"prompt: expected a mask and a box that meet in view {prompt.view.name}, "
                "got two apart."
            )
    return inside


def _shown(prompt: ViewPrompt) -> list[tuple[str, Tensor, bool]]:
    """Regions of pixels by name, and whether they show the thing."""
    shown: list[tuple[str, Tensor, bool]] = []
    if prompt.mask is not None:
        shown.append(("mask", prompt.mask, True))
    if prompt.scribble is not None:
        shown.append(("scribble", prompt.scribble, True))
    if prompt.negative_scribble is not None:
        shown.append(("negative_scribble", prompt.negative_scribble, False))
    told = any(positive for _, _, positive in shown) or bool(prompt.signs.any())
    if prompt.box is not None and not told:
        shown.append(("box", _central(prompt.box, prompt.view), True))
    return shown


def _central(box: Float[Tensor, "4"], view: View) -> Tensor:
    """Pixels of the central part of a box; all of it where that has none."""
    height, width = view.camera.height, view.camera.width
    within = pixels_in_box(box, height, width)
    rows, columns = within.any(dim=1).nonzero(), within.any(dim=0).nonzero()
    low = torch.tensor([float(columns.min()), float(rows.min())])
    high = torch.tensor([float(columns.max()) + 1, float(rows.max()) + 1])
    margin = (1 - _CENTRAL) / 2 * (high - low)
    central = pixels_in_box(torch.cat((low + margin, high - margin)), height, width)
    return central if bool(central.any()) else within


def _seen_points(cache: ViewCache, prompt: ViewPrompt, inside: Tensor | None) -> VisiblePrompt:
    pixels = prompt.points.floor().long()
    rows = cache.weights(prompt.view, pixels)
    dark = rows.row_sums() < _MIN_ALPHA
    if bool(dark.any()):
        x, y = prompt.points[dark.to(prompt.points.device)][0].tolist()
        raise InputError(
            f"points: expected one on something, got ({x:g}, {y:g}) in view {prompt.view.name}, "
            "where no Gaussian stops the light (the sky)."
        )
    return VisiblePrompt(
        view=prompt.view,
        rows=rows,
        pixels=pixels,
        positive=prompt.signs,
        dense=False,
        inside=inside,
        masked=prompt.mask is not None,
    )


def _seen_region(
    cache: ViewCache,
    prompt: ViewPrompt,
    inside: Tensor | None,
    shown: list[tuple[str, Tensor, bool]],
    *,
    max_pixels: int,
    generator: torch.Generator,
) -> VisiblePrompt:
    parts: list[tuple[SparseWeights, Tensor, bool]] = []
    for name, region, positive in shown:
        pixels = thinned(region, max_pixels, generator)
        rows = cache.weights(prompt.view, pixels)
        lit = torch.nonzero(rows.row_sums() >= _MIN_ALPHA).squeeze(1)
        if not len(lit):
            raise InputError(
                f"{name}: expected pixels on something in view {prompt.view.name}, got none where "
                "a Gaussian stops the light (the sky)."
            )
        parts.append((rows.select(lit), pixels[lit.to(pixels.device)], positive))
    return VisiblePrompt(
        view=prompt.view,
        rows=SparseWeights.concatenate([rows for rows, _, _ in parts]),
        pixels=torch.cat([pixels for _, pixels, _ in parts]),
        positive=torch.cat([torch.full((len(pixels),), on) for _, pixels, on in parts]),
        dense=True,
        inside=inside,
        masked=prompt.mask is not None,
        guessed=any(name == "box" for name, _, _ in shown),
    )


def thinned(
    region: Bool[Tensor, "height width"], count: int, generator: torch.Generator
) -> Int64[Tensor, "p 2"]:
    """At most `count` pixels of a region, spread over it: column and row, row by row.

    One at random is taken in every cell of the finest square grid that has few enough cells with
    pixels of the region.
    """
    rows, columns = torch.nonzero(region, as_tuple=True)
    if len(rows) > count:
        order = torch.argsort(torch.rand(len(rows), generator=generator), stable=True)
        side = max(1, int((len(rows) / count) ** 0.5))
        kept = order
        while len(kept) > count:
            kept = _first_of_each((rows // side) * region.shape[1] + columns // side, order)
            side += 1
        rows, columns = rows[kept], columns[kept]
    return torch.stack((columns, rows), dim=1)


def _first_of_each(cells: Int64[Tensor, "p"], order: Int64[Tensor, "p"]) -> Int64[Tensor, "q"]:
    """The index that comes first in an order in each cell, ascending."""
    by_cell = order[torch.argsort(cells[order], stable=True)]
    sorted_cells = cells[by_cell]
    first = torch.ones(len(cells), dtype=torch.bool)
    first[1:] = sorted_cells[1:] != sorted_cells[:-1]
    return by_cell[first].sort().values


def _check_contradictions(seen: Sequence[VisiblePrompt]) -> None:
    """Refuse prompts that no set of Gaussians can satisfy.

    Points are held against each other in pairs; masks and strokes as a whole, because where they
    meet some pixels always see the same.
    """
    if all(bool(one.positive.all()) for one in seen):
        return
    _check_points([one for one in seen if not one.dense])
    _check_regions(seen)
    _check_regions([one for one in seen if one.dense])


def _check_points(points: Sequence[VisiblePrompt]) -> None:
    """Each negative point against each positive one, whatever views they are in."""
    if not points:
        return
    dense = _dense_rows(SparseWeights.concatenate([one.rows for one in points]))
    positive = torch.cat([one.positive for one in points]).cpu()
    sums = dense.sum(dim=1)
    names = [
        f"({x}, {y}) in view {one.view.name}" for one in points for x, y in one.pixels.tolist()
    ]
    for q in torch.nonzero(~positive).flatten().tolist():
        shared = torch.minimum(dense, dense[q]).sum(dim=1) / torch.minimum(sums, sums[q])
        clash = torch.nonzero(positive & (shared > _MAX_OVERLAP)).flatten().tolist()
        if clash:
            raise InputError(
                f"points: expected positive and negative points on different Gaussians, got "
                f"{names[clash[0]]} and {names[q]}, which contradict each other: they show the "
                "same."
            )


def _check_regions(seen: Sequence[VisiblePrompt]) -> None:
    """The mean row of all positive pixels against that of all negative ones."""
    if not seen:
        return
    rows = SparseWeights.concatenate([one.rows for one in seen]).to("cpu").compact().rows
    positive = torch.cat([one.positive for one in seen]).cpu()
    signs = torch.stack((positive, ~positive), dim=1).float()
    first, second = (rows.adjoint(signs) / signs.sum(dim=0).clamp_min(1)).unbind(dim=1)
    light = min(float(first.sum()), float(second.sum()))
    if light > 0 and float(torch.minimum(first, second).sum()) > _MAX_OVERLAP * light:
        raise InputError(
            "prompts: expected positive and negative prompts on different Gaussians, got ones "
            "that contradict each other: they show the same."
        )


def _dense_rows(rows: SparseWeights) -> Float[Tensor, "p m"]:
    """Rows over the Gaussians that occur in them; a Gaussian that comes twice counts with both."""
    compact = rows.to("cpu").compact().rows
    row = torch.repeat_interleave(torch.arange(len(compact)), compact.indptr.diff())
    cells = row * compact.gaussians + compact.ids.long()
    flat = torch.bincount(
        cells, weights=compact.weights.double(), minlength=len(compact) * compact.gaussians
    )
    return flat.reshape(len(compact), compact.gaussians)
