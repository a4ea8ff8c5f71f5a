"""Cached rows of W for training: sampled pixels of all views, in fixed batches."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from splatseg.core import UNLABELLED, Camera, Gaussians, LabelSource, View, camera_of_map
from splatseg.render import RenderOptions, weights

_ENTRY = 16
"""Bytes of an entry in a batch: id and weight, by pixel and by Gaussian."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """Rows of W as compressed sparse rows, and what their pixels are labelled."""

    starts: Int64[Tensor, "pixels_plus_1"]
    gaussians: Tensor
    """int32, one an entry."""

    weights: Float[Tensor, "entries"]
    classes: Int64[Tensor, "pixels"]
    """Places of the pixels' ids among all ids."""

    says: Float[Tensor, "pixels"]
    """Confidence of the pixels' labels."""

    def __len__(self) -> int:
        return len(self.classes)

    def select(self, pixels: Int64[Tensor, "some"]) -> "Rows":
        """Some rows, in the order asked for."""
        first = self.starts[pixels]
        sizes = self.starts[pixels + 1] - first
        ends = torch.cumsum(sizes, dim=0)
        starts = torch.cat((ends.new_zeros(1), ends))
        entries = torch.repeat_interleave(first - starts[:-1], sizes)
        entries += torch.arange(len(entries))
        return Rows(
            starts=starts,
            gaussians=self.gaussians[entries],
            weights=self.weights[entries],
            classes=self.classes[pixels],
            says=self.says[pixels],
        )

    @staticmethod
    def concatenate(parts: Sequence["Rows"]) -> "Rows":
        """All rows, one part after the other."""
        sizes = torch.cat([torch.diff(part.starts) for part in parts])
        return Rows(
            starts=torch.cat((sizes.new_zeros(1), torch.cumsum(sizes, dim=0))),
            gaussians=torch.cat([part.gaussians for part in parts]),
            weights=torch.cat([part.weights for part in parts]),
            classes=torch.cat([part.classes for part in parts]),
            says=torch.cat([part.says for part in parts]),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Batch:
    """W of some pixels, ready for products with narrow signals in both directions.

    Both are sums in a fixed order, so that threads change nothing.
    """

    rows: Rows
    touched: Int64[Tensor, "t"]
    """The Gaussians that the pixels show, ascending."""

    _starts: Tensor
    _pixels: Tensor
    _weights: Tensor

    @classmethod
    def of(cls, rows: Rows) -> "Batch":
        """Sort the entries by Gaussian as well."""
        order = torch.argsort(rows.gaussians, stable=True)
        touched, sizes = torch.unique_consecutive(rows.gaussians[order], return_counts=True)
        pixels = torch.repeat_interleave(torch.arange(len(rows)), torch.diff(rows.starts))
        return cls(
            rows=rows,
            touched=touched.long(),
            _starts=torch.cat((sizes.new_zeros(1), torch.cumsum(sizes, dim=0))).int(),
            _pixels=pixels[order].int(),
            _weights=rows.weights[order],
        )

    def render(self, signal: Float[Tensor, "n channels"]) -> Float[Tensor, "pixels channels"]:
        """``W @ signal``."""
        return _sums(self.rows.gaussians, signal, self.rows.starts.int(), self.rows.weights)

    def back_project(self, image: Float[Tensor, "pixels channels"]) -> Float[Tensor, "t channels"]:
        """``W.T @ image``, of the touched Gaussians."""
        return _sums(self._pixels, image, self._starts, self._weights)


def _sums(places: Tensor, table: Tensor, starts: Tensor, weights: Tensor) -> Tensor:
    if not len(places):
        return table.new_zeros(len(starts) - 1, table.shape[1])
    return torch.nn.functional.embedding_bag(
        places,
        table.contiguous(),
        starts,
        mode="sum",
        per_sample_weights=weights,
        include_last_offset=True,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sampler:
    """Draws labelled pixels of views and keeps their rows."""

    gaussians: Gaussians
    views: Sequence[View]
    evidence: LabelSource
    ids: Int64[Tensor, "classes"]
    """All ids, ascending."""

    pixels: int
    """Pixels of a view."""

    memory: int
    """Bytes of all batches; a view that would take more than its part gives fewer pixels."""

    options: RenderOptions
    backend: str

    def draw(self, rng: np.random.Generator) -> tuple[Rows, Float[Tensor, "n"]]:
        """Rows of all views, and how much labelled light each Gaussian got in all pixels.

        The latter is estimated: what the sampled pixels gave it, times how many labelled pixels
        a sampled one stands for.
        """
        parts: list[Rows] = []
        evidence = torch.zeros(len(self.gaussians))
        for view in self.views:
            paper = self.evidence.label_map(view.name)
            flat = paper.ids.cpu().long().reshape(-1)
            labelled = torch.nonzero(flat != UNLABELLED).squeeze(1)
            if not len(labelled):
                continue
            count = min(self.pixels, len(labelled))
            drawn = rng.choice(len(labelled), count, replace=False)
            chosen = labelled[torch.from_numpy(drawn)]
            says = torch.ones(count)
            if paper.confidence is not None:
                says = paper.confidence.cpu().float().reshape(-1)[chosen]
            camera = camera_of_map(view, paper.height, paper.width)
            rows = self._rows(camera, chosen, torch.searchsorted(self.ids, flat[chosen]), says)
            each = len(labelled) / max(len(rows), 1)
            spoken = rows.weights * torch.repeat_interleave(rows.says, torch.diff(rows.starts))
            evidence.index_add_(0, rows.gaussians, spoken * each)
            parts.append(rows)
        return Rows.concatenate(parts), evidence

    def _rows(self, camera: Camera, flat: Tensor, classes: Tensor, says: Tensor) -> Rows:
        asked = torch.stack((flat % camera.width, flat // camera.width), dim=-1)
        with torch.no_grad():
            found = weights(
                self.gaussians, camera, asked, options=self.options, backend=self.backend
            )
        starts = found.indptr.cpu()
        most = max(1, self.memory // (_ENTRY * len(self.views)))
        # Pixels were drawn in no order, so the first ones are a sample as good as all.
        kept = max(1, int(torch.searchsorted(starts, most, right=True)) - 1)
        kept = min(kept, len(flat))
        entries = int(starts[kept])
        return Rows(
            starts=starts[: kept + 1].clone(),
            gaussians=found.ids.cpu()[:entries].clone(),
            weights=found.weights.cpu()[:entries].float(),
            classes=classes[:kept],
            says=says[:kept],
        )


def batches_of(rows: Rows, size: int, rng: np.random.Generator) -> list[Batch]:
    """Cut rows into batches of about `size` pixels, drawn from all views."""
    order = torch.from_numpy(rng.permutation(len(rows)))
    count = max(1, round(len(rows) / size))
    return [Batch.of(rows.select(part)) for part in torch.tensor_split(order, count)]
