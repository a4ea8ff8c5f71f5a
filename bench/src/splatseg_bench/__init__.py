"""Published benchmarks for splatseg: layouts of data sets, protocols as data, runs and tables.

The names below load at first use. ``docs/benchmarks.md`` describes them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
