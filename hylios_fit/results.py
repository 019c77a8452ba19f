"""What an inversion hands back: outcomes in words, estimates, `Fit` and `Posterior`.

Notation is that of Rodgers (2000), Inverse Methods for Atmospheric Sounding: the state `z` is
whitened by its prior, so that the prior is a unit normal; `S_eps` is the covariance of noise and
surrogate error; `S_hat` that of the result.
"""

from __future__ import annotations

import enum
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from hylios_fit.errors import HyliosError
from hylios_fit.files import atomic_path

#: The four quantities that every result carries, in the order of every table.
QUANTITIES = ("melanin_mg_per_mL", "blood_percent", "oxygen_saturation", "water_percent")


class Outcome(enum.Enum):
    """How an inversion ended. The value is a word for tables; `advice` says what to do.

    `fitted`, `at_bound`, `prior_dominated` and `misfit` come with estimates that can be used as
    the advice says (`is_fitted`); the other three do not.
    """

    fitted = "fitted", "The model reproduces the spectrum within its noise."
    at_bound = (
        "at_bound",
        "The data press a parameter to the edge of the surrogate's range: read that parameter as"
        " a limit, or use a surrogate that was trained on a wider range.",
    )
    prior_dominated = (
        "prior_dominated",
        "The data tell little: most quantities carry their prior. Use only those that are"
        " informed, or measure more wavelengths.",
    )
    misfit = (
        "misfit",
        "The residual is well above the stated noise, and the intervals were widened to match it."
        " Check the noise, the unit and whether the specular part is included; or let more"
        " parameters vary.",
    )
    outside_range = (
        "outside_range",
        "No specimen in the surrogate's range looks like this spectrum. Check the unit, the"
        " calibration and that it is skin; do not use the estimates.",
    )
    not_converged = (
        "not_converged",
        "The solver ended without a minimum: do not use the estimates. Try more starts, or fix"
        " parameters that the data cannot tell.",
    )
    unusable = (
        "unusable",
        "The spectrum cannot be fitted; the message beside says why. Mend it and fit again.",
    )

    advice: str

    def __new__(cls, code: str, advice: str) -> Outcome:
        member = object.__new__(cls)
        member._value_ = code
        member.advice = advice
        return member

    @property
    def code(self) -> str:
        """The word that tables carry."""
        return self.value

    @property
    def is_fitted(self) -> bool:
        """Whether the estimates can be used (within what the advice says)."""
        return self in (
            Outcome.fitted,
            Outcome.at_bound,
            Outcome.prior_dominated,
            Outcome.misfit,
        )

    def __str__(self) -> str:
        return self.value


@dataclass(frozen=True)
class Estimate:
    """One quantity: its value, half the width of its 68 % interval, and the interval.

    `informed` is False where the data narrow the prior by less than 30 %: the estimate is then
    mostly the prior. A quantity that is held fixed has sd 0 and is not informed.
    """

    value: float
    sd: float
    low: float
    high: float
    informed: bool

    def __post_init__(self) -> None:
        if not (np.isnan(self.value) or self.low <= self.value <= self.high):
            raise HyliosError(
                f"an estimate needs low <= value <= high, got {self.low}, {self.value}, {self.high}"
            )


MISSING = Estimate(np.nan, np.nan, np.nan, np.nan, False)


def _frozen_array(value: Any) -> np.ndarray:
    array = np.array(value, dtype=np.float64)
    array.flags.writeable = False
    return array


