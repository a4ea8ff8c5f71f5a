"""The neighbours of a selection in a scene on the disk, of which the graph of all is too large."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from splatseg.core import Gaussians
from splatseg.core.chunks import Chunks
from splatseg.errors import InputError
from splatseg.prompting.graph import NeighbourGraph, build_graph

_MARGIN = 0.25
"""Of what a chunk is usually wide, by which neighbours are looked for around a selection."""

_GRAPH_BYTES = 1060
"""Of each Gaussian while its neighbours are found."""


def graph_near(gaussians: Gaussians, chunks: Chunks, mask: Bool[Tensor, "n"]) -> NeighbourGraph:
    """The neighbours of what is near some Gaussians on the disk; others have none.

    Near is what lies in the box around those of a chunk, with a margin of a quarter of what a chunk
    is usually wide: some ten times as far as nearest neighbours are.

    Args:
        gaussians: Gaussians on the disk.
        chunks: Where they are.
        mask: The Gaussians.

    Raises:
        InputError: If they are more than fit in the memory.
    """
    from scipy.sparse import csr_matrix

    margin = _MARGIN * (chunks.high - chunks.low).median(dim=1).values.median()
    boxes: list[tuple[Tensor, Tensor]] = []
    chosen = torch.zeros(len(chunks), dtype=torch.bool)
    for first, end in pairwise(chunks.starts.tolist()):
        if bool((mine := mask[first:end]).any()):
            means = gaussians.means[first:end][mine]
            boxes.append((means.amin(dim=0) - margin, means.amax(dim=0) + margin))
            chosen |= chunks.around(*boxes[-1])
    rows = chunks.rows(chosen)
    near = torch.zeros(len(rows), dtype=torch.bool)
    means = gaussians.means[rows]
    for low, high in boxes:
        near |= ((means >= low) & (means <= high)).all(dim=1)
    needed = _GRAPH_BYTES * int(near.sum())
    if needed > chunks.memory:
        raise InputError(
            f"memory: neighbours of what is around the selection take about {needed / 1e9:.1f} GB, "
            f"more than the {chunks.memory / 1e9:.1f} GB that were allowed; allow more, or select "
            "with post_processing none."
        )
    rows = rows[near]
    local = build_graph(gaussians[rows])
    matrix, count = local.strengths, len(gaussians)
    sizes = np.zeros(count, np.int32)
    sizes[rows.numpy()] = np.diff(matrix.indptr)
    ends = np.concatenate(([0], np.cumsum(sizes, dtype=np.int32)), dtype=np.int32)
    indices = rows.int().numpy()[matrix.indices]
    strengths: Any = csr_matrix((matrix.data, indices, ends), shape=(count, count))
    return replace(local, strengths=strengths)
