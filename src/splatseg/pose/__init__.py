"""From photographs or a video to cameras and start points; see ``docs/poses.md``.

The names below load at first use: the process that does the work with pycolmap imports this
package too, and needs none of torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
