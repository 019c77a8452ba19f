"""Threads where they help, and none where they do not.

Linear algebra is held to one thread: on the small matrices of this package threads gain nothing,
and where cores are few or shared they wait for each other: a solve of 33 by 33 then takes a hundred
times as long as it should. A program of many small steps, such as a walk, XLA cannot spread over
cores: it is one piece (`in_one_piece`), and several run side by side.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import lru_cache
from importlib.metadata import version
from typing import Any, TypeVar

Item = TypeVar("Item")
Answer = TypeVar("Answer")


def cores() -> int:
    """How many this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def side_by_side(function: Callable[[Item], Answer], items: Iterable[Item]) -> Iterator[Answer]:
    """The function of each item, in their order, as many at once as there are cores; in the
    precision, also of products, and on the device that the caller set."""
    import jax

    config: Any = jax.config
    wide, device = config.jax_enable_x64, config.jax_default_device
    products = config.jax_default_matmul_precision

    def one(item: Item) -> Answer:
        with (
            jax.enable_x64(wide),
            jax.default_device(device),
            jax.default_matmul_precision(products),
        ):
            return jax.block_until_ready(function(item))

    with ThreadPoolExecutor(cores()) as pool:
        yield from pool.map(one, items)


def in_one_piece(function: Callable[[Any], Any], given: Any) -> Any:
    """The function of what is given, where it is traced: on a CPU a program of one piece.

    XLA makes a program for each step of a loop and shares them among its threads, which then wait
    for each other: a walk of small steps takes two cores half as long again as one alone needs.
    `xla_cpu_small_call` is what XLA itself marks loops with that it holds to be too small for that
    (SmallWhileLoopHoisting). It holds no scatter, and must use all that it closes over. Only for
    jaxlib 0.9: XLA promises nothing of it, and that of 0.12 marks such loops itself.
    """
    import jax

    if jax.default_backend() != "cpu" or not version("jaxlib").startswith("0.9."):
        return function(given)
    from jax.experimental.xla_metadata import set_xla_metadata

    found = jax.jit(function)(given)
    return set_xla_metadata(found, xla_cpu_small_call="true", inlineable="false")


def one_blas_thread() -> AbstractContextManager[Any]:
    """A context in which NumPy, SciPy and XLA on the CPU solve and multiply on one thread."""
    return _controller().limit(limits=1, user_api="blas")


@lru_cache(maxsize=1)
def _controller() -> Any:
    import scipy.linalg  # noqa: F401  # the library that XLA solves with: it must be there by now
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
