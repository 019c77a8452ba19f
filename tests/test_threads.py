"""One thread of linear algebra, in every library that has any."""

import subprocess
import sys

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
    run = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=False, timeout=120
    )
    assert run.returncode == 0, run.stderr