@dataclass(frozen=True, eq=False)
class Fit:
    """The inversion of one spectrum. A spectrum that could not be fitted has one too.

    Bands `B` are the instrument's own, those within the range that was asked for; `P` are the
    free parameters. `fit["melanin_mg_per_mL"]` is an `Estimate`; so is each free parameter.

    Raises `HyliosError` where the shapes do not agree.
    """

    spectrum: str
    """Name of the spectrum."""
    outcome: Outcome
    messages: tuple[str, ...]
    """What is to be known beside the outcome, one sentence each."""
    wavelength_nm: np.ndarray
    """(B,) nm."""
    measured: np.ndarray
    """(B,) reflectance as given, NaN where missing."""
    fitted: np.ndarray
    """(B,) reflectance of the model, specular in or out as `measured`."""
    sd: np.ndarray
    """(B,) standard deviation of noise and surrogate error, as stated."""
    residual_rms: float
    """Root mean square of measured - fitted over the bands that were used."""
    reduced_chi2: float
    """Squared residual in units of `sd` for each degree of freedom, as stated."""
    inflation: float
    """Factor (>= 1) on the stated noise that the intervals take into account."""
    model_error: float
    """Share of the reflectance that they take the model to miss by instead, smoothly over
    wavelength; 0 for none."""
    iterations: int
    """Steps of the solver, all starts and forms together."""
    form: str
    """Melanosome form that was kept."""
    form_probability: Mapping[str, float]
    """Of each form that was tried, its probability given the data, by Laplace's approximation."""
    names: tuple[str, ...]
    """(P) free parameters."""
    value: np.ndarray
    """(P,) in the units of the parameters."""
    covariance: np.ndarray
    """(P, P) of `value`, to first order, with the form that was kept."""
    z: np.ndarray
    """(P,) the whitened state at the solution."""
    z_covariance: np.ndarray
    """(P, P) S_hat in the whitened state: the identity where the data tell nothing."""
    quantities: Mapping[str, Estimate]
    """The four of `QUANTITIES`, then every free parameter that is not among them."""
    fixed: Mapping[str, float] = field(default_factory=dict)
    """Parameters that were held, with their values."""
    error_covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    """(B, B) S_eps as used, with inflation or model error; bands that were missing are NaN."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Versions, seed, noise, specular, range, starts: what makes the result repeatable."""

    def __post_init__(self) -> None:
        for name in ("wavelength_nm", "measured", "fitted", "sd", "value", "covariance",
                     "z", "z_covariance", "error_covariance"):  # fmt: skip
            object.__setattr__(self, name, _frozen_array(getattr(self, name)))
        for name in ("form_probability", "quantities", "fixed", "settings"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))
        bands, free = len(self.wavelength_nm), len(self.names)
        expected = {
            "measured": (bands,), "fitted": (bands,), "sd": (bands,),
            "value": (free,), "covariance": (free, free),
            "z": (free,), "z_covariance": (free, free),
        }  # fmt: skip
        for name, shape in expected.items():
            got = getattr(self, name).shape
            if got != shape:
                raise HyliosError(f"Fit of {self.spectrum!r}: {name} has shape {got}, not {shape}")

    def __getitem__(self, name: str) -> Estimate:
        try:
            return self.quantities[name]
        except KeyError:
            known = ", ".join(self.quantities)
            raise HyliosError(f"no quantity {name!r} in this fit; there are: {known}") from None

    @property
    def residual(self) -> np.ndarray:
        """(B,) measured - fitted, NaN where missing."""
        return self.measured - self.fitted

    @property
    def correlation(self) -> np.ndarray:
        """(P, P) correlation of `value`."""
        sd = np.sqrt(np.diag(self.covariance))
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.covariance / np.outer(sd, sd)

    @property
    def informed_by_data(self) -> tuple[str, ...]:
        """Names of the quantities that the data tell."""
        return tuple(name for name, estimate in self.quantities.items() if estimate.informed)

    def __repr__(self) -> str:
        parts = [f"Fit({self.spectrum!r}: {self.outcome.code}"]
        parts += [
            f"{name} {self.quantities[name].value:.3g} +- {self.quantities[name].sd:.2g}"
            for name in QUANTITIES
            if name in self.quantities
        ]
        return ", ".join(parts) + f", residual {self.residual_rms:.3g})"


@dataclass(frozen=True, eq=False)
class Posterior:
    """Draws from the posterior of one spectrum, with their diagnostics.

    `data` is an `arviz.InferenceData`: its `posterior` group holds every free parameter and every
    quantity with dimensions (chain, draw). A chain is one independent ensemble of walkers, its
    draws thinned to about one for each autocorrelation time of each walker. Walkers of one
    ensemble are not taken for chains: they move by each other's positions, so that their
    agreement says nothing about convergence; that of separate ensembles does.
    """

    spectrum: str
    data: Any
    converged: bool
    verdict: str
    """In words: converged or not, and why."""
    rhat: Mapping[str, float]
    """Rank-normalised split R-hat (Vehtari 2021) among the ensembles."""
    ess: Mapping[str, float]
    """Effective sample size: all draws after burn-in over the autocorrelation time."""
    autocorrelation_time: float
    """Steps, the longest among the free parameters."""
    steps: int
    """Steps of each ensemble after burn-in."""
    burn_in: int
    acceptance: float
    """Mean share of accepted moves."""
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("rhat", "ess", "settings"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))

    @property
    def names(self) -> tuple[str, ...]:
        """Variables of the posterior: quantities first, then free parameters."""
        return tuple(str(name) for name in self.data.posterior.data_vars)

    def draws(self, name: str) -> np.ndarray:
        """(chain * draw,) draws of one quantity. Raises `HyliosError` for an unknown name."""
        if name not in self.names:
            raise HyliosError(f"no quantity {name!r} in this posterior; there are: {self.names}")
        return np.asarray(self.data.posterior[name].values).ravel()

    def __getitem__(self, name: str) -> Estimate:
        """Median and 68 % interval; `informed` as in `Estimate`, against draws of the prior."""
        low, value, high = np.quantile(self.draws(name), [0.15865, 0.5, 0.84135])
        informed = bool(self.data.posterior[name].attrs.get("informed", 0))
        return Estimate(float(value), float(high - low) / 2, float(low), float(high), informed)

    def to_netcdf(self, path: str | os.PathLike[str]) -> Path:
        """Write `posterior.nc` (NetCDF 4), whole or not at all."""
        return write_posteriors([self], path)

    def __repr__(self) -> str:
        return f"Posterior({self.spectrum!r}: {self.verdict})"


