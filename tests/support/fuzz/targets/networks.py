"""config.json of every family of networks: loaded, and asked about a small picture."""

import importlib.util
from collections.abc import Callable
from pathlib import Path

from support.fuzz.targets.base import Target, target
from support.networks import KINDS, asked, checkpoint


def _target(name: str, family: str, kind: str) -> Callable[[Path], Target]:
    @target(f"config-{name}")
    def make(folder: Path) -> Target:
        path = checkpoint(family, kind, folder)
        return Target(file=path / "config.json", read=lambda: asked(family, path))

    return make


if importlib.util.find_spec("transformers") is not None:
    import transformers  # noqa: F401  (once, and not in each process that is forked from here)

    for _name, (_family, _kind) in KINDS.items():
        _target(_name, _family, _kind)
