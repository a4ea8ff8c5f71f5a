"""config.json of weights, held against what the network's own may say, before any library sees it.

The file comes with the weights, from anywhere, and transformers does what it says: it fetches and
runs kernels and networks by name, imports packages, and builds layers without end. So
`_config_keys` has what may stand in it; everything else is refused, or left out where it changes no
answer.
"""

import importlib
import json
import math
import re
import tempfile
import threading
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn, cast

from splatseg.core.coerce import as_text
from splatseg.errors import FileFormatError, quoted
from splatseg.io.foreign import made_from, reading
from splatseg.io.json_files import read_json
from splatseg.models.networks._config_keys import FLAGS, NUMBERS, PARTS, WORDS, Numbers

_LOADING = threading.RLock()
_LARGEST = 1 << 22
"""Bytes of a configuration; those of networks that tell 21 000 classes have about a million."""

_MOST_CLASSES = 65535
"""As many as label maps have ids."""

_MOST_ENTRIES = 128
_STAGE = re.compile(r"stem|stage\d{1,3}")
_DIGITS = re.compile(r"\d{1,5}")
_TYPES = ("float32", "float16", "bfloat16", "float64", "auto")
_ATTENTIONS = ("eager", "sdpa")
_BACKBONE = "backbone_config"
"""Left out where a part has none: MaskFormer's decoder is DETR's, which has one."""


def checked_config(path: Path, kinds: tuple[str, ...]) -> dict[str, Any]:
    """What a configuration says of a network, without what it may not and need not say.

    Args:
        path: config.json.
        kinds: Values of ``model_type`` that are taken.

    Raises:
        FileFormatError: If it is of another network, or says what no network's may.
    """
    with reading(path, "the configuration of a network"):
        size = path.stat().st_size if path.is_file() else 0
    if size > _LARGEST:
        raise FileFormatError(
            f"{path}: expected a configuration of at most {_LARGEST} bytes, got {size}."
        )
    content = read_json(path)
    kind = content.get("model_type")
    if not isinstance(kind, str) or kind not in kinds:
        raise FileFormatError(
            f"{path}: expected weights of {' or '.join(kinds)}, got those of {quoted(kind)}."
        )
    return _Checked(path).part(content, kind, "")


def library_config(path: Path, content: Mapping[str, Any], cls: Any, **options: Any) -> Any:
    """The library's own configuration of a network, out of checked content.

    Args:
        path: Where the content is from; starts the message of an error.
        content: What `checked_config` gives.
        cls: The network's class in the library.
        options: Instead of what it says.

    Returns:
        The configuration, and those of the options that it has no place for.

    Raises:
        FileFormatError: If the library cannot make a network of it.
    """
    with tempfile.TemporaryDirectory(prefix="splatseg-config-") as folder, offline():
        (Path(folder) / "config.json").write_text(json.dumps(content), encoding="utf-8")
        with refused_by_library(path, f"a configuration of {cls.__name__}"):
            return cls.config_class.from_pretrained(
                folder, return_unused_kwargs=True, local_files_only=True, **options
            )


@contextmanager
def refused_by_library(where: Path, expected: str) -> Generator[None]:
    """Raise the documented error for whatever the library raises inside the block.

    Its checks raise classes of their own, `Exception` itself and asserts among them, and none of
    our code runs inside.

    Args:
        where: File or folder; starts the message.
        expected: What it should be.

    Raises:
        FileFormatError: For every failure.
    """
    with reading(where, expected):
        try:
            yield
        except (OSError, MemoryError, ValueError):
            raise
        except Exception as error:
            raise ValueError(str(error) or type(error).__name__) from error


@contextmanager
def offline() -> Generator[None]:
    """Nothing inside the block reaches the hub, whatever a file names.

    The library of the hub reads its environment once, when it is imported, and asks this switch
    before each request. What is to be fetched was fetched before a network is made.
    """
    constants = importlib.import_module("huggingface_hub").constants
    with _LOADING:  # of two threads one would put back what the other set
        before = constants.HF_HUB_OFFLINE
        constants.HF_HUB_OFFLINE = True
        try:
            yield
        finally:
            constants.HF_HUB_OFFLINE = before


