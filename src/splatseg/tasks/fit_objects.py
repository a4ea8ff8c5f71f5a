"""The evidence of objects that a fit learns from beside the photographs."""

from pathlib import Path

from splatseg.core import Capture, Gaussians, InstanceTree, LabelSource
from splatseg.errors import InputError
from splatseg.fit import FitOptions
from splatseg.io.digests import digest, file_mark
from splatseg.io.evidence import check_map_sizes, find_evidence, open_evidence
from splatseg.lift import EvidenceSegments, MatchedMaps, ObjectLabels, ReducedMaps, complete
from splatseg.methods.associate import associate


def object_labels(
    capture: Capture, asked: str, *, scene: Path, options: FitOptions, backend: str
) -> ObjectLabels:
    """What `fit` learns objects from.

    Label maps count as they are, with no more pixels than the photographs of the fit. Segments
    (masks, panoptic maps, tracks) are associated on the Gaussians as they are when labels are
    decided first, and take the ids of that layer.

    Args:
        capture: The capture of the fit.
        asked: Folder of the evidence, or its name.
        scene: The scene folder that the fit writes; one that is there may have the evidence.
        options: Of the fit.
        backend: Rendering backend.

    Raises:
        InputError: If there is no such evidence, it is of another kind or of other views.
        FileFormatError: If a label map is much larger than its photograph.
    """
    folder = Path(asked)
    if not folder.is_dir():
        folder = find_evidence([capture.path, scene], asked)
    evidence = open_evidence(folder)
    known = set(evidence.view_names)
    views = [view for view in capture.train_views if view.name in known and view.image is not None]
    check_map_sizes(evidence, views)
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    mark = digest((str(path.relative_to(folder)), file_mark(path)) for path in files)
    if evidence.kind == "labels":
        maps = ReducedMaps(source=evidence, longest_side=options.longest)
        return ObjectLabels(views, maps, digest=mark, backend=backend)
    if evidence.kind not in ("masks", "panoptic", "tracked"):
        raise InputError(
            f"{folder}: expected label maps or segments of objects (masks, panoptic, tracked), "
            f"got {evidence.kind}."
        )
    segments = EvidenceSegments(evidence=evidence)

    def matched(gaussians: Gaussians) -> LabelSource:
        found = associate(gaussians, views, segments, backend=backend)
        layer = found.cut() if isinstance(found, InstanceTree) else found
        layer = complete(gaussians, layer)
        return MatchedMaps(
            gaussians=gaussians,
            views=views,
            source=segments,
            labels=layer,
            longest_side=options.longest,
            backend=backend,
        )

    return ObjectLabels(views, evidence, matched=matched, digest=mark, backend=backend)
