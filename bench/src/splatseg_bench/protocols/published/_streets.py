"""The paper of the mesh field: Table 1 (points) and Table 2 (views)."""

from splatseg_bench.protocols._catalogue import TABLE_1
from splatseg_bench.protocols._protocol import PublishedFigure
from splatseg_bench.protocols.published._rows import Table

_PAPER = "Semantic DNMP"
_POINTS = Table(
    protocol="kitti360",
    measures=("miou", *TABLE_1),
    source=f"{_PAPER}, Table 1",
    verified=True,
)
_OURS = (51.7, 87.9, 63.8, 73.3, 36.3, 35.3, 26.1, 30.2, 39.0, 85.6, 21.3, 78.0, 67.6, 27.6)
_STREET_GAUSSIANS = (
    43.5, 75.3, 56.0, 45.6, 27.9, 40.5, 19.5, 12.3, 25.2, 77.1, 26.3, 72.4, 57.8, 30.2,
)  # fmt: skip
_OPEN = "Two segments that are not named; of which data set is not said, and taken to be this one."
_REGION = f"{_OPEN} Points by region voting on centres of Gaussians."
_LABELS = "Labels of images by Tao et al. 2020."


def _views(data: str, ours: tuple[float, ...], theirs: tuple[float, ...]) -> list[PublishedFigure]:
    table = Table(
        protocol=data,
        measures=("psnr", "ssim", "view_miou"),
        source=f"{_PAPER}, Table 2",
        verified=True,
    )
    rows = (("DNMP with semantics", ours), ("StreetGaussians", theirs))
    return [
        table.row(name, psnr, 100 * ssim, 100 * miou, note=f"Two segments. {_LABELS}")
        for name, (psnr, ssim, miou) in rows
    ]


KITTI360 = (
    _POINTS.row("DNMP with semantics", *_OURS, note=f"{_OPEN} {_LABELS}"),
    _POINTS.row("StreetGaussians", *_STREET_GAUSSIANS, note=f"{_REGION} {_LABELS}"),
    *_views("kitti360", (23.01, 0.852, 0.705), (25.44, 0.840, 0.688)),
)

WAYMO = (*_views("waymo", (29.31, 0.916, 0.621), (33.27, 0.920, 0.609)),)
