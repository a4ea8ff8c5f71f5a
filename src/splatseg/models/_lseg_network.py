"""LSeg's network: a dense prediction transformer, CLIP's text encoder, a convolution between them.

Ranftl et al. 2021 (arXiv:2103.13413), Radford et al. 2021 (arXiv:2103.00020, section 2.4), Li et
al. 2022 (arXiv:2201.03546, section 3). What the papers leave open (bilinear positions, corners that
stay corners, ReLU before the convolutions of a unit) is as the published weights were trained with.
"""

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int64
from torch import Tensor, nn

LEVELS = 4
"""Levels of the pyramid that a dense prediction transformer makes."""

PATCH = 16
"""Pixels of the input that a token of the image stands for, along both axes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sizes:
    """Numbers that say what the network's tensors are; its weights' shapes tell them."""

    grid: int = 24
    """Tokens along both axes that positions were learned for: 384 pixels."""

    width: int = 1024
    """Channels of a token of the image."""

    blocks: int = 24
    channels: tuple[int, int, int, int] = (256, 512, 1024, 1024)
    """Channels of the pyramid's levels, the finest first."""

    decoder: int = 256
    """Channels of the decoder, and of its dense embedding."""

    embedding: int = 512
    """Channels of the space that images and words share."""

    text_width: int = 512
    text_blocks: int = 12
    context: int = 77
    """Most tokens of a text, its begin and its end included."""

    vocabulary: int = 49408
    """Tokens that are known."""


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


_TEXT_EPSILON = 1e-5