#: What a posterior carries beside its draws, kept as JSON in the file.
_RECORD = (
    "spectrum", "converged", "verdict", "rhat", "ess", "autocorrelation_time", "steps",
    "burn_in", "acceptance", "settings",
)  # fmt: skip


def write_posteriors(posteriors: Sequence[Posterior], path: str | os.PathLike[str]) -> Path:
    """Write the posteriors of several spectra into one NetCDF 4 file, whole or not at all.

    `arviz.from_netcdf` opens it: group `posterior`, dimensions (spectrum, chain, draw); the
    verdicts and diagnostics are JSON in the group's attribute `hylios_fit`. All need the same
    chains, draws and free parameters, as those of one run have.

    Raises `HyliosError` where they have not, where there is none, or where the folder is missing.
    """
    import xarray

    path = Path(path)
    if not posteriors:
        raise HyliosError("no posterior to write: expected at least one")
    if not path.parent.is_dir():
        raise HyliosError(f"cannot write {path}: there is no folder {path.parent}")
    first = posteriors[0].data.posterior
    for other in posteriors[1:]:
        group = other.data.posterior
        if dict(group.sizes) != dict(first.sizes) or set(group.data_vars) != set(first.data_vars):
            raise HyliosError(
                f"posteriors of {posteriors[0].spectrum!r} and {other.spectrum!r} differ in their"
                " draws or free parameters: write them to separate files"
            )
    names = [posterior.spectrum for posterior in posteriors]
    joined = xarray.concat(
        [posterior.data.posterior for posterior in posteriors],
        dim=xarray.Variable("spectrum", names),
        combine_attrs="drop",
    )
    for name in map(str, joined.data_vars):
        joined[name].attrs["informed"] = [
            int(posterior.data.posterior[name].attrs.get("informed", 0)) for posterior in posteriors
        ]
    records = [
        {key: _plain(getattr(posterior, key)) for key in _RECORD} for posterior in posteriors
    ]
    joined.attrs["hylios_fit"] = json.dumps(records)
    with atomic_path(path) as temporary:
        _inference_data(joined).to_netcdf(str(temporary), engine="h5netcdf")
    return path


def read_posteriors(path: str | os.PathLike[str]) -> list[Posterior]:
    """Read what `write_posteriors` wrote, in its order. Raises `HyliosError` for another file."""
    import arviz

    path = Path(path)
    try:
        group = arviz.from_netcdf(str(path), engine="h5netcdf").posterior.load()  # pyright: ignore
        records = json.loads(group.attrs["hylios_fit"])
        posteriors = []
        for index, record in enumerate(records):
            one = group.isel(spectrum=index).drop_vars("spectrum")
            one.attrs = {}
            for name in one.data_vars:
                informed = np.atleast_1d(one[name].attrs["informed"])
                one[name].attrs = {"informed": int(informed[index])}
            posteriors.append(Posterior(data=_inference_data(one), **record))
    except (OSError, KeyError, IndexError, AttributeError, TypeError, ValueError) as error:
        raise HyliosError(f"{path} is not a posterior.nc that can be read: {error}") from error
    return posteriors


def _inference_data(posterior: Any) -> Any:
    import arviz

    return arviz.InferenceData(posterior=posterior)


def _plain(value: Any) -> Any:
    """The value as JSON can hold it."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    return value
