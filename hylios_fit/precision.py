"""Products of matrices in the precision of their numbers, on every device.

Some accelerators multiply float32 with 10 bits unless told not to.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, wraps
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

HIGHEST = "highest"
Function = TypeVar("Function", bound=Callable[..., Any])

product = partial(jnp.matmul, precision=HIGHEST)
"""A product of two matrices, or of two vectors."""


def in_full(function: Function) -> Function:
    """The function with all its products so, those of the libraries that it calls as well."""

    @wraps(function)
    def full(*args: Any, **kwargs: Any) -> Any:
        with jax.default_matmul_precision(HIGHEST):
            return function(*args, **kwargs)

    return full  # pyright: ignore[reportReturnType]
