"""Words as networks take them: checked, in a sentence, as classes, as tokens, as vectors."""

import hashlib
import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, cast

import torch

from splatseg.core import ClassInfo, ClassTable
from splatseg.core.models import CANONICAL_PHRASES, TextFeaturesWithWords
from splatseg.core.options import options
from splatseg.errors import FileFormatError, InputError, RangeError
from splatseg.io.evidence import TextEmbeddings
from splatseg.io.json_files import read_json
from splatseg.models._weights import Loading
from splatseg.models.networks._config import offline, refused_by_library
from splatseg.models.networks._library import library

_PLACE = "{}"


def checked_words(words: Sequence[str], *, needed: str | None = None) -> tuple[str, ...]:
    """Words without spaces around them, all different; at least one where somebody needs one."""
    found = tuple(word.strip() for word in words)
    if needed is not None and not found:
        raise InputError(
            f"words: {needed} looks for what words name, so expected at least one word "
            "(--words chair table), got none."
        )
    if "" in found:
        raise InputError("words: expected words or phrases, got an empty one.")
    for word in found:
        if found.count(word) > 1:
            raise InputError(f"words: expected distinct words, got {word!r} more than once.")
    return found


@options
class WordOptions:
    """Which words are looked for."""

    words: tuple[str, ...] = ()
    """Words or phrases to look for; classes 1, 2, ... in this order."""

    def __post_init__(self) -> None:
        checked_words(self.words)


@options
class WordVectorOptions:
    """How words come into the joint space of images and words."""

    words: tuple[str, ...] = ()
    """Words or phrases whose vectors are written beside the features, with the phrases that they
    are compared with (object, things, stuff, texture). They can be changed later at no cost."""

    template: str = "a photo of a {}"
    """Sentence that each word stands in, at {}."""

    def __post_init__(self) -> None:
        checked_words(self.words)
        if self.template.count(_PLACE) != 1:
            raise InputError(
                f"template: expected a sentence with {{}} once, where the word stands, "
                f"got {self.template!r:.80}."
            )


def in_sentences(words: Sequence[str], template: str) -> list[str]:
    """Words, each in its sentence."""
    return [template.replace(_PLACE, word) for word in words]


def word_classes(words: Sequence[str]) -> ClassTable:
    """Words as classes of things: the ids 1, 2, ... in the order of the words."""
    return ClassTable(
        rows=tuple(ClassInfo(id=i, name=word) for i, word in enumerate(words, start=1))
    )


def word_vectors(model: TextFeaturesWithWords) -> TextEmbeddings:
    """The vectors of a model's words, and of the phrases that words are compared with.

    A phrase that is one of the words itself is left out: nothing is more relevant than itself.
    """
    words = model.words
    phrases = tuple(phrase for phrase in CANONICAL_PHRASES if phrase not in words)
    labels = (*words, *phrases)
    return TextEmbeddings(
        labels=labels,
        vectors=torch.nn.functional.normalize(model.encode_text(labels).cpu().float(), dim=-1),
        kinds=("class",) * len(words) + ("negative",) * len(phrases),
        target_ids=(-1,) * len(labels),
    )


_FILES = (
    "tokenizer.json",
    "vocab.json",
    "merges.txt",
    "vocab.txt",
    "tokenizer.model",
    "spiece.model",
    "tokenizer_config.json",
    "special_tokens_map.json",
    "added_tokens.json",
)
"""What a tokenizer is read from, where it is there."""

_VOCABULARIES = ("tokenizer.json", "vocab.json", "vocab.txt", "tokenizer.model", "spiece.model")
"""One of these holds the tokens. Without any the library makes a tokenizer that knows no word."""

_MOST_GROWTH = 1 << 16
"""How many times as long a text may become on its way through a tokenizer."""

_EXPECTED = "the tokenizer of the weights"


