"""Each test that asks for it runs on every instruction set that this machine has."""

from collections.abc import Iterator

import pytest

from splatseg import _native


@pytest.fixture(params=["avx512", "avx2", "portable"])
def every_isa(request: pytest.FixtureRequest) -> Iterator[str]:
    before = _native.isa()
    if not _native.set_isa(request.param):
        pytest.skip(f"no {request.param} here")
    yield request.param
    _native.set_isa(before)
