"""An executor that works here on what another process would get."""

from typing import Any

import pytest


class Elsewhere:
    """Sends what is shared, and each item, through the pickle that Ray has; works on it here.

    `shared` has what was sent of each call, `items` the items of all calls.
    """

    def __init__(self) -> None:
        self.shared: list[Any] = []
        self.items: list[Any] = []
        self._pickle = pytest.importorskip("ray.cloudpickle", reason="extra ray not installed")

    def map(self, function, items, *, shared):
        self.shared.append(self._again(shared))
        for item in items:
            self.items.append(self._again(item))
            yield from function(self.shared[-1], self.items[-1])

    def _again(self, value: Any) -> Any:
        return self._pickle.loads(self._pickle.dumps(value))