class _Checked:
    """One file; `part` goes through it."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def part(self, content: Mapping[str, Any], kind: str, where: str) -> dict[str, Any]:
        """What may be said of a network or a part of one, of a type, at a place of the file."""
        parts = PARTS.get(kind, {})
        self._refuse(content, kind, where)
        fields = _fields(kind)
        found: dict[str, Any] = {"model_type": kind}
        for key, value in content.items():
            name = where + key
            listed = key in parts or key in NUMBERS or key in FLAGS or key in WORDS
            if key == "model_type" or (value is None and not listed):
                continue
            if value is None or key == "attn_implementation":
                found[key] = value
            elif key in parts:
                found[key] = self._inner(value, parts[key], name)
            elif key == "rope_parameters":
                found[key] = self._plain(value, name)
            elif key == "id2label":
                found[key] = self._classes(value, name)
            elif key == "num_labels":
                found[key] = self._numbers(value, Numbers(1, _MOST_CLASSES), name)
            elif listed:
                found[key] = self._value(key, value, name)
            elif key != _BACKBONE and key in fields and value != fields[key]:
                self._fail(name, "no such setting, which splatseg does not know", value)
        return found

    def _inner(self, value: object, kinds: tuple[str, ...], name: str) -> dict[str, Any]:
        if not isinstance(value, dict):
            self._fail(name, "settings of a part of the network", value)
        content = cast("dict[str, Any]", value)
        kind = content.get("model_type") or kinds[0]
        if kind not in kinds:
            self._fail(f"{name}.model_type", " or ".join(kinds), kind)
        return self.part(content, str(kind), f"{name}.")

    def _plain(self, value: object, name: str) -> dict[str, Any]:
        """Settings of rotary positions: numbers and words."""
        if not isinstance(value, dict):
            self._fail(name, "settings of positions", value)
        content = cast("dict[str, Any]", value)
        known = {key: one for key, one in content.items() if key in NUMBERS or key in WORDS}
        return {key: self._value(key, one, f"{name}.{key}") for key, one in known.items()}

    def _value(self, key: str, value: object, name: str) -> object:
        if key.endswith("_token_id") and isinstance(value, list):
            self._fail(name, "the number of one token", value)
        if key in NUMBERS:
            return self._numbers(value, NUMBERS[key], name)
        if key in FLAGS:
            if not isinstance(value, bool):
                self._fail(name, "true or false", value)
            return value
        words = cast("list[object]", value) if isinstance(value, list) else [value]
        for word in words:
            known = isinstance(word, str) and (word in WORDS[key] or _STAGE.fullmatch(word))
            if not known:
                self._fail(name, "a word that networks of this kind have", word)
        return value

    def _numbers(self, value: object, kind: Numbers, name: str) -> object:
        """A number, or lists of them, at most one in the other."""
        flat = [value]
        for _ in range(2):
            flat = [
                x
                for one in flat
                for x in (cast("list[object]", one) if isinstance(one, list) else [one])
            ]
            if len(flat) > _MOST_ENTRIES:
                self._fail(name, f"at most {_MOST_ENTRIES} numbers", value)
        for number in flat:
            fits = isinstance(number, int if kind.whole else int | float)
            if (
                not fits
                or isinstance(number, bool)
                or not kind.low <= cast(float, number) <= kind.high
            ):
                what = "a whole number" if kind.whole else "a number"
                self._fail(name, f"{what} from {kind.low:g} to {kind.high:g}", number)
        total = math.fsum(cast("list[float]", flat))
        if kind.sum_at_most is not None and total > kind.sum_at_most:
            self._fail(name, f"a sum of at most {kind.sum_at_most:g}", value)
        return value

    def _classes(self, value: object, name: str) -> dict[str, str]:
        if (
            not isinstance(value, dict)
            or not 1 <= len(cast("dict[str, object]", value)) <= _MOST_CLASSES
        ):
            self._fail(name, f"names of 1 to {_MOST_CLASSES} classes by their numbers", value)
        for key, one in cast("dict[str, object]", value).items():
            if not _DIGITS.fullmatch(key) or not isinstance(one, str | int | float):
                self._fail(name, "a name by the number of its class", {key: one})
            with made_from(self._path):
                as_text(f"{name:.60}: {key}", str(one))
        return {str(int(key)): str(one) for key, one in cast("dict[str, object]", value).items()}

    def _refuse(self, content: Mapping[str, Any], kind: str, where: str) -> None:
        """Refuse what would run, fetch or import something, or is no network as it was trained."""
        for key in ("attn_implementation", "_attn_implementation", "_attn_implementation_internal"):
            if content.get(key) is not None and content[key] not in _ATTENTIONS:
                self._fail(where + key, " or ".join(_ATTENTIONS), content[key])
        for key in ("dtype", "torch_dtype"):
            if content.get(key) is not None and content[key] not in _TYPES:
                self._fail(where + key, " or ".join(_TYPES), content[key])
        if content.get("quantization_config") is not None:
            self._fail(
                where + "quantization_config",
                "weights that are not quantised",
                content["quantization_config"],
            )
        if content.get("auto_map") is not None:
            self._fail(
                where + "auto_map", "a network of the library, without code", content["auto_map"]
            )
        asked = content.get("backbone")
        if (
            asked is not None
            and _BACKBONE in PARTS.get(kind, {})
            and content.get(_BACKBONE) is None
        ):
            self._fail(
                where + "backbone", f"{_BACKBONE}, not the name of a network to be fetched", asked
            )

    def _fail(self, name: str, expected: str, got: object) -> NoReturn:
        raise FileFormatError(f"{self._path}: {name:.60}: expected {expected}, got {quoted(got)}.")


def _fields(kind: str) -> dict[str, Any]:
    """Settings that the installed library knows of a network of a type, and their defaults.

    Those that all networks have (architectures, the type of the weights, what is returned) change
    no answer of ours.
    """
    auto = importlib.import_module("transformers.models.auto.configuration_auto")
    base = importlib.import_module("transformers").PretrainedConfig
    if kind not in auto.CONFIG_MAPPING:
        return {}
    known = getattr(auto.CONFIG_MAPPING[kind], "__dataclass_fields__", {})
    common = getattr(base, "__dataclass_fields__", {})
    return {
        name: list(cast("tuple[Any, ...]", field.default))
        if isinstance(field.default, tuple)
        else field.default
        for name, field in known.items()
        if name not in common
    }