class Tokens:
    """The tokenizer that lies beside a network's weights.

    Args:
        place: The weights.
        config: The network's, as the library has it: it says which tokenizer goes with it.
        longest: Most tokens that the network takes, those of begin and end included.
        **more: For the library's tokenizer.

    Raises:
        FileFormatError: If there is none, or it cannot be read.
    """

    def __init__(self, place: Loading, config: Any, *, longest: int, **more: Any) -> None:
        folder = self._folder = place.folder
        self._tokenizer = load_tokenizer(folder, config, **more)
        self._longest = longest
        self._known = getattr(getattr(config, "text_config", None), "vocab_size", None)
        self._device = place.device
        self.digest = _digest(folder)
        """SHA-256 over the tokenizer's files."""

    def __len__(self) -> int:
        """Tokens that it knows."""
        with self._reading():
            return len(self._tokenizer)

    def of(self, texts: Sequence[str], *, padded_to: int | None = None) -> dict[str, Any]:
        """Numbers of texts, as long as the longest of them.

        Args:
            texts: What is said.
            padded_to: Tokens that each is filled up to, for networks that learned so.

        Returns:
            ``input_ids`` and ``attention_mask``, (texts, tokens), on the network's device, and
            whatever else the tokenizer gives.

        Raises:
            RangeError: If a text has more tokens than the network takes.
            FileFormatError: If the tokenizer fails, or is of a network that knows more tokens.
        """
        self._check_lengths(texts)
        padding: dict[str, Any] = (
            {"padding": True}
            if padded_to is None
            else {"padding": "max_length", "max_length": padded_to}
        )
        with self._reading():
            found = self._tokenizer(list(texts), return_tensors="pt", **padding)
        largest = int(found["input_ids"].max())
        if self._known is not None and largest >= self._known:
            raise FileFormatError(
                f"{self._folder}: expected the tokenizer of a network that knows {self._known} "
                f"tokens, got one that gives number {largest}."
            )
        return {name: values.to(self._device) for name, values in found.items()}

    def spans(self, text: str) -> list[tuple[int, int]]:
        """Where in a text each of its tokens stands: first character, and the one after the last.

        Both are 0 for a token of begin or end.

        Raises:
            RangeError: If the text has more tokens than the network takes.
            FileFormatError: If the tokenizer does not know it.
        """
        self._check_lengths([text])
        if not self._tokenizer.is_fast:
            raise FileFormatError(
                "tokenizer: expected one that tells where tokens stand (tokenizer.json), got one "
                "that does not."
            )
        with self._reading():
            found = self._tokenizer(text, return_offsets_mapping=True)["offset_mapping"]
        return [(int(start), int(end)) for start, end in found]

    def _check_lengths(self, texts: Sequence[str]) -> None:
        for text in texts:
            # Longer than the tokenizer's own limit is news to the library, and an error here.
            with self._reading():
                count = len(self._tokenizer(text, verbose=False)["input_ids"])
            if count > self._longest:
                raise RangeError(
                    f"words: expected at most {self._longest} tokens, got {count} for {text!r:.60}."
                )

    def _reading(self) -> AbstractContextManager[None]:
        """What is damaged in a tokenizer may show when it is asked."""
        return refused_by_library(self._folder, _EXPECTED)


def load_tokenizer(folder: Path, config: Any, *, kind: str = "AutoTokenizer", **more: Any) -> Any:
    """The library's tokenizer of a folder of weights.

    Args:
        folder: The weights.
        config: The network's, as the library has it; None where the kind says what it is.
        kind: Class of the library.
        **more: For that class.
    """
    if not any((folder / name).is_file() for name in _VOCABULARIES):
        raise FileFormatError(
            f"{folder}: expected a tokenizer beside the weights (tokenizer.json), got none."
        )
    # A tokenizer of one version of the library may lie beside that of all others.
    for path in sorted(folder.glob("tokenizer*.json")):
        _check_growth(path)
    with offline(), refused_by_library(folder, _EXPECTED):
        known = {} if config is None else {"config": config, "trust_remote_code": False}
        return getattr(library(), kind).from_pretrained(
            folder, local_files_only=True, **known, **more
        )


def _check_growth(path: Path) -> None:
    """Refuse steps that each make a text longer, so that no memory holds what comes out.

    The library of tokenizers is written in Rust, and ends the process where there is none left.
    """
    content = read_json(path)
    steps: list[object] = [content.get("normalizer"), content.get("post_processor")]
    growth = 1.0
    while steps:
        step = steps.pop()
        if isinstance(step, list):
            steps += cast("list[object]", step)
        elif isinstance(step, dict):
            known = cast("dict[str, Any]", step)
            steps += [known.get("normalizers"), known.get("processors")]
            pieces = [known.get(name) for name in ("content", "prepend", "single")]
            growth *= math.prod(1.0 + len(one) for one in pieces if isinstance(one, str | list))
    if growth > _MOST_GROWTH:
        raise FileFormatError(
            f"{path}: expected steps that make a text at most {_MOST_GROWTH} times as long, got "
            f"such as make it {growth:.3g} times as long."
        )


def _digest(folder: Path) -> str:
    digest = hashlib.sha256()
    for name in _FILES:
        path = folder / name
        if path.is_file():
            content = hashlib.sha256(path.read_bytes()).hexdigest()
            digest.update(f"{name}\0{content}\0".encode())
    return digest.hexdigest()
