"""Every test of rendering runs on every backend, and on every instruction set of the CPU's."""

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

# The scenes are a module beside the tests, in whatever way pytest imports these.
sys.path.insert(0, str(Path(__file__).parent))

from render_scenes import Bench

from splatseg.errors import BackendError
from splatseg.render.cpu import ISAS, isa, set_isa


def _instruction_sets() -> list[str]:
    """Those that this machine and this build have."""
    before = isa()
    found: list[str] = []
    for name in ISAS:
        try:
            set_isa(name)
        except BackendError:
            continue
        found.append(name)
    set_isa(before)
    return found


def _benches() -> list[Bench]:
    benches = [Bench("reference")]
    benches += [Bench("cpu", isa=name) for name in _instruction_sets()]
    if importlib.util.find_spec("gsplat") is not None and torch.cuda.is_available():
        # gsplat's opacity cap is built in; its backward pass recovers the transmittance from
        # 1 - alpha, which leaves 6e-4 of it uncertain where a pixel is nearly opaque.
        benches.append(
            Bench(
                "cuda",
                defaults={"alpha_max": 0.999},
                image_tolerance=1e-4,
                adjoint_tolerance=1e-3,
                sum_tolerance=1e-5,
            )
        )
    return benches


def _label(bench: Bench) -> str:
    return bench.name if bench.isa is None else f"{bench.name}-{bench.isa}"


@pytest.fixture(params=_benches(), ids=_label)
def backend(request: pytest.FixtureRequest) -> Iterator[Bench]:
    """Each backend there is; on the CPU with each instruction set."""
    bench: Bench = request.param
    before = isa()
    if bench.isa is not None:
        set_isa(bench.isa)
    yield bench
    set_isa(before)


@pytest.fixture(params=[b for b in _benches() if b.name != "reference"], ids=_label)
def fast_backend(request: pytest.FixtureRequest) -> Iterator[Bench]:
    """Each backend but the reference."""
    bench: Bench = request.param
    before = isa()
    if bench.isa is not None:
        set_isa(bench.isa)
    yield bench
    set_isa(before)


@pytest.fixture
def reference() -> Bench:
    """The readable backend."""
    return Bench("reference")
