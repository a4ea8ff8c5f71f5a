"""What the ids of a layer mean, and whether others mean the same by them."""

from splatseg.core import LabelSource, RenderableLayer
from splatseg.io.evidence import Evidence


def ids_agree(layer: RenderableLayer, source: LabelSource, *, otherwise: bool) -> bool:
    """Whether ids of a layer mean what a source of maps means by them.

    They do where every name that the layer has is the source's name of the same id. Where one
    of them has no names, `otherwise` says.
    """
    named = layer.info.names
    table = source.classes if isinstance(source, Evidence) else None
    if table is None or not table.rows or not named:
        return otherwise
    present = set(layer.ids)
    theirs = {row.id: row.name for row in table.rows}
    return all(theirs.get(id) == name for id, name in named.items() if id in present)


def ids_are_classes(evidence: LabelSource | None) -> bool:
    """Whether a layer made of this evidence has class ids, as far as the evidence tells."""
    return not isinstance(evidence, Evidence) or evidence.kind == "labels"
