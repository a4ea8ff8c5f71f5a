"""The viewer: a scene segmented by hand, in a browser and from Python by the same commands."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
