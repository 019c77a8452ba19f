"""One strict setting for every test: no silent promotion of dtype or rank, in either precision.

What one process of the run has compiled, another and the commands that it starts need not.
"""

import os
import shutil
import tempfile

os.environ.setdefault("MPLBACKEND", "Agg")

import jax
import jax.numpy as jnp
import pytest

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_configure(config):
    if hasattr(config, "workerinput") or "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    # only for the processes that are started from here: JAX is imported already
    folder = tempfile.mkdtemp(prefix="hylios_fit-compiled-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.5"
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # or each that is found is told of
    config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))


@pytest.fixture
def x64():
    """Double precision for this test alone."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(params=["float32", "float64"])
def dtype(request):
    """The test runs once in each precision and makes its arrays of this dtype."""
    with jax.enable_x64(request.param == "float64"):
        yield jnp.dtype(request.param)


@pytest.fixture
def key():
    return jax.random.key(20150402)
