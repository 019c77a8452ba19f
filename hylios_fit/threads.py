"""Linear algebra held to one thread.

On the small matrices of this package threads gain nothing, and where cores are few or shared they
wait for each other: a solve of 33 by 33 then takes a hundred times as long as it should.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import lru_cache
from typing import Any


def one_blas_thread() -> AbstractContextManager[Any]:
    """A context in which NumPy, SciPy and XLA on the CPU solve and multiply on one thread."""
    return _controller().limit(limits=1, user_api="blas")


@lru_cache(maxsize=1)
def _controller() -> Any:
    import scipy.linalg  # noqa: F401  # the library that XLA solves with: it must be there by now
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
