"""One strict setting for every test: no silent promotion of dtype or rank, in either precision."""

import os
import tempfile

os.environ.setdefault("MPLBACKEND", "Agg")
# As many processes as cores test side by side: threads of one would wait for those of the other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Compiling is most of the work: what one process compiled, the others read, and the commands too.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _compiled = tempfile.TemporaryDirectory(prefix="hylios_fit-tests-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _compiled.name
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"
    os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA tells of every program that it reads

import jax
import jax.numpy as jnp
import pytest

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


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
