"""Weights in formats that we read ourselves, and what lies beside those of the library: loaded, and
asked about a small picture."""

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path

from splatseg.models.hed import read_network
from support import checkpoints_hed
from support.fuzz.targets.base import Target, target
from support.networks import KINDS, asked, checkpoint, in_parts


def _target(name: str, kind: str, file: str) -> Callable[[Path], Target]:
    @target(name)
    def make(folder: Path) -> Target:
        family, _ = KINDS[kind]
        path = checkpoint(*KINDS[kind], folder)
        if file == "preprocessor_config.json":
            content = {"size": {"height": 64, "width": 64}, "image_std": [0.5, 0.5, 0.5]}
            (path / file).write_text(json.dumps(content | {"ensure_multiple_of": 16}))
        elif file.endswith("index.json"):
            in_parts(path)
        return Target(file=path / file, read=lambda: asked(family, path))

    return make


if importlib.util.find_spec("h5py") is not None:

    @target("weights-hed")
    def weights_hed(folder: Path) -> Target:
        content = checkpoints_hed.tensors((2, 2, 2, 2, 2))
        path = checkpoints_hed.write(folder / "tiny.weights.h5", content)
        return Target(file=path, read=lambda: read_network(path))


if importlib.util.find_spec("transformers") is not None:
    import transformers  # noqa: F401  (once, and not in each process that is forked from here)

    for _name in KINDS:
        _target(f"config-{_name}", _name, "config.json")
    for _name in ("clipseg", "grounding-dino", "oneformer"):
        _target(f"tokenizer-{_name}", _name, "tokenizer.json")
        _target(f"tokenizer-config-{_name}", _name, "tokenizer_config.json")
    for _name in ("clipseg", "dpt", "oneformer"):
        _target(f"images-{_name}", _name, "preprocessor_config.json")
    _target("weights-index", "dinov2", "model.safetensors.index.json")
