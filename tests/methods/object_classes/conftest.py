"""The wall of two halves that the decoder is tested on, too."""

from methods.cosseg.conftest import halves as halves
