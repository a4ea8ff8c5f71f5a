"""How large to draw while a camera moves, so that frames come often enough."""

from collections import deque
from statistics import median

SIZES = (0.4, 0.5, 0.63, 0.8, 1.0)
"""Shares of the full width; pixels grow by some 1.6 from one to the next."""

_SECONDS = 1 / 15
"""What a frame may take: 15 a second."""

_TOO_LONG = 1.15
_ROOM = 0.85
"""Of these seconds: from where on frames are made smaller, and what a larger one may take."""

_FRAMES, _KEPT = 3, 5
"""A size is judged from its third frame on, by the median of the last five: a slow frame now and
then changes nothing."""


class Pace:
    r"""The size of the next frame.

    With the same load it never goes back and forth. A frame of s times the width takes between
    once and :math:`s^2` times as long. It is drawn larger only if even :math:`s^2` times would be
    within 0.85 of the seconds that a frame may take, and smaller only if it takes 1.15 of them: no
    size that was left for taking too long is taken up again before frames have become quicker.
    """

    def __init__(self) -> None:
        self._at = 1
        self._spent: deque[float] = deque(maxlen=_KEPT)

    @property
    def scale(self) -> float:
        """Share of the full width, 0.4 to 1."""
        return SIZES[self._at]

    def took(self, seconds: float) -> None:
        """Hear that a frame of this size took so long."""
        self._spent.append(seconds)
        if len(self._spent) < _FRAMES:
            return
        spent, before = median(self._spent), self._at
        if spent > _TOO_LONG * _SECONDS:
            self._at = self._smaller(spent)
        elif self._at + 1 < len(SIZES):
            growth = (SIZES[self._at + 1] / SIZES[self._at]) ** 2
            if spent * growth < _ROOM * _SECONDS:
                self._at += 1
        if self._at != before:
            self._spent.clear()

    def _smaller(self, spent: float) -> int:
        """The largest smaller size that could be quick enough, else the smallest."""
        for at in range(self._at - 1, 0, -1):
            if spent * (SIZES[at] / self.scale) ** 2 <= _SECONDS:
                return at
        return 0
