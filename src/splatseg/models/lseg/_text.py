"""The text side of LSeg: the frozen text encoder of CLIP.

Radford et al. 2021 (arXiv:2103.00020), section 2.4.
"""

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from splatseg.models.lseg._sizes import Sizes
from splatseg.models.lseg._transformer import Block

_EPSILON = 1e-5


class TextTransformer(nn.Module):
    """Tokens of a text as one vector: the last token's, as each attends to those before it."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        self.tokens = nn.Embedding(sizes.vocabulary, sizes.text_width)
        self.positions = nn.Parameter(torch.zeros(sizes.context, sizes.text_width))
        self.blocks = nn.ModuleList(
            Block(sizes.text_width, causal=True, activation="quick_gelu", epsilon=_EPSILON)
            for _ in range(sizes.text_blocks)
        )
        self.norm = nn.LayerNorm(sizes.text_width, eps=_EPSILON)
        self.projection = nn.Parameter(torch.zeros(sizes.text_width, sizes.embedding))

    def forward(
        self, tokens: Int64[Tensor, "n tokens"], last: Int64[Tensor, "n"]
    ) -> Float[Tensor, "n embedding"]:
        """A vector a text, not normalised.

        Args:
            tokens: Texts, filled up to one length with any token.
            last: Index of each text's last token, its end.
        """
        states = self.tokens(tokens) + self.positions[: tokens.shape[1]]
        for block in self.blocks:
            states = block(states)
        ends = states[torch.arange(len(states), device=states.device), last]
        return self.norm(ends) @ self.projection
