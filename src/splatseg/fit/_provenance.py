"""What a scene remembers of its fit, as far as a refinement needs it to go on."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, cast

from splatseg.errors import InputError
from splatseg.fit._exposure import Exposure
from splatseg.fit._options import FitOptions

EXPOSURES = "exposures"
"""Key of a scene's provenance: gain and bias of each training view by its name."""

_TAKEN = (
    "background",
    "longest",
    "masks",
    "exposure",
    "exposure_rate",
    "exposure_prior",
    "depth",
    "depth_weight",
)
"""Options that say how photographs are compared. The rates are a refinement's own, and so is the
dissimilarity; poses are in the scene's cameras already."""


def refinement_options(provenance: Mapping[str, Any]) -> FitOptions:
    """How the photographs of a scene are to be compared when it is refined: as in its fit.

    Poses are not refined further: layers and evidence were made with those that the scene has.
    A scene that no fit made is taken as it is drawn: over black, masks without a meaning.

    Args:
        provenance: Of the scene.

    Raises:
        InputError: If an option was recorded with a value that it cannot have.
    """
    options = _table(provenance, "options")
    if not options:
        return FitOptions(background="black", masks="off")
    taken = {"masks": "off"} | {name: options[name] for name in _TAKEN if name in options}
    if isinstance(taken.get("background"), list):
        taken["background"] = tuple(cast("list[float]", taken["background"]))
    try:
        return FitOptions(**cast("dict[str, Any]", taken))
    except TypeError as error:
        raise InputError(
            f"scene: expected the options of a fit as its provenance, got {taken!r:.200}."
        ) from error


def exposures_record(exposures: Mapping[str, Exposure]) -> dict[str, Any]:
    """Exposures as JSON holds them, for the key `EXPOSURES`."""
    return {name: asdict(one) for name, one in exposures.items()}


def recorded_exposures(provenance: Mapping[str, Any]) -> dict[str, Exposure]:
    """The exposures of a scene's training views; empty where its fit learned none.

    Args:
        provenance: Of the scene.

    Raises:
        InputError: If something else is recorded in their place.
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
