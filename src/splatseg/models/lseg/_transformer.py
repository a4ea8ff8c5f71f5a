"""Blocks of transformers, as the image side (ViT) and the text side (CLIP) of LSeg have them."""

from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

HEAD_WIDTH = 64
"""Channels of a head, in both sides and at every size that was published."""

Activation = Literal["gelu", "quick_gelu"]


class Attention(nn.Module):
    r"""Attention of tokens to each other, over heads of `HEAD_WIDTH` channels.

    .. math:: \mathrm{softmax}(Q K^\top / \sqrt{d}) V

    Vaswani et al. 2017 (arXiv:1706.03762), eq. 1. A causal token attends to itself and to those
    before it.
    """

    def __init__(self, width: int, *, causal: bool) -> None:
        super().__init__()
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self._heads = max(1, width // HEAD_WIDTH)
        self._causal = causal

    def forward(self, tokens: Float[Tensor, "n tokens width"]) -> Float[Tensor, "n tokens width"]:
        """New tokens, without the residual."""
        count, length, width = tokens.shape
        parts = self.qkv(tokens).view(count, length, 3, self._heads, -1).permute(2, 0, 3, 1, 4)
        query, key, value = parts.unbind()
        mixed = F.scaled_dot_product_attention(query, key, value, is_causal=self._causal)
        return self.out(mixed.transpose(1, 2).reshape(count, length, width))


class Block(nn.Module):
    """Attention and a perceptron, each after a normalisation and with a residual.

    Dosovitskiy et al. 2021 (arXiv:2010.11929), eq. 2 and 3. CLIP has the same with x sigmoid(1.702
    x) for the activation.
    """

    def __init__(self, width: int, *, causal: bool, activation: Activation, epsilon: float) -> None:
        super().__init__()
        self.norm_1 = nn.LayerNorm(width, eps=epsilon)
        self.attention = Attention(width, causal=causal)
        self.norm_2 = nn.LayerNorm(width, eps=epsilon)
        self.wider = nn.Linear(width, 4 * width)
        self.back = nn.Linear(4 * width, width)
        self._activation = activation

    def forward(self, tokens: Float[Tensor, "n tokens width"]) -> Float[Tensor, "n tokens width"]:
        """Tokens after the block."""
        tokens = tokens + self.attention(self.norm_1(tokens))
        inner = self.wider(self.norm_2(tokens))
        inner = (
            F.gelu(inner) if self._activation == "gelu" else inner * torch.sigmoid(1.702 * inner)
        )
        return tokens + self.back(inner)
