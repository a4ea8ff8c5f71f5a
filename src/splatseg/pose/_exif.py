r"""What the EXIF data of a photograph say about its lens.

With the focal length in terms of 35 mm film :math:`f_{35}`, whose frame has a diagonal of
:math:`\sqrt{36^2 + 24^2} = 43.27` mm, the focal length in pixels is

.. math:: f = f_{35} \, \frac{\sqrt{w^2 + h^2}}{43.27}.

Else it is the focal length in millimetres times the pixels of the sensor for a millimetre
(tag FocalPlaneXResolution), scaled by how much smaller the photograph was made since.

References: CIPA DC-008 (Exif 2.32), tags FocalLengthIn35mmFilm and FocalPlaneXResolution.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from PIL import Image

_MAKE, _MODEL, _EXIF_IFD = 0x010F, 0x0110, 0x8769
_FOCAL, _FOCAL_35, _LENS_MODEL = 0x920A, 0xA405, 0xA434
_WIDTH, _HEIGHT = 0xA002, 0xA003
_PLANE_X, _PLANE_UNIT = 0xA20E, 0xA210
_MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_DIAGONAL_35 = math.hypot(36.0, 24.0)
# Fields of view from 6 to 118 degrees; anything else is a tag that was filled with nonsense.
_PLAUSIBLE = (0.3, 10.0)
_SAME_SHAPE = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class LensFacts:
    """What EXIF data say of a lens."""

    identity: tuple[str, ...]
    """Make, model, lens and focal lengths; all empty where there are no such data."""

    focal: float | None
    """Focal length in pixels of the photograph as it is now; None where the data do not say."""


def lens_facts(image: Image.Image) -> LensFacts:
    """What the EXIF data of an opened image say of its lens."""
    if image.format == "PNG" and "exif" not in image.info:
        # Pillow would decode the whole image to look for them behind the pixels.
        return LensFacts(identity=("",) * 5, focal=None)
    exif = image.getexif()
    detail: Mapping[int, Any] = exif.get_ifd(_EXIF_IFD)
    identity = tuple(
        str(tags.get(tag, "")).strip("\0 ")
        for tags, tag in (
            (exif, _MAKE),
            (exif, _MODEL),
            (detail, _LENS_MODEL),
            (detail, _FOCAL),
            (detail, _FOCAL_35),
        )
    )
    return LensFacts(identity=identity, focal=_focal(detail, *image.size))


def _focal(detail: Mapping[int, Any], width: int, height: int) -> float | None:
    taken = (_number(detail, _WIDTH), _number(detail, _HEIGHT))
    if taken[0] and taken[1]:
        # Either may have been turned; the shape of an uncropped image is the same.
        now, then = max(width, height) / min(width, height), max(taken) / min(taken)
        if abs(now - then) > _SAME_SHAPE * then:
            return None
    focal = 0.0
    if film := _number(detail, _FOCAL_35):
        focal = film * math.hypot(width, height) / _DIAGONAL_35
    elif taken[0] and taken[1]:
        millimetre = _MILLIMETRES.get(int(_number(detail, _PLANE_UNIT) or 2), 0.0)
        density = _number(detail, _PLANE_X)
        if millimetre:
            scale = max(width, height) / max(taken)
            focal = _number(detail, _FOCAL) * density / millimetre * scale
    low, high = (factor * max(width, height) for factor in _PLAUSIBLE)
    return focal if low <= focal <= high else None


def _number(tags: Mapping[int, Any], tag: int) -> float:
    """A number of EXIF data; 0 where it lacks or is none, as cameras write for "unknown"."""
    try:
        value = float(tags.get(tag, 0))
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return value if math.isfinite(value) and value > 0 else 0.0
