"""config.json of weights, held against what the network's own may say, before any library sees it.

The file comes with the weights, from anywhere, and transformers does what it says: it fetches and
runs kernels and networks by name, imports packages, and builds layers without end. So what may
stand in it are the settings of the configuration classes of transformers: numbers, flags and words
as their defaults are, within bounds that their names tell, and the parts that a network has.
Everything else is refused, or left out where it changes no answer.
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

_MORE = ("out_features", "out_indices", "rope_type", "type")
"""Keys that are taken although they are no setting by themselves."""

_WORDS = frozenset({
    "absolute", "add", "axial", "basic", "bottleneck", "default", "gelu", "gelu_fast", "gelu_new",
    "gelu_pytorch_tanh", "GN", "ignore", "learned", "leaky_relu", "metric", "mish", "preactivation",
    "project", "quick_gelu", "relative", "relu", "relu2", "relu6", "same", "SAME", "sigmoid",
    "silu", "sine", "swish", "tanh", "valid", "VALID",
})  # fmt: skip
"""What text may say; names of stages are words too."""

_LAYERS = re.compile(
    r"(layers?|convs|stages|n_points|depths?|levels|blocks|maskmem|point_embeddings|tokens)$"
    r"|blocks_per_stage|num_multimask|width_factor"
)
"""Settings that say how often something is built: at most `_MOST_LAYERS` together."""

_SIDES = re.compile(
    r"image_size|feat\w*_(sizes|shape)|mask_size|max_(cond|object|position|text)|num_patches"
    r"|num_queries|seq_len|context|n_ctx"
)
"""Settings that say how large a picture or a text is, by which memory is taken."""

_STEPS = re.compile(
    r"kernel|stride|padding|patch_|window|dilations|scales|roi_|downsample_rate|ratios"
)
"""Settings that say how far a layer looks or steps."""

_ANY_SIGN = re.compile(
    r"_id$|ind(ex|ic)|ignore|extract|blocks$|keep_alive|delay|thresh|area|scale$"
)
"""Settings of whole numbers that may be negative."""

_REAL = re.compile(r"cost|coefficient|mlp_ratio|factors$|temperature|max_depth")
"""Settings that may be fractions though their defaults are whole."""

_MOST_LAYERS, _LONGEST_STEP, _LONGEST_SIDE = 200, 64, 8192
_LARGEST_WHOLE, _LARGEST_REAL = 1 << 20, 1e9

_SAM_PARTS = ("prompt_encoder", "mask_decoder")
_SWIN = ("swin", "maskformer-swin", "resnet")
_CLIP_PARTS = ("text_config", "text_config_dict", "vision_config", "vision_config_dict")


def _sam(
    name: str, vision: str | None = None, parts: tuple[str, ...] = _SAM_PARTS
) -> dict[str, tuple[str, ...]]:
    found = {f"{part}_config": (f"{name}_{part}",) for part in parts}
    return found | {"vision_config": (vision or f"{name}_vision_model",)}


PARTS: dict[str, dict[str, tuple[str, ...]]] = {
    "maskformer": {"backbone_config": _SWIN, "decoder_config": ("detr",)},
    "mask2former": {"backbone_config": _SWIN},
    "oneformer": {"backbone_config": _SWIN},
    "dpt": {"backbone_config": ("bit", "dinov2", "dinov2_with_registers", "beit", "swinv2")},
    "depth_anything": {"backbone_config": ("dinov2", "dinov2_with_registers")},
    "grounding-dino": {"backbone_config": ("swin",), "text_config": ("bert",)},
    "mm-grounding-dino": {"backbone_config": ("swin",), "text_config": ("bert",)},
    "clip": {key: (f"clip_{key.split('_')[0]}_model",) for key in _CLIP_PARTS},
    "clipseg": {key: (f"clipseg_{key.split('_')[0]}_model",) for key in _CLIP_PARTS},
    "siglip": {f"{part}_config": (f"siglip_{part}_model",) for part in ("text", "vision")},
    "siglip2": {f"{part}_config": (f"siglip2_{part}_model",) for part in ("text", "vision")},
    "sam": _sam("sam"),
    "sam_hq": _sam("sam_hq"),
    "sam2": _sam("sam2"),
    "sam2_video": _sam("sam2_video", "sam2_vision_model"),
    "sam2_vision_model": {"backbone_config": ("sam2_hiera_det_model",)},
    "sam3": _sam("sam3", None, ("geometry_encoder", "detr_encoder", "detr_decoder", "mask_decoder"))
    | {"text_config": ("clip_text_model",)},
    "sam3_video": {"detector_config": ("sam3",), "tracker_config": ("sam3_tracker_video",)},
    "sam3_tracker": _sam("sam3_tracker", "sam3_vision_model"),
    "sam3_tracker_video": _sam("sam3_tracker_video", "sam3_vision_model"),
    "sam3_vision_model": {"backbone_config": ("sam3_vit_model",)},
}  # fmt: skip
"""Parts of a network that have settings of their own, by its ``model_type``, and their types: the
first is what a part is that does not say."""


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
        parts, settings = PARTS.get(kind, {}), _settings(kind)
        self._refuse(content, kind, where)
        found: dict[str, Any] = {"model_type": kind}
        for key, value in content.items():
            name, default = where + key, settings.get(key)
            known = key in _MORE or (key in settings and key not in (_BACKBONE, "model_type"))
            if key == "attn_implementation" or (value is None and (key in parts or known)):
                found[key] = value
            elif value is None:
                continue
            elif key in parts:
                found[key] = self._inner(value, parts[key], name)
            elif key == "rope_parameters":
                found[key] = self._plain(value, name)
            elif key == "id2label":
                found[key] = self._classes(value, name)
            elif key == "num_labels":
                self._check_numbers(value, (1, _MOST_CLASSES), name)
                found[key] = value
            elif known:
                if type(value) is not type(default) or value != default:
                    self._check(key, value, default, name)
                found[key] = value
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
        for key, one in content.items():
            self._check(key, one, None, f"{name}.{key}")
        return content

    def _check(self, key: str, value: object, default: object, name: str) -> None:
        """Refuse a setting that is not as its default, or out of all bounds."""
        if key.endswith("_token_id") and isinstance(value, list):
            self._fail(name, "the number of one token", value)
        while isinstance(default, list):
            default = cast("list[object]", default)[0] if default else None
        flat = self._flat(value, name)
        if isinstance(default, bool) and not isinstance(value, bool):
            self._fail(name, "true or false", value)
        if isinstance(value, bool) and (default is None or isinstance(default, bool)):
            return
        if isinstance(default, str) or (default is None and any(isinstance(x, str) for x in flat)):
            for word in flat:
                if not (isinstance(word, str) and (word in _WORDS or _STAGE.fullmatch(word))):
                    self._fail(name, "a word that networks of this kind have", word)
        elif isinstance(default, float) or _REAL.search(key):
            self._check_numbers(value, (-_LARGEST_REAL, _LARGEST_REAL), name, whole=False)
        elif _LAYERS.search(key):
            self._check_numbers(value, (0, _MOST_LAYERS), name, whole=default is not None)
            if math.fsum(cast("list[float]", flat)) > _MOST_LAYERS:
                self._fail(name, f"a sum of at most {_MOST_LAYERS}", value)
        else:
            bounds = (-_LARGEST_WHOLE if _ANY_SIGN.search(key) else 0, _LARGEST_WHOLE)
            if _SIDES.search(key):
                bounds = (-1, _LONGEST_SIDE)
            elif _STEPS.search(key):
                bounds = (0, _LONGEST_STEP)
            self._check_numbers(value, bounds, name, whole=default is not None)

    def _flat(self, value: object, name: str) -> list[object]:
        flat = [value]
        for _ in range(2):
            flat = [
                x
                for one in flat
                for x in (cast("list[object]", one) if isinstance(one, list) else [one])
            ]
            if len(flat) > _MOST_ENTRIES:
                self._fail(name, f"at most {_MOST_ENTRIES} numbers", value)
        return flat

    def _check_numbers(
        self, value: object, bounds: tuple[float, float], name: str, *, whole: bool = True
    ) -> None:
        low, high = bounds
        for number in self._flat(value, name):
            fits = isinstance(number, int if whole else int | float)
            if not fits or isinstance(number, bool) or not low <= cast(float, number) <= high:
                what = "a whole number" if whole else "a number"
                self._fail(name, f"{what} from {low:g} to {high:g}", number)

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


def _settings(kind: str) -> dict[str, Any]:
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
