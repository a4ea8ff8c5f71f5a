"""Sizes of an LSeg network; the published one is the default."""

from dataclasses import dataclass

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
