"""The network piece by piece, and as a whole against transformers' DPT and CLIP."""

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from splatseg.models._lseg_network import (
    Attention,
    Block,
    DensePredictionTransformer,
    Fusion,
    ImageTransformer,
    Reassemble,
    ResidualUnit,
    Sizes,
)
from splatseg.models.lseg import network_of
from support.checkpoints_lseg import (
    BLOCKS,
    CHANNELS,
    CONTEXT,
    DECODER,
    EMBEDDING,
    GRID,
    TEXT,
    TEXT_BLOCKS,
    VOCABULARY,
    WIDTH,
    published,
)


@pytest.fixture(autouse=True)
def seeded():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        yield


@pytest.mark.parametrize("causal", [False, True])
def test_attention_is_that_of_torch(causal: bool) -> None:
    ours = Attention(128, causal=causal)
    theirs = nn.MultiheadAttention(128, 2, batch_first=True)
    theirs.load_state_dict({
        "in_proj_weight": ours.qkv.weight, "in_proj_bias": ours.qkv.bias,
        "out_proj.weight": ours.out.weight, "out_proj.bias": ours.out.bias,
    })  # fmt: skip
    tokens = torch.randn(2, 5, 128)
    mask = torch.ones(5, 5, dtype=torch.bool).triu(1) if causal else None
    wanted, _ = theirs(tokens, tokens, tokens, attn_mask=mask, need_weights=False)
    torch.testing.assert_close(ours(tokens), wanted)


def test_a_block_adds_attention_and_perceptron_after_normalisation() -> None:
    for activation, function in (("gelu", F.gelu), ("quick_gelu", None)):
        block = Block(64, causal=False, activation=activation, epsilon=1e-6)
        x = torch.randn(1, 3, 64)
        middle = x + block.attention(F.layer_norm(x, (64,), eps=1e-6))
        inner = block.wider(F.layer_norm(middle, (64,), eps=1e-6))
        inner = function(inner) if function else inner / (1 + torch.exp(-1.702 * inner))
        torch.testing.assert_close(block(x), middle + block.back(inner))


def test_positions_at_another_size_are_interpolated() -> None:
    transformer = ImageTransformer(Sizes(grid=2, width=64, blocks=4))
    learned = torch.tensor([5.0, 0.0, 1.0, 2.0, 3.0])  # the class token's, then a grid of 2 x 2
    transformer.positions.data = learned[None, :, None].expand(1, 5, 64).clone()
    assert transformer._positions_of(2, 2) is transformer.positions
    found = transformer._positions_of(4, 1)[0, :, 0]
    # Down a column the mean of left and right, 0.5 and 2.5, with cells' centres at quarters.
    assert found.tolist() == pytest.approx([5, 0.5, 1.0, 2.0, 2.5])


def test_tokens_are_read_after_each_quarter_of_the_blocks() -> None:
    transformer = ImageTransformer(Sizes(grid=2, width=64, blocks=8))
    seen: list[torch.Tensor] = []
    for block in transformer.blocks:
        block.register_forward_hook(lambda _, inputs, output: seen.append(output))
    read, grid = transformer(torch.randn(1, 3, 32, 48))
    assert grid == (2, 3)
    assert [any(one is token for token in read) for one in seen] == [False, True] * 4
    assert read[0].shape == (1, 1 + 6, 64)


def test_the_readout_joins_the_class_token_to_each_other() -> None:
    """With a projection that takes the token's first and the class token's second channel."""
    reassemble = Reassemble(2, 1, level=2)
    with torch.no_grad():
        reassemble.readout.weight.zero_()
        reassemble.readout.weight[0, 0] = 1  # of the patch
        reassemble.readout.weight[1, 3] = 1  # of the class token
        reassemble.readout.bias.zero_()
        reassemble.project.weight[:] = torch.tensor([1.0, 10.0]).view(1, 2, 1, 1)
        reassemble.project.bias.zero_()
    tokens = torch.tensor([[[7.0, 3.0], [1, 0], [2, 0], [-1, 0], [0, 0], [4, 0], [5, 0]]])
    found = reassemble(tokens, (2, 3))
    wanted = F.gelu(torch.tensor([[1.0, 2, -1], [0, 4, 5]])) + 10 * F.gelu(torch.tensor(3.0))
    torch.testing.assert_close(found[0, 0], wanted)


@pytest.mark.parametrize(("level", "size"), [(0, (16, 24)), (1, (8, 12)), (2, (4, 6)), (3, (2, 3))])
def test_levels_have_four_two_one_and_half_the_size(level: int, size: tuple[int, int]) -> None:
    found = Reassemble(8, 5, level=level)(torch.randn(1, 25, 8), (4, 6))
    assert found.shape == (1, 5, *size)


