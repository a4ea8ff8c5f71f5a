"""One signal after another rendered in a prepared view, and read on the CPU."""

import torch
from jaxtyping import Float
from torch import Tensor

from splatseg.core import Gaussians
from splatseg.render import PreparedView, Rendered
from splatseg.render.warp import WarpMode


class ViewRenderer:
    """Renders signals of Gaussians in one view, without gradients.

    Args:
        gaussians: The Gaussians of the view.
        view: The view; it stays open as long as this is used.
    """

    def __init__(self, gaussians: Gaussians, view: PreparedView) -> None:
        self._gaussians = gaussians
        self._view = view

    @property
    def view(self) -> PreparedView:
        """The view itself."""
        return self._view

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self._view.camera.height, self._view.camera.width

    def render(
        self, signal: Float[Tensor, "n channels"] | None, *, warp: WarpMode = "bilinear"
    ) -> Rendered:
        """``W @ signal``, on the device of the Gaussians; None is the colour."""
        on_device = None if signal is None else signal.to(self._gaussians.means)
        with torch.no_grad():
            return self._view.render(on_device, warp=warp)

    def scores(
        self, signal: Float[Tensor, "n channels"], *, warp: WarpMode = "bilinear"
    ) -> tuple[Float[Tensor, "height width channels"], Float[Tensor, "height width"]]:
        """The image and alpha."""
        rendered = self.render(signal, warp=warp)
        return rendered.image.float().cpu(), rendered.alpha.float().cpu()
