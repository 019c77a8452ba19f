"""One thread of linear algebra, in every library that has any; loops in one piece."""

import os
import subprocess
import sys
from importlib.metadata import version

import jax
import jax.numpy as jnp
import numpy as np

from hylios_fit.threads import cores, in_one_piece, side_by_side

SCRIPT = """
from hylios_fit.threads import one_blas_thread
from threadpoolctl import threadpool_info

def threads():
    return [found["num_threads"] for found in threadpool_info() if found["user_api"] == "blas"]

with one_blas_thread():
    import numpy.linalg, scipy.linalg  # XLA solves with the latter's library
    held = threads()
assert held, "no BLAS was found"
assert set(held) == {1}, held
"""


def test_every_blas_is_held_whatever_was_loaded_before():
    free = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    run = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        capture_output=True, text=True, check=False, timeout=120, env=free,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr


def test_items_keep_their_order_and_the_callers_precision():
    assert cores() >= 1
    for wide, dtype in ((False, jnp.float32), (True, jnp.float64)):
        with jax.enable_x64(wide):
            found = list(side_by_side(lambda i: jnp.arange(3.0) + i, range(5)))
        assert [float(x[0]) for x in found] == [0.0, 1.0, 2.0, 3.0, 4.0]
        assert {x.dtype for x in found} == {jnp.dtype(dtype)}
    for products in (None, "highest"):
        with jax.default_matmul_precision(products):
            found = list(side_by_side(lambda _: jax.config.jax_default_matmul_precision, range(2)))
        assert found == [products] * 2


def test_a_loop_in_one_piece_gives_what_it_gives_in_many():
    scale = jnp.linspace(1.0, 2.0, 100)

    def steps(x):
        return jax.lax.fori_loop(0, 5, lambda i, y: (jnp.sin(scale * y[0]) + 1.0, y[1]), x)

    x = jnp.linspace(0.0, 1.0, 100), jnp.ones(3)
    many, one = jax.jit(steps), jax.jit(lambda x: in_one_piece(steps, x))
    for found, expected in zip(one(x), many(x), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-6)
    if jax.default_backend() == "cpu" and version("jaxlib").startswith("0.9."):
        assert "xla_cpu_small_call" in str(one.lower(x).compile().as_text())
