"""CPU kernels, see native/module.cpp.

Arrays are C-contiguous, on the CPU, and not checked here beyond what memory safety asks for.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

ALPHA_MIN: float
TRANSMITTANCE_MIN: float
MEDIAN_TRANSMITTANCE: float
FRUSTUM_MARGIN: float
TILE: int

def threads() -> int: ...
def set_threads(count: int, /) -> None: ...
def isa() -> str: ...
def set_isa(name: str, /) -> bool: ...

class Cloud:
    def __init__(
        self,
        means: Tensor,
        rotations: Tensor,
        scales: Tensor,
        opacities: Tensor,
        sh: Tensor | None,
        signal: Tensor | None,
    ) -> None: ...

class View:
    visible: int
    tile_pairs: int
    evaluated: int
    def prepare(
        self,
        cloud: Cloud,
        width: int,
        height: int,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        pose: Tensor,
        near: float,
        alpha_max: float,
        low_pass: float,
        antialiased: bool,
        sh_degree: int,
        /,
    ) -> None: ...
    def forward_colour(
        self,
        channels: int,
        image: Tensor,
        alpha: Tensor,
        depth_sum: Tensor,
        median: Tensor,
        record: bool,
        /,
    ) -> None: ...
    def picture(self, tint: Tensor | None, image: Tensor, /) -> None: ...
    def forward_features(
        self,
        signal: Tensor,
        image_channels: int,
        image: Tensor,
        alpha: Tensor,
        depth_sum: Tensor,
        median: Tensor,
        record: bool,
        /,
    ) -> None: ...
    def adjoint(
        self, image: Tensor, image_channels: int, sums: Tensor, weights: Tensor, /
    ) -> None: ...
    def backward_colour(
        self,
        channels: int,
        image: Tensor,
        alpha: Tensor,
        depth_sum: Tensor,
        v_image: Tensor,
        v_alpha: Tensor | None,
        v_depth_sum: Tensor | None,
        /,
    ) -> None: ...
    def backward_features(
        self,
        signal: Tensor,
        image_channels: int,
        image: Tensor,
        alpha: Tensor,
        depth_sum: Tensor,
        v_image: Tensor,
        v_alpha: Tensor | None,
        v_depth_sum: Tensor | None,
        v_signal: Tensor | None,
        /,
    ) -> None: ...
    def chain(
        self,
        cloud: Cloud,
        means: Tensor | None,
        rotations: Tensor | None,
        scales: Tensor | None,
        opacities: Tensor | None,
        sh: Tensor | None,
        screen: Tensor | None,
        pose: Tensor | None,
        /,
    ) -> None: ...
    def narrow_signal_gradient(self, channels: int, v_signal: Tensor, /) -> None: ...
    def visible_ids(self, ids: Tensor, /) -> None: ...
    def recolour(self, cloud: Cloud, sh_degree: int, /) -> None: ...
    def sparse_adjoint(
        self, indptr: Tensor, columns: Tensor, values: Tensor, weights: Tensor, /
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]: ...
    def argmax(
        self,
        channels: Tensor,
        values: Tensor | None,
        count: int,
        background: int,
        winner: Tensor,
        score: Tensor,
        /,
    ) -> None: ...
    def pixel_rows(
        self, pixels: Tensor, k: int, /
    ) -> tuple[
        NDArray[np.int64],
        NDArray[np.int32],
        NDArray[np.float32],
        NDArray[np.int32],
        NDArray[np.int32],
    ]: ...

class BlockMatrix:
    entries: int
    nbytes: int
    def __init__(self) -> None: ...
    def build(self, view: View, /) -> None: ...
    def render(self, signal: Tensor, image_channels: int, image: Tensor, /) -> None: ...
    def back_project(
        self, image: Tensor, image_channels: int, sums: Tensor, weights: Tensor, /
    ) -> None: ...
    def count_rows(self, indptr: Tensor, /) -> None: ...
    def fill_rows(self, indptr: Tensor, ids: Tensor, weights: Tensor, /) -> None: ...
    def sums_of_parts(
        self, part: Tensor, /
    ) -> tuple[NDArray[np.int32], NDArray[np.int64], NDArray[np.int32], NDArray[np.int32]]: ...

def csr_product(
    indptr: Tensor, ids: Tensor, weights: Tensor, table: Tensor, out: Tensor, /
) -> None: ...
def csr_adjoint(
    indptr: Tensor, ids: Tensor, weights: Tensor, table: Tensor, out: Tensor, /
) -> None: ...
def csr_transpose(
    indptr: Tensor,
    ids: Tensor,
    weights: Tensor,
    to_indptr: Tensor,
    to_rows: Tensor,
    to_weights: Tensor,
    /,
) -> None: ...
def csr_strong(
    indptr: Tensor,
    ids: Tensor,
    weights: Tensor,
    min_weight: float,
    share: float,
    kept: Tensor,
    /,
) -> None: ...
def csr_select(
    indptr: Tensor,
    ids: Tensor,
    weights: Tensor,
    index: Tensor,
    to_indptr: Tensor,
    to_ids: Tensor,
    to_weights: Tensor,
    /,
) -> None: ...
def sparse_product(
    indptr: NDArray[np.int64],
    columns: NDArray[np.int32],
    values: NDArray[Any],
    begin: NDArray[np.int64],
    end: NDArray[np.int64],
    of_columns: NDArray[np.int32],
    of_values: NDArray[Any],
    width: int,
    /,
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float64]]: ...
def l1_dssim(
    image: Tensor,
    photograph: Tensor,
    mask: Tensor | None,
    gradient: Tensor,
    dssim_weight: float,
) -> tuple[float, float]: ...
def rows_in_view(
    means: Tensor,
    log_scales: Tensor,
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    pose: Tensor,
    near: float,
    rows: Tensor,
) -> int: ...
def gather_gaussians(raw: Sequence[Tensor], rows: Tensor, out: Sequence[Tensor]) -> None: ...
def update_rows(
    raw: Sequence[Tensor],
    first: Sequence[Tensor],
    second: Sequence[Tensor],
    gradients: Sequence[Tensor],
    rows: Tensor,
    rates: Sequence[float],
    beta1: float,
    beta2: float,
    epsilon: float,
    step: int,
    opacity_penalty: float,
    scale_penalty: float,
    noise: float,
    seed: int,
) -> None: ...
def adam_rows(
    value: Tensor,
    first: Tensor,
    second: Tensor,
    steps: Tensor,
    rows: Tensor,
    gradient: Tensor,
    correction1: Tensor,
    correction2: Tensor,
    rate: float,
    beta1: float,
    beta2: float,
    epsilon: float,
) -> None: ...

class Memberships:
    def __init__(
        self,
        row_begin: NDArray[Any],
        row_ids: NDArray[Any],
        row_weights: NDArray[Any],
        column_begin: NDArray[Any],
        column_ids: NDArray[Any],
        column_weights: NDArray[Any],
        candidate_begin: NDArray[Any],
        candidates: NDArray[Any],
        shown_begin: NDArray[Any],
        shown: NDArray[Any],
        /,
    ) -> None: ...
    def shown_values(self, values: NDArray[Any], out: NDArray[Any], /) -> None: ...
    def step(
        self,
        label: NDArray[Any],
        step: NDArray[Any],
        residuals: NDArray[Any],
        values: NDArray[Any],
        /,
    ) -> None: ...

class NeighbourIndex:
    nbytes: int
    def __init__(self, points: Tensor, /) -> None: ...
    def nearest(
        self,
        queries: Tensor | None,
        rows: Tensor | None,
        max_squared: float,
        indices: Tensor,
        squared: Tensor,
    ) -> int: ...
    def count_within(
        self, queries: Tensor | None, rows: Tensor | None, max_squared: float, counts: Tensor
    ) -> None: ...
    def within(
        self,
        queries: Tensor | None,
        rows: Tensor | None,
        max_squared: float,
        starts: Tensor,
        indices: Tensor,
        squared: Tensor,
    ) -> None: ...
    def ball_means(
        self, queries: Tensor, max_squared: float, values: Tensor, means: Tensor, counts: Tensor
    ) -> None: ...

class Subset:
    count: int
    def __init__(self, index: NeighbourIndex, members: Tensor, /) -> None: ...
    def mean_distances(self, k: int, means: Tensor) -> None: ...
    def near(
        self, index: NeighbourIndex, among: Tensor | None, max_squared: float, marks: Tensor
    ) -> None: ...
    def connected(self, seeds: Tensor, max_squared: float, marks: Tensor) -> None: ...

def watershed(heights: NDArray[np.float32], basins: NDArray[np.int32]) -> None: ...
def merge_regions(
    *,
    leaves: int,
    pixels: float,
    sums: NDArray[np.float64],
    predicted: bool,
    outlines: NDArray[np.float64],
    boxes: NDArray[np.float64],
    rim: NDArray[np.float64],
    height: NDArray[np.float64],
    pairs: NDArray[np.int64],
    borders: NDArray[np.float64],
    layers: Sequence[tuple[NDArray[np.float32], NDArray[np.float32]]],
    scaling: NDArray[np.float32] | None,
    blend: NDArray[np.float32],
    merges: NDArray[np.int64],
    costs: NDArray[np.float64],
    record: bool,
) -> tuple[int, NDArray[np.int64], NDArray[np.float32]]: ...
def match_features(
    panels: Tensor,
    rows: int,
    scales: Tensor | None,
    positive: Tensor,
    negative: Tensor,
    gate_squared: Tensor | None,
    threshold: float,
    positive_scores: Tensor | None,
    negative_scores: Tensor | None,
    member: Tensor | None,
) -> None: ...

class PrimitiveTree:
    nbytes: int
    def __init__(self, vertices: Tensor, faces: Tensor, /) -> None: ...
    def hits(
        self,
        origins: Tensor,
        directions: Tensor,
        faces: Tensor,
        distances: Tensor,
        weights: Tensor,
        front: bool,
    ) -> None: ...

class VoxelGrid:
    nbytes: int
    def __init__(self, cells: Tensor, /) -> None: ...
    def find(self, cells: Tensor, rows: Tensor, /) -> None: ...
    def trace(
        self,
        origin: Tensor,
        directions: Tensor,
        near: float,
        far: float,
        depths: Tensor | None,
        hits: Tensor,
        weights: Tensor | None,
    ) -> None: ...

def add_hit_features(
    rows: Tensor,
    row_weight: Tensor,
    columns: Tensor,
    column_weight: Tensor,
    hits: Tensor,
    weights: Tensor | None,
    features: Tensor,
    view_means: bool,
    sums: Tensor,
    totals: Tensor,
) -> None: ...
def row_products(rows: Tensor, vectors: Tensor, out: Tensor) -> None: ...
def code_sums(codes: Tensor, tables: Tensor, out: Tensor) -> None: ...
