"""The command line: reads arguments, calls the library, writes files.

Exit status: 0 done; 1 a defect of the program; 2 unusable input, with one line on standard error;
3 (`fit`) some spectra were not fitted; 130 interrupted.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

# The modules that do the work are imported by the command that needs them, so that `--help`
# and a wrong option answer at once.
from hylios_fit.errors import HyliosError

if TYPE_CHECKING:
    from hylios_fit.results import Fit
    from hylios_fit.spectra import Spectra
    from hylios_fit.surrogate import Surrogate

SIZES = ("small", "large")
METHODS = ("walker", "analog", "adding", "surrogate")
SIMULATION_HEADER = ("wavelength_nm", "reflectance", "standard_error", "surface", "subsurface")
SENSITIVITY_HEADER = ("material", "domain", "msi", "msi_counted")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; return its exit status."""
    args = _parser().parse_args(argv)
    try:
        return args.run(args)
    except HyliosError as error:
        if args.debug:
            raise
        print(f"hylios-fit: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        if args.debug:
            raise
        print("hylios-fit: interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        if args.debug:
            raise
        # A defect of ours: still one line, which says how to see the rest.
        print(
            f"hylios-fit: error: unexpected {type(error).__name__}: {_one_line(error)} "
            "(--debug shows where)",
            file=sys.stderr,
        )
        return 1


class _Parser(argparse.ArgumentParser):
    """Errors in one line, without the usage above them."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message}\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="hylios-fit",
        description="Melanin, blood and water from measured skin spectra, with uncertainty.",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=_version())
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def command(name: str, run: Any, summary: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=summary, description=summary, allow_abbrev=False)
        sub.add_argument("--debug", action="store_true", help="show the traceback of an error")
        sub.set_defaults(run=run)
        return sub

    demo = command("demo", _demo, "fit the measured skin spectra that ship with the package")
    demo.add_argument("-o", dest="output", metavar="DIR", default="demo", help="default: demo")
    _seed(demo)

    simulate = command("simulate", _simulate, "reflectance of a specimen")
    _specimen(simulate)
    simulate.add_argument("--method", choices=METHODS, default="walker")
    simulate.add_argument(
        "--output",
        dest="quantity",
        choices=("reflectance", "brdf", "bssrdf"),
        default="reflectance",
        help="brdf: by direction; bssrdf: by distance (walker only); default: reflectance",
    )
    simulate.add_argument(
        "--incidence", type=float, default=8.0, metavar="DEG", help="from the normal; default: 8"
    )
    simulate.add_argument("--rays", type=_count, metavar="N", help="rays for each wavelength")
    simulate.add_argument(
        "--tolerance",
        type=float,
        metavar="SE",
        help="go on until every wavelength's standard error is below this",
    )
    simulate.add_argument(
        "--smooth-surface", action="store_true", help="a flat surface instead of Eq. 8's"
    )
    simulate.add_argument(
        "--independent-particles",
        action="store_true",
        help="no rejection of melanosomes that overlap or cross a boundary",
    )
    _seed(simulate)

    optics = command("optics", _optics, "the coefficients that the transport sees")
    _specimen(optics)

    sensitivity = command(
        "sensitivity", _sensitivity, "mean sensitivity index of each material, by domain"
    )
    _specimen(sensitivity, wavelengths=False)
    sensitivity.add_argument("--method", choices=METHODS, default="adding")
    sensitivity.add_argument(
        "--incidence", type=float, default=8.0, metavar="DEG", help="from the normal; default: 8"
    )
    sensitivity.add_argument("--rays", type=_count, metavar="N", help="rays of a walk")
    sensitivity.add_argument(
        "--counted",
        type=_count,
        metavar="N",
        default=100_000,
        help="rays of the curves whose index msi_counted is; default: 100000, the paper's",
    )
    _seed(sensitivity)

    table = command("table", _table, "simulate a training table")
    table.add_argument("-o", dest="output", metavar="TABLE", required=True)
    table.add_argument("--rows", type=_count, metavar="N", help="specimens in the whole table")
    table.add_argument(
        "--resume",
        action="store_true",
        help="go on with a table, or append --rows; several processes may do so at once",
    )
    table.add_argument("--generator", choices=("walker", "adding"), default="walker")
    table.add_argument(
        "--dask", metavar="ADDRESS", help="of a Dask scheduler whose workers share the folder"
    )
    _seed(table)

    train = command(
        "train", _train, "train a surrogate from a table; interrupted, it goes on where it was"
    )
    train.add_argument("table", metavar="TABLE")
    train.add_argument("-o", dest="output", metavar="SURROGATE", required=True)
    train.add_argument(
        "--size", choices=SIZES, default="large",
        help="small: twice the error, nearly three times as fast in batches of few bands",
    )  # fmt: skip

    check = command("check", _check, "held-out errors of a surrogate and the range it knows")
    check.add_argument(
        "surrogate",
        metavar="SURROGATE",
        nargs="?",
        help="a file, or an embedded one, large (default) or small",
    )

    fit = command("fit", _fit, "melanin, blood and water from measured spectra")
    fit.add_argument("spectra", metavar="SPECTRA.csv")
    fit.add_argument("-o", dest="output", metavar="DIR", required=True)
    fit.add_argument("--unit", choices=("auto", "fraction", "percent"), default="auto")
    fit.add_argument("--range", metavar="LOW:HIGH", help="bands to use, nm, such as 400:700")
    fit.add_argument(
        "--specular",
        choices=("included", "excluded"),
        default="included",
        help="whether the surface's reflection is part of the measurement; default: included",
    )
    fit.add_argument(
        "--free",
        metavar="NAME,...",
        help="parameters to estimate; `usual`, the default, is pigments, blood, water and lipids",
    )
    fit.add_argument(
        "--fix", action="append", default=[], metavar="NAME=VALUE", help="hold one; repeatable"
    )
    fit.add_argument(
        "--noise",
        metavar="VALUE|COLUMN",
        help="standard deviation of a band's reflectance, or the column that has it",
    )
    fit.add_argument(
        "--surrogate",
        metavar="FILE",
        help="a file, or an embedded one, large (default) or small",
    )
    fit.add_argument("--posterior", action="store_true", help="sample each posterior with emcee")
    _seed(fit)

    report = command("report", _report, "the page again from the files in DIR")
    report.add_argument("directory", metavar="DIR")
    return parser


def _specimen(parser: argparse.ArgumentParser, wavelengths: bool = True) -> None:
    parser.add_argument("specimen", metavar="SPECIMEN", help="S1 to S4, or a TOML file")
    parser.add_argument("-o", dest="output", metavar="FILE.csv", required=True)
    if wavelengths:
        parser.add_argument(
            "--wavelengths",
            default="250:2500:5",
            metavar="LOW:HIGH:STEP",
            help="nm, or a list such as 450,550,650; default: 250:2500:5",
        )
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="repeatable"
    )


def _seed(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=_seed_value, default=0, metavar="K", help="default: 0")


def _count(text: str) -> int:
    value = int(text) if text.isdecimal() else 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1, got {text!r}")
    return value


def _seed_value(text: str) -> int:
    # A key is made from 32 bits; a larger seed would silently be another one.
    if not text.isdecimal() or int(text) >= 2**32:
        raise argparse.ArgumentTypeError(
            f"expected a whole number from 0 to {2**32 - 1}, got {text!r}"
        )
    return int(text)


def _version() -> str:
    from hylios_fit import __version__

    return f"hylios-fit {__version__}"


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())


# --- simulation --------------------------------------------------------------------------------


def _simulate(args: argparse.Namespace) -> int:
    output = _output_file(args.output)
    specimen, wavelengths = _read_specimen(args)
    import jax

    from hylios_fit.simulation import simulate
    from hylios_fit.spectra import write_csv

    options = {} if args.rays is None else {"rays": args.rays}
    if args.quantity != "reflectance":
        return _simulate_exits(args, output, specimen, wavelengths, options)
    curve = simulate(
        specimen,
        wavelengths,
        method=args.method,
        key=jax.random.key(args.seed),
        incidence=args.incidence,
        tolerance=args.tolerance,
        smooth_surface=args.smooth_surface,
        independent_particles=args.independent_particles,
        progress=True,
        **options,
    )
    columns = [getattr(curve, name) for name in SIMULATION_HEADER]
    write_csv(
        output,
        SIMULATION_HEADER,
        ([f"{value:.7g}" for value in row] for row in zip(*columns, strict=True)),
    )
    if curve.note:
        _note(curve.note)
    return _wrote(output)


def _note(*notes: str) -> None:
    for note in notes:
        print(f"note: {note}", file=sys.stderr)


def _simulate_exits(
    args: argparse.Namespace, output: Path, specimen: Any, wavelengths: Any, options: dict[str, Any]
) -> int:
    if args.method != "walker" or args.tolerance is not None:
        raise HyliosError(f"--output {args.quantity}: only by --method walker, without --tolerance")
    import jax

    from hylios_fit import exits
    from hylios_fit.spectra import write_csv

    run = exits.simulate_brdf if args.quantity == "brdf" else exits.simulate_bssrdf
    found = run(
        specimen,
        wavelengths,
        key=jax.random.key(args.seed),
        incidence=args.incidence,
        smooth_surface=args.smooth_surface,
        independent_particles=args.independent_particles,
        progress=True,
        **options,
    )
    write_csv(output, *found.rows())
    return _wrote(output)


def _optics(args: argparse.Namespace) -> int:
    output = _output_file(args.output)
    specimen, wavelengths = _read_specimen(args)
    from hylios_fit.skin import optics_rows
    from hylios_fit.spectra import write_csv

    header, rows = optics_rows(specimen, wavelengths)
    write_csv(output, header, rows)
    return _wrote(output)


def _sensitivity(args: argparse.Namespace) -> int:
    output = _output_file(args.output)
    specimen = _set_specimen(args)
    import jax

    from hylios_fit.sensitivity import sensitivity
    from hylios_fit.spectra import write_csv

    found = sensitivity(
        specimen,
        method=args.method,
        key=jax.random.key(args.seed),
        incidence=args.incidence,
        progress=True,
        **({} if args.rays is None else {"rays": args.rays}),
    )
    rows = [
        (material, domain, f"{msi:.4g}", f"{counted:.4g}")
        for (material, domain, msi), (*_, counted) in zip(
            found.rows(), found.rows(args.counted), strict=True
        )
    ]
    write_csv(output, SENSITIVITY_HEADER, rows)
    return _wrote(output)


def _read_specimen(args: argparse.Namespace) -> tuple[Any, Any]:
    wavelengths = parse_wavelengths(args.wavelengths)
    return _set_specimen(args), wavelengths


def _set_specimen(args: argparse.Namespace) -> Any:
    from hylios_fit.skin import load_specimen, parse_setting

    specimen = load_specimen(args.specimen)
    for text in args.set:
        specimen = parse_setting(specimen, text)
    return specimen


def parse_wavelengths(text: str) -> Any:
    """Wavelengths in nm from `LOW:HIGH:STEP` (both ends included) or `A,B,...`, shape (n,).

    Raises `HyliosError` for anything else.
    """
    from hylios_fit.units import wavelengths

    expected = f"--wavelengths: expected LOW:HIGH:STEP or A,B,... in nm, got {text!r}"
    parts = text.split(":")
    try:
        if len(parts) == 3:
            low, high, step = map(float, parts)
            return wavelengths(low, high, step)
        if len(parts) == 1:
            import numpy as np

            return np.asarray([float(part) for part in text.split(",")])
    except HyliosError as error:
        raise HyliosError(f"--wavelengths: {error}") from None
    except ValueError:
        pass
    raise HyliosError(expected)


# --- table and surrogate -----------------------------------------------------------------------


def _table(args: argparse.Namespace) -> int:
    output = _output_path(args.output)
    from hylios_fit import table

    executor = None
    if args.dask is not None:
        try:
            from dask.distributed import Client
        except ImportError:
            raise HyliosError("--dask needs Dask: pip install hylios_fit[dask]") from None
        try:
            executor = Client(args.dask, timeout=10).get_executor()
        except (OSError, ValueError) as error:
            raise HyliosError(f"--dask {args.dask}: {error}") from None
    table.generate(
        output,
        rows=args.rows,
        seed=args.seed,
        resume=args.resume,
        generator=args.generator,
        executor=executor,
    )
    return _wrote(output)


def _train(args: argparse.Namespace) -> int:
    output = _output_file(args.output)
    source = _existing(args.table)
    from hylios_fit import training

    print(training.train(source, output, progress=True, size=args.size))
    return _wrote(output)


def _check(args: argparse.Namespace) -> int:
    from hylios_fit.surrogate import check_report

    print(check_report(_load_surrogate(args.surrogate)))
    return 0


def _load_surrogate(path: str | None) -> Surrogate:
    from hylios_fit.surrogate import EMBEDDED, load_surrogate

    if path in EMBEDDED and not Path(path).is_file():
        return load_surrogate(size=path)
    return load_surrogate(None if path is None else _existing(path))


# --- inversion ---------------------------------------------------------------------------------


def _fit(args: argparse.Namespace) -> int:
    directory = _output_directory(args.output)
    wavelength_range = _range(args.range)
    noise, noise_column = _noise(args.noise)
    from hylios_fit.spectra import read_spectra

    spectra = read_spectra(
        _existing(args.spectra),
        unit=args.unit,
        wavelength_range=wavelength_range,
        noise_column=noise_column,
    )
    options: dict[str, Any] = {"specular": args.specular}
    if noise is not None:
        options["noise"] = noise
    if args.free is not None:
        options["free"] = tuple(name.strip() for name in args.free.split(",") if name.strip())
    if args.fix:
        options["fix"] = dict(_assignment(text) for text in args.fix)
    surrogate = _load_surrogate(args.surrogate)
    return _invert(
        spectra,
        surrogate,
        directory,
        seed=args.seed,
        sampled="all" if args.posterior else "none",
        options=options,
    )


def _demo(args: argparse.Namespace) -> int:
    directory = _output_directory(args.output)
    from hylios_fit.datasets import measured_examples_path
    from hylios_fit.spectra import read_spectra

    start = time.perf_counter()
    spectra = read_spectra(measured_examples_path())
    # The outcome of each spectrum stands in its row; the demo itself has done what it is for.
    _invert(spectra, _load_surrogate(None), directory, seed=args.seed, sampled="one", options={})
    print(f"{time.perf_counter() - start:.0f} s")
    return 0


def _invert(
    spectra: Spectra,
    surrogate: Surrogate,
    directory: Path,
    *,
    seed: int,
    sampled: str,
    options: dict[str, Any],
) -> int:
    """Fit, sample (`none`, `one` or `all` of the spectra), write, print; return the status."""
    import jax

    from hylios_fit import inversion
    from hylios_fit.report import print_table, report, write_estimates, write_fitted
    from hylios_fit.results import write_posteriors
    from hylios_fit.sampling import sample

    _note(*spectra.notes)
    # The key itself, not one derived from it: settings.json then shows the seed that was given.
    key = jax.random.key(seed)
    fits = inversion.fit_many(spectra, surrogate, key=key, progress=True, **options)
    _make(directory)
    # What an earlier run left would be taken for this one's by `report DIR`.
    for stale in ("posterior.nc", "report.html"):
        (directory / stale).unlink(missing_ok=True)
    # The estimates first: sampling is long, and may be interrupted.
    write_estimates(directory, fits)
    write_fitted(directory, fits)

    posteriors = {}
    chains = jax.random.fold_in(key, 1)
    for index in _to_sample(fits, sampled):
        posteriors[fits[index].spectrum] = sample(
            fits[index], key=jax.random.fold_in(chains, index), surrogate=surrogate
        )
    if posteriors:
        write_posteriors(list(posteriors.values()), directory / "posterior.nc")
    page = report(fits, posteriors or None, directory / "report.html")

    print(print_table(fits))
    fitted = sum(fit.outcome.is_fitted for fit in fits)
    print(f"{fitted} of {len(fits)} spectra fitted; the page: {page}")
    return 0 if fitted == len(fits) else 3


def _to_sample(fits: Sequence[Fit], sampled: str) -> list[int]:
    """Which spectra to sample: those that were fitted, or of them the one in the middle."""
    usable = [index for index, fit in enumerate(fits) if fit.outcome.is_fitted]
    if sampled == "all":
        return usable
    return usable[len(usable) // 2 :][:1] if sampled == "one" else []


def _report(args: argparse.Namespace) -> int:
    directory = _existing(args.directory)
    from hylios_fit.report import read_dir, report

    fits, posteriors = read_dir(directory)
    return _wrote(report(fits, posteriors, directory / "report.html"))


def _range(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        raise HyliosError(f"--range: expected LOW:HIGH in nm, got {text!r}") from None
    if not low < high:
        raise HyliosError(f"--range: expected LOW below HIGH, got {text!r}")
    return low, high


def _noise(text: str | None) -> tuple[float | None, str | None]:
    """The noise as a value, or the column that has it."""
    if text is None:
        return None, None
    try:
        return float(text), None
    except ValueError:
        return None, text


def _assignment(text: str) -> tuple[str, float | str]:
    name, equals, value = text.partition("=")
    if not equals or not name.strip() or not value.strip():
        raise HyliosError(f"--fix: expected NAME=VALUE, got {text!r}")
    try:
        return name.strip(), float(value)
    except ValueError:
        return name.strip(), value.strip()


# --- paths: checked before the work, so that no long run ends in a failed write ------------------


def _existing(text: str) -> Path:
    path = Path(text)
    if not path.exists():
        raise HyliosError(f"{path}: no such file or folder")
    return path


def _output_path(text: str) -> Path:
    path = Path(text)
    if not path.absolute().parent.is_dir():
        raise HyliosError(f"{path}: there is no folder {path.parent} to write it to")
    return path


def _output_file(text: str) -> Path:
    path = _output_path(text)
    if path.is_dir():
        raise HyliosError(f"{path}: expected a file to write, got a folder")
    return path


def _output_directory(text: str) -> Path:
    path = Path(text)
    if path.exists() and not path.is_dir():
        raise HyliosError(f"{path}: expected a folder to write to, got a file")
    return path


def _make(directory: Path) -> None:
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HyliosError(f"{directory}: cannot be made: {error.strerror}") from None


def _wrote(path: Path) -> int:
    print(f"wrote {path}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