def test_a_unit_without_convolutions_gives_what_it_gets() -> None:
    """Its residual is what came in, before the ReLU."""
    unit = ResidualUnit(3).eval()
    x = torch.randn(1, 3, 4, 4)
    nn.init.zeros_(unit.conv_2.weight)
    torch.testing.assert_close(unit(x), x)
    with torch.no_grad():
        unit.norm_2.bias += 2
    torch.testing.assert_close(unit(x), x + 2)
    nn.init.dirac_(unit.conv_1.weight)
    nn.init.dirac_(unit.conv_2.weight)
    scale = 1 / (1 + 1e-5)  # both normalisations by the deviation 1
    torch.testing.assert_close(unit(x), x + 2 + F.relu(x) * scale, rtol=0, atol=1e-6)


def test_fusion_adds_the_coarser_map_and_doubles_the_size() -> None:
    fusion = Fusion(3, 3, coarsest=False).eval()
    for unit in (fusion.merge, fusion.refine):
        nn.init.zeros_(unit.conv_2.weight)
    nn.init.dirac_(fusion.reduce.weight)
    nn.init.dirac_(fusion.out.weight)
    nn.init.zeros_(fusion.out.bias)
    level, coarser = torch.randn(1, 3, 2, 2), torch.randn(1, 3, 2, 2)
    found = fusion(level, coarser)
    corners = found[..., [0, 0, -1, -1], [0, -1, 0, -1]]
    torch.testing.assert_close(corners, (level + coarser).flatten(2), rtol=0, atol=1e-6)
    edge = found[0, 0, 0]
    torch.testing.assert_close(edge[1] - edge[0], (edge[-1] - edge[0]) / 3, rtol=0, atol=1e-5)


@pytest.mark.bits
def test_the_image_side_is_transformers_dpt(weights: Path) -> None:
    """The same weights in the network of another author, of an image of another size."""
    from transformers import DPTConfig, DPTForSemanticSegmentation

    state = published()
    network, unknown = network_of({f"net.{k}": v for k, v in state.items()}, weights)
    assert unknown == []
    config = DPTConfig(
        hidden_size=WIDTH, num_hidden_layers=BLOCKS, num_attention_heads=WIDTH // 64,
        intermediate_size=4 * WIDTH, image_size=16 * GRID, patch_size=16, layer_norm_eps=1e-6,
        backbone_out_indices=[0, 1, 2, 3], readout_type="project",
        reassemble_factors=[4, 2, 1, 0.5], neck_hidden_sizes=list(CHANNELS),
        fusion_hidden_size=DECODER, use_batch_norm_in_fusion_residual=True,
        use_bias_in_fusion_residual=False, use_auxiliary_head=False, hidden_act="gelu",
    )  # fmt: skip
    theirs = DPTForSemanticSegmentation(config).eval()
    about = theirs.load_state_dict(_as_dpt(state), strict=False)
    allowed = ("dpt.layernorm", "dpt.pooler", "head", "num_batches", "fusion_stage.layers.0.resid")
    lacking = [one for one in about.missing_keys if not any(part in one for part in allowed)]
    assert not lacking
    assert not about.unexpected_keys
    # In double precision: a random network of sharp answers makes much of rounding.
    theirs, network = theirs.double(), network.double()
    batch = torch.randn(2, 3, 64, 96, dtype=torch.float64)
    with torch.inference_mode():
        hidden = theirs.dpt(batch, output_hidden_states=True).hidden_states[1:]
        wanted = theirs.neck(list(hidden), 4, 6)[-1]
        found = network.image(batch)
    assert found.shape == (2, DECODER, 32, 48)
    assert float(found.std()) > 0.1
    torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9)


