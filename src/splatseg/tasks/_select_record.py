"""Prompts as the record of a layer holds them."""

from splatseg.core import JSON
from splatseg.prompting.prompts import AxisBox, Ball, Lasso, SelectionPrompt, Similar


def prompt_record(prompt: SelectionPrompt) -> dict[str, JSON]:
    """What a prompt says, in values that JSON holds; of masks and strokes, how many pixels."""
    match prompt:
        case AxisBox():
            return {"kind": "box", "low": list(prompt.low), "high": list(prompt.high)}
        case Ball():
            return {"kind": "sphere", "centre": list(prompt.centre), "radius": prompt.radius}
        case Lasso():
            corners: list[JSON] = [[float(v) for v in corner] for corner in prompt.polygon.tolist()]
            return {"kind": "lasso", "view": prompt.view.name, "polygon": corners}
        case Similar():
            return {"kind": "similar", "gaussians": prompt.selection.count}
        case _:
            pass
    record: dict[str, JSON] = {"kind": "view", "view": prompt.view.name}
    for name, wanted in (("points", True), ("negative_points", False)):
        chosen = prompt.points[prompt.signs == wanted].tolist()
        if chosen:
            record[name] = [[float(x), float(y)] for x, y in chosen]
    if prompt.box is not None:
        record["box"] = [float(v) for v in prompt.box.tolist()]
    for name in ("mask", "scribble", "negative_scribble"):
        pixels = getattr(prompt, name)
        if pixels is not None:
            record[f"{name}_pixels"] = int(pixels.sum())
    return record
