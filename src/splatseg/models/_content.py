"""Which view an image shows, by its content."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field

from splatseg.core import View
from splatseg.core.models import Image
from splatseg.errors import InputError
from splatseg.io.images import load_image


def image_digest(image: Image) -> str:
    """A digest of an image's size and pixels."""
    array = image.detach().cpu().contiguous().numpy()
    digest = hashlib.sha256(repr((array.shape, array.dtype.str)).encode())
    digest.update(array.data)
    return digest.hexdigest()


@dataclass(frozen=True, slots=True, eq=False)
class ViewsByContent:
    """Names of views by the digest of their photographs, read when first needed."""

    views: Sequence[View] = ()
    _digests: dict[str, str] = field(default_factory=dict[str, str], init=False, repr=False)

    def name_of(self, image: Image) -> str:
        """The view that an image shows.

        Raises:
            InputError: If none of the views has exactly this photograph.
        """
        if not self.views:
            raise InputError(
                "view: expected the name of the view that the image shows, since the recorded "
                "model was opened without views to find it among."
            )
        digest = image_digest(image)
        for view in self.views[len(self._digests) :]:
            if digest in self._digests.values():
                break
            self._digests[view.name] = image_digest(load_image(view))
        for name, known in self._digests.items():
            if known == digest:
                return name
        height, width = (int(s) for s in image.shape[:2])
        raise InputError(
            f"image: expected the photograph of one of {len(self.views)} views as load_image "
            f"gives it, got another image of {width}x{height}; name the view with view=."
        )
