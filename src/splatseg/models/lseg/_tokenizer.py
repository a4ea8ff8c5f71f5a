"""CLIP's byte-pair tokens of words, by its vocabulary on this machine."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Int64
from torch import Tensor

from splatseg.errors import FileFormatError, InputError, MissingFileError
from splatseg.models._weights import cached_file
from splatseg.models.networks._config import offline, refused_by_library
from splatseg.models.networks._library import library

_WHOLE = "tokenizer.json"
_PARTS = ("vocab.json", "merges.txt")
PUBLISHED = "openai/clip-vit-base-patch32"


def tokenizer_folder(asked: str | None, weights: Path) -> Path:
    """The folder of the vocabulary: the one asked for, else that of the weights.

    Args:
        asked: A folder, or an id of the hub, of which only what is on this machine is taken.
        weights: The folder of the weights.

    Raises:
        MissingFileError: If there is no vocabulary.
    """
    folder = weights if asked is None else Path(asked)
    if _is_tokenizer(folder):
        return folder
    if asked is None:
        raise MissingFileError(
            f"{weights}: expected CLIP's vocabulary beside the weights ({_WHOLE}, or "
            f"{' and '.join(_PARTS)}), got none; --tokenizer takes a folder, or the id "
            f"{PUBLISHED} where the hub's cache has it."
        )
    if not folder.exists() and asked.count("/") == 1:
        found = cached_file(asked, _WHOLE) or cached_file(asked, _PARTS[0])
        if found is not None and _is_tokenizer(found.parent):
            return found.parent
    raise MissingFileError(
        f"tokenizer: expected a folder with {_WHOLE}, or {' and '.join(_PARTS)}, or an id whose "
        f"files the hub's cache of this machine has, got {asked}."
    )


def _is_tokenizer(folder: Path) -> bool:
    return (folder / _WHOLE).is_file() or all((folder / name).is_file() for name in _PARTS)


class Tokenizer:
    """Words as tokens."""

    def __init__(self, folder: Path, *, vocabulary: int, context: int) -> None:
        """Read a vocabulary.

        Args:
            folder: Where it is.
            vocabulary: Tokens that the network knows.
            context: Most tokens of a text that it takes.

        Raises:
            FileFormatError: If the vocabulary is broken, or of another network.
        """
        cls = library().CLIPTokenizer
        with offline(), refused_by_library(folder, "the vocabulary of CLIP"):
            self._tokenizer: Any = cls.from_pretrained(folder, local_files_only=True)
            size = len(self._tokenizer)
        if size != vocabulary:
            raise FileFormatError(
                f"{folder}: expected a vocabulary of {vocabulary} tokens, as the weights have, "
                f"got {size}."
            )
        self._context = context

    def tokens(self, words: Sequence[str]) -> tuple[Int64[Tensor, "n tokens"], Int64[Tensor, "n"]]:
        """Tokens of each text, filled up with zeros, and the index of its last one.

        Raises:
            InputError: If a text has more tokens than the network takes.
        """
        found = [[int(token) for token in self._tokenizer(word)["input_ids"]] for word in words]
        for word, ids in zip(words, found, strict=True):
            if len(ids) > self._context:
                raise InputError(
                    f"words: expected texts of at most {self._context} tokens, got {len(ids)} "
                    f"({word!r:.60})."
                )
        last = torch.tensor([len(ids) - 1 for ids in found])
        filled = torch.zeros(len(found), max(map(len, found)), dtype=torch.int64)
        for row, ids in zip(filled, found, strict=True):
            row[: len(ids)] = torch.tensor(ids)
        return filled, last
