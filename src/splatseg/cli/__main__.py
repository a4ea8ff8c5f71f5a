"""``python -m splatseg.cli``: the same as the installed `splatseg` script."""

import sys

from splatseg.cli import main

sys.exit(main())