class TextTransformer(nn.Module):
    """Tokens of a text as one vector: the last token's, as each attends to those before it."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        self.tokens = nn.Embedding(sizes.vocabulary, sizes.text_width)
        self.positions = nn.Parameter(torch.zeros(sizes.context, sizes.text_width))
        self.blocks = nn.ModuleList(
            Block(sizes.text_width, causal=True, activation="quick_gelu", epsilon=_TEXT_EPSILON)
            for _ in range(sizes.text_blocks)
        )
        self.norm = nn.LayerNorm(sizes.text_width, eps=_TEXT_EPSILON)
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


_IMAGE_EPSILON = 1e-6


class ImageTransformer(nn.Module):
    """A vision transformer whose tokens are read at four depths."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        self.patches = nn.Conv2d(3, sizes.width, kernel_size=PATCH, stride=PATCH)
        self.class_token = nn.Parameter(torch.zeros(1, 1, sizes.width))
        self.positions = nn.Parameter(torch.zeros(1, 1 + sizes.grid**2, sizes.width))
        self.blocks = nn.ModuleList(
            Block(sizes.width, causal=False, activation="gelu", epsilon=_IMAGE_EPSILON)
            for _ in range(sizes.blocks)
        )
        self._grid = sizes.grid

    def forward(
        self, batch: Float[Tensor, "n 3 height width"]
    ) -> tuple[list[Float[Tensor, "n tokens width"]], tuple[int, int]]:
        """Tokens after each quarter of the blocks, the class token first; rows and columns."""
        found = self.patches(batch)
        rows, columns = (int(side) for side in found.shape[-2:])
        tokens = found.flatten(2).transpose(1, 2)
        first = self.class_token.expand(len(batch), -1, -1)
        tokens = torch.cat([first, tokens], dim=1) + self._positions_of(rows, columns)
        read: list[Tensor] = []
        for index, block in enumerate(self.blocks, 1):
            tokens = block(tokens)
            if index % (len(self.blocks) // LEVELS) == 0:
                read.append(tokens)
        return read, (rows, columns)

    def _positions_of(self, rows: int, columns: int) -> Float[Tensor, "1 tokens width"]:
        """Learned positions at another size of the grid, by bilinear interpolation."""
        if (rows, columns) == (self._grid, self._grid):
            return self.positions
        learned = self.positions[:, 1:].unflatten(1, (self._grid, self._grid)).permute(0, 3, 1, 2)
        resized = F.interpolate(learned, (rows, columns), mode="bilinear", align_corners=False)
        return torch.cat([self.positions[:, :1], resized.flatten(2).transpose(1, 2)], dim=1)


class Reassemble(nn.Module):
    """Tokens of one depth as a level of a pyramid: eq. 1 to 3 of DPT with the readout *project*.

    The class token is joined to every other token and the two are projected to one; the tokens
    are laid out as an image, given the level's channels, and resampled to 4, 2, 1 or 1/2 times
    the rows and columns.
    """

    def __init__(self, width: int, channels: int, *, level: int) -> None:
        super().__init__()
        self.readout = nn.Linear(2 * width, width)
        self.project = nn.Conv2d(width, channels, kernel_size=1)
        if level < 2:
            times = (4, 2)[level]
            self.resample: nn.Module = nn.ConvTranspose2d(
                channels, channels, kernel_size=times, stride=times
            )
        elif level == 2:
            self.resample = nn.Identity()
        else:
            self.resample = nn.Conv2d(channels, channels, kernel_size=3, stride=2, padding=1)

    def forward(
        self, tokens: Float[Tensor, "n tokens width"], grid: tuple[int, int]
    ) -> Float[Tensor, "n channels rows columns"]:
        """The level of the pyramid."""
        patches, whole = tokens[:, 1:], tokens[:, :1]
        joined = torch.cat([patches, whole.expand_as(patches)], dim=-1)
        read = F.gelu(self.readout(joined))
        return self.resample(self.project(read.transpose(1, 2).unflatten(2, grid)))


class ResidualUnit(nn.Module):
    """Two convolutions, each after a ReLU and before a batch normalisation, and a residual.

    The unit of RefineNet, Lin et al. 2017 (arXiv:1611.06612), figure 2 b, with normalisation.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv_1 = nn.Conv2d(channels, channels, kernel_size=3, padding=1, bias=False)
        self.norm_1 = nn.BatchNorm2d(channels)
        self.conv_2 = nn.Conv2d(channels, channels, kernel_size=3, padding=1, bias=False)
        self.norm_2 = nn.BatchNorm2d(channels)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """The map with what the convolutions add."""
        inner = self.norm_1(self.conv_1(F.relu(x)))
        return x + self.norm_2(self.conv_2(F.relu(inner)))


class Fusion(nn.Module):
    """One level of the pyramid joined to what came of the coarser ones, at twice the size."""

    def __init__(self, channels: int, decoder: int, *, coarsest: bool) -> None:
        super().__init__()
        self.reduce = nn.Conv2d(channels, decoder, kernel_size=3, padding=1, bias=False)
        self.merge = None if coarsest else ResidualUnit(decoder)
        self.refine = ResidualUnit(decoder)
        self.out = nn.Conv2d(decoder, decoder, kernel_size=1)

    def forward(
        self, level: Float[Tensor, "n c h w"], coarser: Float[Tensor, "n d h w"] | None
    ) -> Float[Tensor, "n d 2*h 2*w"]:
        """The joined map."""
        fused = self.reduce(level)
        if self.merge is not None and coarser is not None:
            fused = coarser + self.merge(fused)
        fused = self.refine(fused)
        larger = F.interpolate(fused, scale_factor=2, mode="bilinear", align_corners=True)
        return self.out(larger)


class DensePredictionTransformer(nn.Module):
    """An image as a dense map of half its size: the decoder's, before the space of words."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        self.transformer = ImageTransformer(sizes)
        self.levels = nn.ModuleList(
            Reassemble(sizes.width, channels, level=level)
            for level, channels in enumerate(sizes.channels)
        )
        self.fusions = nn.ModuleList(
            Fusion(channels, sizes.decoder, coarsest=level == LEVELS - 1)
            for level, channels in enumerate(sizes.channels)
        )

    def forward(
        self, batch: Float[Tensor, "n 3 height width"]
    ) -> Float[Tensor, "n decoder height/2 width/2"]:
        """The decoder's map.

        Args:
            batch: Normalised images. Sides are multiples of two patches (32 pixels), so that the
                coarsest level is exactly half as large as the next.
        """
        tokens, grid = self.transformer(batch)
        pyramid = [
            level(one, grid) for level, one in zip(self.levels, tokens, strict=True)
        ]  # fmt: skip
        fused: Tensor | None = None
        for fusion, level in zip(reversed(self.fusions), reversed(pyramid), strict=True):
            fused = fusion(level, fused)
        return pyramid[0] if fused is None else fused


class LSegNetwork(nn.Module):
    """Images and words in one space; Li et al. 2022, section 3."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        self.image = DensePredictionTransformer(sizes)
        self.head = nn.Conv2d(sizes.decoder, sizes.embedding, kernel_size=1)
        self.text = TextTransformer(sizes)

    def in_word_space(self, decoded: Float[Tensor, "*n decoder"]) -> Float[Tensor, "*n embedding"]:
        """Unit vectors in the space of words of vectors of the decoder's map.

        The head is linear, so it may come after anything that is: averaging, lifting.
        """
        weight, bias = self.head.weight[:, :, 0, 0], self.head.bias
        return F.normalize(F.linear(decoded.to(weight), weight, bias).float(), dim=-1)
