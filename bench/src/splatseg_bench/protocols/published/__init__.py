"""Published figures of the field's benchmarks, one module a benchmark.

A figure is verified where it was read in the table of the paper that `source` names; that paper may
itself repeat others. Figures that contradict each other are all kept, and their notes say so.
"""

from types import MappingProxyType

from splatseg.errors import InputError, quoted
from splatseg_bench.protocols._protocol import PublishedFigure
from splatseg_bench.protocols.published import (
    _cosseg,
    _lerf_mask,
    _lerf_ovs,
    _nvos,
    _ovs_3d,
    _scannet,
    _spin_nerf,
    _streets,
    _views,
)

_FIGURES = MappingProxyType(
    {
        "nvos": _nvos.FIGURES,
        "spin-nerf": _spin_nerf.FIGURES,
        "spin-nerf-words": _spin_nerf.WORDS,
        "spin-nerf-ludvig": _spin_nerf.LUDVIG,
        "lerf-mask": _lerf_mask.FIGURES,
        "lerf-figurines-sa3d": _lerf_mask.SA3D_OBJECTS,
        "lerf-ovs-2d": _lerf_ovs.FIGURES_2D,
        "lerf-ovs-3d": _lerf_ovs.FIGURES_3D,
        "3d-ovs": _ovs_3d.FIGURES,
        "replica": _views.REPLICA,
        "replica-gaga": (),
        "scannet-19": _scannet.FIGURES_19,
        "scannet-15": _scannet.FIGURES_15,
        "scannet-10": _scannet.FIGURES_10,
        "scannet-views": _views.SCANNET,
        "scannet-gaga": (),
        "scannetpp": _views.SCANNETPP,
        "cosseg-replica-semantic": _cosseg.REPLICA_SEMANTIC,
        "cosseg-replica-panoptic": _cosseg.REPLICA_PANOPTIC,
        "cosseg-scannet-semantic": _cosseg.SCANNET_SEMANTIC,
        "cosseg-scannet-panoptic": _cosseg.SCANNET_PANOPTIC,
        "kitti360": _streets.KITTI360,
        "waymo": _streets.WAYMO,
    }
)


def published_figures(protocol: str) -> tuple[PublishedFigure, ...]:
    """What publications report under a protocol.

    Args:
        protocol: Its name, such as ``nvos``. ``lerf-figurines-sa3d`` is no benchmark, but one
            paper's comparison.

    Returns:
        Figures of papers that were read first, then others; none where none are known.

    Raises:
        InputError: If no protocol has this name.

    Example:
        >>> figure = published_figures("nvos")[4]
        >>> figure.method, figure.scores["iou"], figure.source
        ('SA3D', 0.903, 'SAGA, Table 1')
    """
    if protocol not in _FIGURES:
        raise InputError(
            f"protocol: expected one of {', '.join(_FIGURES)}, got {quoted(protocol)}."
        )
    return _FIGURES[protocol]
