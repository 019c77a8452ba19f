"""`python -m experiments NAME` runs and draws an experiment; `--list` names them."""

import argparse
import contextlib
import importlib
import inspect
import json
import math
import pkgutil
import platform
import subprocess
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import experiments
import hylios_fit
from hylios_fit.files import atomic_text

RESULTS = Path(__file__).parent / "results"
PACKAGES = (
    "jax", "jaxlib", "numpy", "scipy", "optimistix", "emcee", "arviz", "scikit-learn",
    "colour-science",
)  # fmt: skip


def main() -> int:
    names = [module.name for module in pkgutil.iter_modules(experiments.__path__)]
    names = [name for name in names if not name.startswith("_")]
    parser = argparse.ArgumentParser(prog="python -m experiments", description=__doc__)
    parser.add_argument("name", nargs="?", choices=names, metavar="NAME")
    parser.add_argument("--list", action="store_true", help="name the experiments and end")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--draw-only", action="store_true", help="draw from the saved result")
    args = parser.parse_args()
    if args.list or args.name is None:
        for name in names:
            summary = (importlib.import_module(f"experiments.{name}").__doc__ or "").strip()
            print(f"{name:24}{summary.splitlines()[0] if summary else ''}")
        return 0

    module = importlib.import_module(f"experiments.{args.name}")
    saved = RESULTS / f"{args.name}{_suffix()}.json"
    if not args.draw_only:
        _save(saved, _run(module, args.seed))
    if not saved.exists():
        parser.error(f"{saved} does not exist: run the experiment first")
    figure = saved.with_suffix(".png")
    module.draw(json.loads(saved.read_text(encoding="utf-8"))["result"], figure)
    print(f"{saved}\n{figure}")
    return 0


def _run(module, seed: int) -> dict:
    # An experiment without a random choice takes no seed, and its record says so.
    seeded = "seed" in inspect.signature(module.run).parameters
    record = {
        "experiment": module.__name__.rpartition(".")[2],
        "seed": seed if seeded else None,
        "python": platform.python_version(),
        "versions": {"hylios_fit": hylios_fit.__version__} | _versions(),
        "device": _device(),
        "commit": _commit(),
    }
    start = time.perf_counter()
    result = module.run(seed=seed) if seeded else module.run()
    return record | {"seconds": round(time.perf_counter() - start, 1), "result": result}


def _suffix() -> str:
    """What results of an accelerator have at the end of their name."""
    import jax

    kind = jax.default_backend()
    return "" if kind == "cpu" else f"_{kind}"


def _versions() -> dict[str, str]:
    """Of what is installed: no experiment needs all of them."""
    found = {}
    for package in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def _device() -> str:
    import jax

    device = jax.devices()[0]
    return f"{device.platform} {device.device_kind} ({platform.machine()})"


def _commit() -> str:
    """The commit that ran, with `+changes` where the tree differs from it."""
    where = Path(__file__).parent
    try:
        commit = subprocess.run(
            ["git", "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+changes"],
            cwd=where, capture_output=True, text=True, check=True,
        )  # fmt: skip
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return commit.stdout.strip()


def _save(path: Path, record: dict) -> None:
    with atomic_text(path) as file:
        json.dump(_plain(record), file, indent=1, allow_nan=False)
        file.write("\n")


def _plain(value):
    """Arrays as lists, and no NaN, which JSON does not have."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


if __name__ == "__main__":
    sys.exit(main())
