"""What a scene records of its fit, for a later refinement."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, cast

from splatseg.core.boundary import boundary
from splatseg.errors import InputError
from splatseg.fit._exposure import Exposure
from splatseg.fit._options import FitOptions

EXPOSURES = "exposures"
"""Key of a scene's provenance: gain and bias of each training view by its name."""

_COMPARISON_OPTIONS = (
    "background",
    "longest",
    "masks",
    "exposure",
    "exposure_rate",
    "exposure_prior",
    "depth",
    "depth_weight",
)
"""Options of the comparison with photographs. Learning rates and the weight of D-SSIM are the
refinement's own; refined poses are in the scene's cameras already."""


@boundary
def refinement_options(provenance: Mapping[str, Any]) -> FitOptions:
    """Options to refine a scene with: photographs are compared as in its fit.

    Poses are not refined further: layers and evidence were made with those of the scene. A scene
    that was not made by a fit is rendered over black, and masks are not used.

    Args:
        provenance: The provenance of the scene.

    Raises:
        InputError: If an option was recorded with an invalid value.
    """
    options = _table(provenance, "options")
    if not options:
        return FitOptions(background="black", masks="off")
    comparison = {"masks": "off"} | {
        name: options[name] for name in _COMPARISON_OPTIONS if name in options
    }
    if isinstance(comparison.get("background"), list):
        comparison["background"] = tuple(cast("list[float]", comparison["background"]))
    try:
        return FitOptions(**cast("dict[str, Any]", comparison))
    except TypeError as error:
        raise InputError(
            f"scene: expected the options of a fit as its provenance, got {comparison!r:.200}."
        ) from error


@boundary
def exposures_record(exposures: Mapping[str, Exposure]) -> dict[str, Any]:
    """Exposures as JSON values, for the key `EXPOSURES`."""
    return {name: asdict(exposure) for name, exposure in exposures.items()}


@boundary
def recorded_exposures(provenance: Mapping[str, Any]) -> dict[str, Exposure]:
    """The exposures of a scene's training views; empty where its fit had none.

    Args:
        provenance: The provenance of the scene.

    Raises:
        InputError: If the record has another form.
    """
    found: dict[str, Exposure] = {}
    for name, value in _table(provenance, EXPOSURES).items():
        try:
            red, green, blue = value["gain"]
            biases = value["bias"]
            found[name] = Exposure(
                gain=(float(red), float(green), float(blue)),
                bias=(float(biases[0]), float(biases[1]), float(biases[2])),
            )
        except (TypeError, KeyError, ValueError, IndexError) as error:
            raise InputError(
                f"scene: expected gain and bias, three numbers each, as the exposure of view "
                f"{name!r}, got {value!r:.80}."
            ) from error
    return found


def _table(provenance: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = provenance.get(key)
    return cast("Mapping[str, Any]", value) if isinstance(value, Mapping) else {}
