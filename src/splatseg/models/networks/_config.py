"""config.json of weights, held against what the network's own may say, before any library sees it.

The file comes with the weights, from anywhere, and transformers does what it says: it fetches and
runs kernels and networks by name, imports packages, and builds layers without end. So tables here
have what may stand in it: keys, what their values are, and which parts a network has; everything
else is refused, or left out where it changes no answer. The names are those of the configuration
classes of transformers 5. Keys of training alone (weights of losses, dropout) are there too: the
library checks their types, and networks that run do not look at them.
"""

import importlib
import json
import math
import re
import tempfile
import threading
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, cast

from splatseg.core.coerce import as_text
from splatseg.errors import FileFormatError, quoted
from splatseg.io.foreign import derived_from, reading
from splatseg.io.json_files import read_json


@dataclass(frozen=True, slots=True)
class Numbers:
    """A number, or a list of such numbers."""

    low: float
    high: float
    whole: bool = True
    sum_at_most: float | None = None
    """Of all numbers of a list together."""


_LAYERS = """
    auxiliary_num_convs blocks_per_stage conditional_layer decoder_layers decoder_n_points depths
    encoder_layers encoder_n_points fpn_top_down_levels iou_head_depth memory_attention_num_layers
    memory_fuser_num_layers num_blocks num_encoder_blocks num_feature_levels
    num_layers num_maskmem num_multimask_outputs num_point_embeddings num_query_pool_stages
    num_register_tokens num_stages num_upsampling_stages num_upscale_blocks query_dec_layers
    text_encoder_num_layers text_encoder_proj_layers width_factor
"""
_STEPS = """
    attention_downsample_rate common_stride dilations encoder_stride feature_strides
    fpn_kernel_size fpn_padding fpn_stride kernel_size mask_downsampler_kernel_size
    mask_downsampler_padding mask_downsampler_stride mask_downsampler_total_stride
    memory_attention_downsample_rate memory_fuser_kernel_size memory_fuser_padding output_stride
    patch_kernel_size patch_padding patch_size patch_sizes patch_stride pool_scales
    pretrained_window_sizes query_stride roi_size sr_ratios strides
    window_positional_embedding_background_size window_size window_size_per_stage
"""
_SIDES = """
    backbone_feature_sizes backbone_featmap_shape image_size low_res_mask_size max_cond_frame_num
    max_object_pointers_in_encoder max_position_embeddings max_text_len
    memory_attention_rope_feat_sizes num_patches num_queries pretrain_image_size task_seq_len
    text_encoder_context_length text_encoder_n_ctx
"""
_SIZES = """
    auxiliary_channels backbone_channel_list conv_dim d_model decoder_attention_heads
    decoder_ffn_dim decoder_hidden_size decoder_intermediate_size decoder_num_attention_heads
    dim_feedforward embed_dim embed_dim_per_stage embedding_size encoder_attention_heads
    encoder_feedforward_dim encoder_ffn_dim feature_size fpn_feature_size fpn_hidden_size
    fusion_hidden_size head_hidden_size hidden_dim hidden_size hidden_sizes intermediate_size
    iou_head_hidden_dim mask_dim mask_downsampler_embed_dim mask_feature_size mask_input_channels
    memory_attention_feed_forward_hidden_size memory_attention_hidden_size
    memory_attention_num_attention_heads memory_encoder_hidden_size
    memory_encoder_output_channels memory_fuser_embed_dim memory_fuser_intermediate_dim mlp_dim
    neck_hidden_sizes num_attention_heads num_attention_heads_per_stage num_channels num_groups
    num_heads num_key_value_heads num_pos_feats output_channels pooler_output_size projection_dim
    projection_size query_dim reassemble_hidden_size reduce_dim text_encoder_vocab_size
    text_encoder_width type_vocab_size vit_dim vocab_size
"""
_WHOLE = """
    _out_indices backbone_out_indices bos_token_id eos_token_id extract_layers fill_hole_area
    global_attention_blocks global_attn_indexes head_in_index hotstart_delay hotstart_dup_thresh
    hotstart_unmatch_thresh ignore_index ignore_value init_trk_keep_alive max_num_objects
    max_trk_keep_alive min_trk_keep_alive multimask_max_pt_num multimask_min_pt_num
    neck_ignore_stages out_indices pad_token_id recondition_every_nth_frame scale
    semantic_loss_ignore_index sep_token_id train_num_points
"""
_REAL = """
    activation_dropout assoc_iou_thresh attention_dropout attention_probs_dropout_prob
    auxiliary_loss_weight bbox_cost bbox_loss_coefficient class_cost class_loss_coefficient
    class_weight classifier_dropout classifier_dropout_prob contrastive_temperature
    contrastive_weight cross_entropy_weight decoder_attention_dropout decoder_layerdrop
    det_nms_thresh dice_cost dice_loss_coefficient dice_weight drop_path_rate dropout
    dynamic_multimask_stability_delta dynamic_multimask_stability_thresh encoder_layerdrop
    eos_coefficient focal_alpha fusion_dropout fusion_droppath giou_cost giou_loss_coefficient
    high_conf_thresh high_iou_thresh hidden_dropout hidden_dropout_prob importance_sample_ratio
    init_std init_xavier_std initializer_factor initializer_range layer_norm_eps
    layer_scale_init_value layerscale_value logit_scale_init_value mask_cost
    mask_loss_coefficient mask_weight max_depth memory_attention_dropout
    memory_attention_rope_dropout memory_attention_rope_theta memory_fuser_layer_scale_init_value
    mlp_ratio mlp_ratios new_det_thresh no_object_weight oversample_ratio pos_embed_jitter
    pos_embed_rescale pos_embed_shift positional_embedding_temperature reassemble_factors
    rope_theta scale_factors score_threshold_detection semantic_classifier_dropout
    sigmoid_bias_for_mem_enc sigmoid_scale_for_mem_enc
    suppress_overlapping_based_on_recent_occlusion_threshold text_enhancer_dropout
    trk_assoc_iou_thresh
"""
_FLAGS = """
    add_cross_attention add_fpn add_projection apply_layernorm auxiliary_concat_input
    auxiliary_loss decoder_bbox_embed_share decoder_cls_embed_share
    decrease_trk_keep_alive_for_empty_masklets dilation disable_custom_kernels
    downsample_in_bottleneck downsample_in_first_stage dynamic_multimask_via_stability
    embedding_dynamic_padding embedding_init_target enable_occlusion_spatial_embedding
    enable_temporal_pos_encoding_for_object_pointers enforce_input_proj enforce_input_projection
    is_decoder is_hybrid is_training key_bias mlp_bias multimask_output_for_tracking
    multimask_output_in_sam output_auxiliary_logits pre_norm proj_bias qkv_bias query_bias
    recondition_on_trk_masks reshape_hidden_states reshape_last_stage
    suppress_unmatched_only_within_hotstart tie_word_embeddings two_stage
    two_stage_bbox_embed_share use_abs_pos use_absolute_embeddings
    use_absolute_position_embeddings use_auxiliary_head use_auxiliary_loss
    use_batch_norm_in_fusion_residual use_bias_in_fusion_residual use_cache
    use_complex_transposed_convolution use_gated_mlp use_mask_token use_mean_pooling use_rel_pos
    use_relative_position_bias use_shared_relative_position_bias use_swiglu_ffn use_task_norm
    value_bias vision_use_head
"""
_WORDS = """
    _out_features activation_function decoder_hidden_act depth_estimation_type global_padding
    hidden_act layer_type mask_downsampler_hidden_act memory_attention_feed_forward_hidden_act
    memory_attention_rope_type memory_fuser_hidden_act norm out_features pooler_act
    position_embedding_type readout_type rope_type type
"""

_KNOWN_WORDS = """
    absolute add axial basic bottleneck default gelu gelu_fast gelu_new gelu_pytorch_tanh GN ignore
    learned leaky_relu metric mish preactivation project quick_gelu relative relu relu2 relu6 same
    SAME sigmoid silu sine swish tanh valid VALID
"""

NUMBERS = {
    name: kind
    for names, kind in (
        (_LAYERS, Numbers(0, 200, sum_at_most=200)),
        (_STEPS, Numbers(0, 64)),
        (_SIDES, Numbers(-1, 8192)),
        (_SIZES, Numbers(0, 1 << 20)),
        (_WHOLE, Numbers(-(1 << 20), 1 << 20)),
        (_REAL, Numbers(-1e9, 1e9, whole=False)),
        ("num_hidden_layers", Numbers(1, 200, sum_at_most=200)),
    )
    for name in names.split()
}
"""Keys whose values are numbers or lists of them."""

FLAGS = frozenset(_FLAGS.split())
"""Keys that are true or false."""

WORDS = {name: frozenset(_KNOWN_WORDS.split()) for name in _WORDS.split()}
"""Keys whose values are words, and which; names of stages are words too."""

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
            with derived_from(self._path):
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
