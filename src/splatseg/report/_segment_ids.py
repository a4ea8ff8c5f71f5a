"""What the ids of a layer mean, and whether others mean the same by them."""

from splatseg.core import ClassInfo, ClassTable, LabelSource, RenderableLayer
from splatseg.io.evidence import Evidence
from splatseg.report.legend import colour_of


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


def class_table(
    layer: RenderableLayer, classes: ClassTable | None, *, unnamed_are_classes: bool
) -> ClassTable:
    """Names and colours of the ids in use.

    Args:
        layer: The layer. Its own names come first.
        classes: Of the scene. Their colours are taken where id and name agree.
        unnamed_are_classes: A layer without names has the ids of these classes.
    """
    named = layer.info.names
    theirs = {row.id: row for row in classes.rows} if classes is not None else {}
    rows: list[ClassInfo] = []
    for id in layer.ids:
        row = theirs.get(id)
        name = named.get(id, f"id {id}")
        if not named and unnamed_are_classes and row is not None:
            name = row.name
        colour = row.colour if row is not None and row.name == name else None
        rows.append(ClassInfo(id=id, name=name, colour=colour or colour_of(id)))
    return ClassTable(rows=tuple(rows))
