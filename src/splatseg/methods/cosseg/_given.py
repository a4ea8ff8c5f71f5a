"""What is decoded from: features on Gaussians, and the point network."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Int64
from torch import Tensor

from splatseg.core import Gaussians
from splatseg.core.rigid import upright
from splatseg.errors import InputError
from splatseg.lift.point_network import (
    PointEncoder,
    SpatialOptions,
    load_point_encoder,
    scene_options,
)
from splatseg.methods._trained import LabelData, TrainingContext
from splatseg.methods.cosseg._blocks import BlockSource
from splatseg.methods.cosseg._distilled import (
    DistilledFeatures,
    distilled_features,
    pixel_counts,
)
from splatseg.methods.cosseg._options import CossegOptions
from splatseg.methods.cosseg._points import (
    PointSource,
    RawPoints,
    boxes,
    check_decoded,
    joined_blocks,
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Given:
    """What is decoded from."""

    gaussians: Gaussians
    chosen: Int64[Tensor, "m"]
    distilled: DistilledFeatures | None
    encoder: PointEncoder | None
    source: PointSource
    is_scale_assumed: bool
    """Whether the scene's scale was told by how dense its points are."""

    options: CossegOptions

    def points_of(self, chosen: Int64[Tensor, "m"]) -> RawPoints:
        """What stands beside some Gaussians."""
        if self.options.points != "blocks" or self.encoder is None:
            return self.source.raw(chosen)
        means = self.gaussians.means.detach().cpu()
        parts = boxes(means, chosen, self.options.block_points)
        return joined_blocks([self.source.raw(part) for part in parts])

    @property
    def settings(self) -> dict[str, Any]:
        """What else must be the same to resume."""
        digest = hashlib.sha256()
        for scale in () if self.distilled is None else self.distilled.scales:
            digest.update(scale.numpy().tobytes())
        encoder = hashlib.sha256()
        for value in () if self.encoder is None else self.encoder.encoder.state_dict().values():
            encoder.update(value.numpy().tobytes())
        return {"distilled": digest.hexdigest(), "point network": encoder.hexdigest()}


def prepare(
    gaussians: Gaussians,
    data: LabelData,
    features: BlockSource | None,
    *,
    options: CossegOptions,
    context: TrainingContext,
    frame: tuple[float | None, tuple[float, float, float] | None],
) -> Given:
    """Lift features, count pixels and load the point network, as far as they are asked for.

    Args:
        gaussians: The Gaussians of the scene.
        data: Label maps and their views.
        features: Several blocks of a network for the same views; None for none.
        options: What is asked for.
        context: Render options, backend and seed.
        frame: Metres per unit and the direction up; None for what is not known.

    Raises:
        InputError: If what is asked for is not there.
    """
    if features is None and options.semantic != "none" and options.spatial == "none":
        raise InputError("features: expected evidence of features to decode, got none.")
    chosen, counts = torch.arange(len(gaussians)), None
    if options.min_pixels > 0 or (options.division == "pixels" and features is not None):
        counts = pixel_counts(
            gaussians,
            data.views,
            render_options=context.render_options,
            backend=context.backend,
        )
        chosen = check_decoded(counts >= options.min_pixels, options.min_pixels)
    distilled = None
    if features is not None and options.semantic != "none":
        distilled = distilled_features(
            gaussians,
            data.views,
            features,
            components=options.components,
            division=options.division,
            pixels=counts,
            longest_side=options.lifted_side,
            render_options=context.render_options,
            backend=context.backend,
        )
    encoder, space = None, SpatialOptions(metres_per_unit=frame[0], precision="float16")
    if options.spatial != "none":
        encoder = load_point_encoder(options.encoder)
        means = upright(gaussians.means.detach().cpu()[chosen], frame[1])
        space = scene_options(encoder, means, options=space, seed=context.seed)
    scales: Sequence[Tensor] = () if distilled is None else distilled.scales
    if options.semantic == "first":
        scales = scales[:1]
    return Given(
        gaussians=gaussians,
        chosen=chosen,
        distilled=distilled,
        encoder=encoder,
        is_scale_assumed=frame[0] is None,
        source=PointSource(
            gaussians=gaussians,
            scales=scales,
            encoder=encoder,
            spatial=options.spatial,
            space=space,
            up=frame[1],
            seed=context.seed,
        ),
        options=options,
    )
