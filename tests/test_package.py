"""What is shipped: the wheel carries its data, and importing the package does nothing."""

import ast
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import hylios_fit

ROOT = Path(__file__).resolve().parents[1]


def python(code: str, cwd: Path = ROOT, **environment: str) -> str:
    """Standard output of `code` in a fresh interpreter."""
    done = subprocess.run(
        [sys.executable, "-W", "error::RuntimeWarning", "-c", code],
        cwd=cwd,
        env=os.environ | environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_importing_the_package_imports_nothing_else():
    code = """
import sys
import numpy  # what an interpreter has beside ours
before = set(sys.modules)
import hylios_fit
print(sorted({name.partition(".")[0] for name in set(sys.modules) - before}))
"""
    assert python(code) == "['hylios_fit']"


def test_public_names_leave_the_slow_modules_and_the_device_alone():
    code = """
import sys
import hylios_fit
for name in hylios_fit.__all__:
    getattr(hylios_fit, name)
slow = {"matplotlib", "sklearn", "colour", "arviz", "pandas", "zarr", "xarray"}
assert not slow & set(sys.modules), slow & set(sys.modules)
from jax._src import xla_bridge
assert not xla_bridge._backends, xla_bridge._backends
import jax
assert not jax.config.jax_enable_x64
"""
    assert python(code) == ""


def test_every_public_name_is_there():
    assert set(hylios_fit.__all__) <= set(dir(hylios_fit))
    for name in hylios_fit.__all__:
        assert callable(getattr(hylios_fit, name)), name


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'spectrum'"):
        hylios_fit.spectrum  # noqa: B018


@pytest.mark.parametrize("first", ["hylios_fit.report", "hylios_fit.cli", "hylios_fit.inversion"])
def test_report_is_the_function_whatever_is_imported_first(first):
    code = f"""
import importlib
importlib.import_module({first!r})
import hylios_fit
print(type(hylios_fit.report).__name__, hylios_fit.report.__module__)
"""
    assert python(code) == "function hylios_fit.report"


def test_the_docstring_lists_every_module_after_those_it_imports():
    listed = [
        line.split()[0] for line in hylios_fit.__doc__.splitlines() if line.startswith("    ")
    ]
    package = Path(hylios_fit.__file__).parent
    modules = {path.stem for path in package.glob("*.py")} - {"__init__", "__main__"}
    assert set(listed) == modules
    for module in modules:
        above = {*listed[: listed.index(module)], "__version__"}
        assert imported(package / f"{module}.py") <= above, module


def imported(path: Path) -> set[str]:
    """Names of this package that a module imports, at its top or inside a function.

    What is imported for the type checker alone does not count.
    """
    found = set()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            node.body = []
        if isinstance(node, ast.Import):
            parts = [alias.name.split(".") for alias in node.names]
            found |= {part[1] for part in parts if part[0] == "hylios_fit" and len(part) > 1}
        if isinstance(node, ast.ImportFrom):
            name = (node.module or "").split(".")
            if node.level:
                name = ["hylios_fit", *filter(None, name)]
            if name[0] == "hylios_fit":
                found |= {name[1]} if len(name) > 1 else {alias.name for alias in node.names}
    return found


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A folder with the package as its wheel installs it."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    build = ["wheel", "--no-deps", "--no-build-isolation", "--no-index", "-w", str(folder)]
    subprocess.run([*pip, *build, str(ROOT)], check=True)
    (wheel,) = folder.glob("*.whl")
    site = folder / "site"
    install = ["install", "--no-deps", "--no-index", "--no-compile", "--target", str(site)]
    subprocess.run([*pip, *install, str(wheel)], check=True)
    return site


def test_the_wheel_has_every_data_file_and_nothing_of_the_repository(installed):
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "data"],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    if listed.returncode:
        pytest.skip("not a git checkout: nothing says which files of data/ belong to it")
    tracked = {Path(name) for name in listed.stdout.split() if not name.endswith(".py")}
    package = installed / "hylios_fit"
    assert {path.relative_to(package) for path in (package / "data").rglob("*") if path.is_file()} \
        == tracked  # fmt: skip
    top = {path.name for path in installed.iterdir() if not path.name.endswith(".dist-info")}
    assert top == {"hylios_fit", "bin"}


def test_the_installed_package_fits_a_spectrum_outside_the_repository(installed, tmp_path):
    code = """
import sys
from pathlib import Path
import hylios_fit
from hylios_fit import cli, datasets, spectra

assert Path(hylios_fit.__file__).is_relative_to(SITE), hylios_fit.__file__
assert datasets.measured_examples_path().is_relative_to(SITE)
datasets.verify()
examples = spectra.read_spectra(datasets.measured_examples_path())
nm, values = examples.bands(0)
spectra.write_csv("one.csv", ("wavelength_nm", "one"), zip(nm, values))
print(cli.main(["fit", "one.csv", "-o", "result"]))
""".replace("SITE", repr(str(installed)))
    assert python(code, tmp_path, PYTHONPATH=str(installed)).splitlines()[-1] == "0"
    rows = (tmp_path / "result" / "estimates.csv").read_text(encoding="utf-8").splitlines()
    assert len(rows) == 2
    assert rows[1].startswith("one,")


def test_the_lock_pins_every_dependency_and_names_no_index():
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    assert "://" not in lock
    assert "://" not in (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    pinned = set(re.findall(r"^([a-z0-9-]+)==", lock, flags=re.MULTILINE))
    assert not re.search(r"^jax(lib)?==0\.10\.", lock, flags=re.MULTILINE)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = list(project["dependencies"])
    for extra in project["optional-dependencies"].values():
        wanted += extra
    assert {re.match(r"[\w-]+", text)[0].lower() for text in wanted} <= pinned


def test_the_readme_gives_one_command_for_the_tests():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(re.findall(r"^python3 -m venv .* pytest", readme, flags=re.MULTILINE)) == 1
