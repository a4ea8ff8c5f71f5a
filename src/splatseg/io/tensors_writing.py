"""Tensors by name, written as safetensors: a JSON header, then the bytes."""

import json
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from splatseg.errors import InputError
from splatseg.io.atomic import atomic_file
from splatseg.io.tensors import SAFETENSORS_NAMES

_ALIGNED = 8
"""Bytes that the header's length is a multiple of, so that numbers stand at even places."""


def write_tensors(
    tensors: Mapping[str, Tensor], path: Path, *, metadata: Mapping[str, str]
) -> None:
    """Write tensors to a ``.safetensors`` file; the same values give the same bytes.

    `splatseg.io.tensors.read_safetensors` is the inverse.

    Args:
        tensors: By name, of types that `read_tensors` reads, in the order in which they are
            written.
        path: The file.
        metadata: Text about them.

    Raises:
        InputError: If the name does not end in ``.safetensors``, or a tensor has another type.
        MissingFileError: If the folder of `path` does not exist.
        OutputError: If it cannot be written.
    """
    if path.suffix != ".safetensors":
        raise InputError(f"{path}: expected .safetensors, got {path.suffix or 'no suffix'}.")
    header: dict[str, object] = {"__metadata__": dict(metadata)} if metadata else {}
    end = 0
    for name, tensor in tensors.items():
        kind = SAFETENSORS_NAMES.get(tensor.dtype)
        if kind is None:
            raise InputError(f"{name}: expected a type of safetensors, got {tensor.dtype}.")
        begin, end = end, end + tensor.numel() * tensor.element_size()
        header[name] = {"dtype": kind, "shape": list(tensor.shape), "data_offsets": [begin, end]}
    words = json.dumps(header, separators=(",", ":")).encode()
    words += b" " * (-len(words) % _ALIGNED)
    with atomic_file(path) as temporary, temporary.open("wb") as file:
        file.write(len(words).to_bytes(8, "little"))
        file.write(words)
        for tensor in tensors.values():
            values = tensor.detach().cpu().contiguous().reshape(-1)
            file.write(values.view(torch.uint8).numpy().tobytes())
