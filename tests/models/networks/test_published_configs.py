"""What published weights say in config.json is taken, and reaches the library as it is."""

import importlib
import json
from types import SimpleNamespace

import pytest

from splatseg.models.networks._config import checked_config, library_config

TYPES = (
    *("clip", "clipseg", "depth_anything", "dinov2", "dinov2_with_registers", "dinov3_vit", "dpt"),
    *("eomt", "eomt_dinov3", "grounding-dino", "mask2former", "maskformer", "mm-grounding-dino"),
    *("oneformer", "sam", "sam2", "sam2_video", "sam3", "sam3_tracker", "sam3_tracker_video"),
    *("sam3_video", "sam_hq", "segformer", "siglip", "siglip2", "vit"),
)
EARLIER = {
    "_commit_hash": None, "_name_or_path": "", "add_cross_attention": False, "architectures": None,
    "bad_words_ids": None, "chunk_size_feed_forward": 0, "diversity_penalty": 0.0,
    "do_sample": False, "early_stopping": False, "finetuning_task": None, "is_decoder": False,
    "length_penalty": 1.0, "max_length": 20, "min_length": 0, "num_beams": 1,
    "output_attentions": False, "problem_type": None, "pruned_heads": {}, "return_dict": True,
    "sep_token_id": None, "temperature": 1.0, "tf_legacy_loss": False, "tie_encoder_decoder": False,
    "tie_word_embeddings": True, "top_k": 50, "torch_dtype": "float32", "torchscript": False,
    "transformers_version": "4.29.0.dev0", "typical_p": 1.0, "use_bfloat16": False,
}  # fmt: skip
"""What files of releases 4 hold, of every network."""

STAGES = {"stage_names": ["stem", *(f"stage{i}" for i in range(1, 13))]}
UNNAMED = {
    "backbone": None, "backbone_kwargs": None, "use_timm_backbone": False,
    "use_pretrained_backbone": False,
}  # fmt: skip
OWN = {
    "depth_anything": UNNAMED,
    "dinov2": {**STAGES, "out_features": ["stage12"], "out_indices": [12]},
    "dinov2_with_registers": {"interpolate_antialias": True, "interpolate_offset": 0.0},
    "grounding-dino": UNNAMED,
    "mm-grounding-dino": UNNAMED,
    "oneformer": {"max_seq_len": 77, "num_classes": 150},
    "sam2_video": {
        "memory_attention_rope_k_sizes": [16, 16],
        "preserve_temporal_direction_in_object_pointers": True,
        "project_temporal_pos_encoding_in_object_pointers": True,
    },
    "segformer": {"downsampling_rates": [1, 4, 8, 16], "reshape_last_stage": True},
}
"""What files of one network hold besides its settings of today."""

CHANGED = {"out_features", "out_indices", "tie_word_embeddings", "torch_dtype", "return_dict"}


def read(tmp_path, kind: str, content: dict) -> dict:
    """What the library makes of a file, but for numbers of classes, which `id2label` says."""
    path = tmp_path / "config.json"
    path.write_text(json.dumps(content))
    auto = importlib.import_module("transformers.models.auto.configuration_auto")
    network = SimpleNamespace(config_class=auto.CONFIG_MAPPING[kind], __name__=kind)
    made, rest = library_config(path, checked_config(path, (kind,)), network)
    assert rest == {}
    return settings(json.loads(made.to_json_string(use_diff=False)))


def settings(content: dict) -> dict:
    """Values by dotted names."""
    found = {}
    for key, value in content.items():
        inner = value if isinstance(value, dict) and key != "label2id" else None
        below = {key: value} if inner is None else settings(inner)
        found |= {name if inner is None else f"{key}.{name}": one for name, one in below.items()}
    return {name: one for name, one in found.items() if not name.endswith("label2id")}


@pytest.mark.parametrize("kind", TYPES)
def test_what_the_library_saves(tmp_path, kind) -> None:
    auto = importlib.import_module("transformers.models.auto.configuration_auto")
    saved = json.loads(auto.CONFIG_MAPPING[kind]().to_json_string(use_diff=False))
    found = read(tmp_path, kind, saved)
    assert found == settings(saved)
    added = EARLIER | OWN.get(kind, {})
    earlier = {key: value for key, value in added.items() if key not in saved or key in CHANGED}
    for key, value in saved.items():
        if key.endswith("_config") and isinstance(value, dict):
            saved[key] = value | {one: EARLIER[one] for one in EARLIER if one not in value}
            saved[key] |= {"gradient_checkpointing": False, "path_norm": True} | STAGES
    later = read(tmp_path, kind, saved | earlier)
    changed = {name for name in found if found[name] != later[name]}
    assert {name.rsplit(".")[-1] for name in changed} <= CHANGED