def _as_dpt(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Weights by the names of transformers' DPT."""
    found: dict[str, torch.Tensor] = {}
    embeddings = {
        "cls_token": "cls_token", "pos_embed": "position_embeddings",
        "patch_embed.proj.weight": "patch_embeddings.projection.weight",
        "patch_embed.proj.bias": "patch_embeddings.projection.bias",
    }  # fmt: skip
    for old, new in embeddings.items():
        found[f"dpt.embeddings.{new}"] = state[f"pretrained.model.{old}"]
    simple = {
        "norm1": "layernorm_before", "norm2": "layernorm_after",
        "attn.proj": "attention.output.dense", "mlp.fc1": "intermediate.dense",
        "mlp.fc2": "output.dense",
    }  # fmt: skip
    for i in range(BLOCKS):
        for end in ("weight", "bias"):
            at, to = f"pretrained.model.blocks.{i}", f"dpt.encoder.layer.{i}"
            for old, new in simple.items():
                found[f"{to}.{new}.{end}"] = state[f"{at}.{old}.{end}"]
            for part, name in zip(
                state[f"{at}.attn.qkv.{end}"].chunk(3), ("query", "key", "value"), strict=True
            ):
                found[f"{to}.attention.attention.{name}.{end}"] = part
    neck, units = "neck.reassemble_stage", {1: "residual_layer1", 2: "residual_layer2"}
    for level in range(4):
        at = f"pretrained.act_postprocess{level + 1}"
        fusion = f"neck.fusion_stage.layers.{3 - level}"
        refine = f"scratch.refinenet{level + 1}"
        found[f"neck.convs.{level}.weight"] = state[f"scratch.layer{level + 1}_rn.weight"]
        for end in ("weight", "bias"):
            found[f"{neck}.readout_projects.{level}.0.{end}"] = state[f"{at}.0.project.0.{end}"]
            found[f"{neck}.layers.{level}.projection.{end}"] = state[f"{at}.3.{end}"]
            if level != 2:
                found[f"{neck}.layers.{level}.resize.{end}"] = state[f"{at}.4.{end}"]
            found[f"{fusion}.projection.{end}"] = state[f"{refine}.out_conv.{end}"]
        for unit in (1, 2) if level < 3 else (2,):
            for n in (1, 2):
                old, new = f"{refine}.resConfUnit{unit}", f"{fusion}.{units[unit]}"
                found[f"{new}.convolution{n}.weight"] = state[f"{old}.conv{n}.weight"]
                for end in ("weight", "bias", "running_mean", "running_var"):
                    found[f"{new}.batch_norm{n}.{end}"] = state[f"{old}.bn{n}.{end}"]
    return found


def test_the_text_side_is_transformers_clip(weights: Path) -> None:
    from transformers import CLIPTextConfig, CLIPTextModelWithProjection

    state = {name: value.float() for name, value in published().items()}
    network, _ = network_of(state, weights)
    end = len(VOCABULARY) - 1
    config = CLIPTextConfig(
        vocab_size=len(VOCABULARY), hidden_size=TEXT, intermediate_size=4 * TEXT,
        num_hidden_layers=TEXT_BLOCKS, num_attention_heads=TEXT // 64, projection_dim=EMBEDDING,
        max_position_embeddings=CONTEXT, hidden_act="quick_gelu", eos_token_id=end,
        bos_token_id=end - 1, pad_token_id=0,
    )  # fmt: skip
    theirs = CLIPTextModelWithProjection(config).eval()
    clip = {k.removeprefix("clip_pretrained."): v for k, v in state.items() if "clip" in k}
    keys = {
        name: _from_clip(name, clip) for name in theirs.state_dict() if "position_ids" not in name
    }
    theirs.load_state_dict(keys, strict=False)
    tokens = torch.tensor([[end - 1, 4, 9, end, 0, 0], [end - 1, 30, 2, 7, 8, end]])
    with torch.inference_mode():
        wanted = theirs(tokens).text_embeds
        found = network.text(tokens, torch.tensor([3, 5]))
    assert float((found[0] - found[1]).abs().max()) > 0.1
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4)


def _from_clip(name: str, clip: dict[str, torch.Tensor]) -> torch.Tensor:
    """A tensor of transformers' text side out of OpenAI's."""
    if name.endswith("token_embedding.weight"):
        return clip["token_embedding.weight"]
    if name.endswith("position_embedding.weight"):
        return clip["positional_embedding"]
    if name == "text_projection.weight":
        return clip["text_projection"].T
    end = name.rsplit(".", 1)[1]
    if "final_layer_norm" in name:
        return clip[f"ln_final.{end}"]
    parts = name.split(".")
    at = f"transformer.resblocks.{parts[parts.index('layers') + 1]}"
    if parts[-2] in ("q_proj", "k_proj", "v_proj"):
        return clip[f"{at}.attn.in_proj_{end}"].chunk(3)["qkv".index(parts[-2][0])]
    names = {"layer_norm1": "ln_1", "layer_norm2": "ln_2", "fc1": "mlp.c_fc", "fc2": "mlp.c_proj",
             "out_proj": "attn.out_proj"}  # fmt: skip
    return clip[f"{at}.{names[parts[-2]]}.{end}"]


def test_the_fullsize_network_halves_its_input() -> None:
    with torch.device("meta"):
        network = DensePredictionTransformer(Sizes())
        found = network(torch.zeros(1, 3, 352, 480))
    assert found.shape == (1, 256, 176, 240)
