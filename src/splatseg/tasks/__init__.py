"""What a person asks for, as functions that take and return values and print nothing.

The command line, the viewer, notebooks and benchmarks call these. Progress and remarks go to an
`Observer`, which can also cancel.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
