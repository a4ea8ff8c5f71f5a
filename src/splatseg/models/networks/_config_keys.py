"""What config.json of a network may say: keys, what their values are, and which parts it has.

The names are those of the configuration classes of transformers 5. `_config` holds files against
these tables. Keys of training alone (weights of losses, dropout) are here too: the library checks
their types, and networks that run do not look at them.
"""

from dataclasses import dataclass


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
    memory_fuser_num_layers num_blocks num_encoder_blocks num_feature_levels num_hidden_layers
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
