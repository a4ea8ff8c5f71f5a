"""How many threads and which instructions the kernels use. Results do not depend on threads."""

from splatseg import _native
from splatseg._check import check_choice
from splatseg.errors import BackendError, RangeError

ISAS = ("avx512", "avx2", "portable")


def threads() -> int:
    """Threads the kernels use: all the process may run on, or ``SPLATSEG_THREADS``."""
    return _native.threads()


def set_threads(count: int) -> None:
    """Use this many threads from now on. The results stay the same to the bit."""
    if count < 1:
        raise RangeError(f"threads: expected at least 1, got {count}.")
    _native.set_threads(count)


def isa() -> str:
    """Instruction set in use: the best there is, or ``SPLATSEG_ISA``."""
    return _native.isa()


def set_isa(name: str) -> None:
    """Use one of ``avx512``, ``avx2``, ``portable`` from now on.

    Raises:
        BackendError: If this machine or this build does not have it.
    """
    check_choice("isa", name, ISAS)
    if not _native.set_isa(name):
        raise BackendError(f"isa: this machine or build has no {name} kernels.")
