"""The whole network: image side, text side, and the convolution between them."""

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from splatseg.models.lseg._sizes import Sizes
from splatseg.models.lseg._text import TextTransformer
from splatseg.models.lseg._vision import DensePredictionTransformer


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
