"""Spectra to fits: the maximum a posteriori state and its covariance, by optimistix.

The residual is that of Rodgers (2000, Eq. 2.30 and chapter 5) in whitened form,

    [ W (F(z) - y) ; z ],    W.T W = S_eps^-1,    S_eps = noise + surrogate error,

with the whitened state of `statevector`, so that half its square is the negative log posterior.
Levenberg-Marquardt minimises it from several starts, for each form of the melanosomes.
S_hat = (K.T K + 1)^-1 with K the Jacobian of the upper part (Laplace). The form of the higher
evidence is kept; the intervals allow for the other one by its probability.

Where the residual is significantly above the noise (chi-square, 0.1 %), the fit is repeated. The
model is taken to miss by a share of the reflectance that changes smoothly with wavelength (Kennedy
and O'Hagan 2001, doi 10.1111/1467-9868.00294), as large as makes chi-square what it should be. Or,
if the noise was stated and that is more probable, the noise is taken to be understated, by
sqrt(reduced chi-square); the default, which is that of repeats on skin, is not doubted. Intervals
of what the data tell widen by it, those of what only the prior tells stay the prior's.

Everything runs in float64, whatever JAX's configuration, which is left as it is: LM's stopping
rule and K.T K lose too much in float32.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from hylios_fit import instrument, statevector
from hylios_fit.errors import HyliosError
from hylios_fit.precision import in_full
from hylios_fit.results import MISSING, QUANTITIES, Estimate, Fit, Outcome
from hylios_fit.spectra import Spectra, as_spectra
from hylios_fit.threads import one_blas_thread

if TYPE_CHECKING:
    from hylios_fit.planning import Plan

MAX_STEPS = 100
MORE = 3  # times as many, where the best of the searches ran out of them
TOLERANCE = 1e-5
"""Relative and absolute, of state and objective; a state is in units of the prior's sd."""
CONVERGED_WITHIN = 0.1
"""Distance to the minimum, in posterior standard deviations, that is called converged."""
SCAN = 512
"""Prior states among which the starts are chosen."""
INFORMED_BELOW = 0.7
"""Posterior over prior sd under which a quantity counts as told by the data."""
EDGE_SHARE = 0.03
EDGE_PULL = 1.5
"""A parameter is pressed to the edge within this share of its range, pulled so many prior sd."""
MISFIT_ABOVE = 2.0
"""Reduced chi-square that is called a misfit."""
SIGNIFICANCE = 1e-3
NOISE_WITHIN = 1.5
"""Factor that a stated noise is right to (68 %)."""
MODEL_LENGTH = 0.05
"""Correlation length of the model's own error, in the logarithm of the wavelength (Matern 3/2)."""
MODEL_BAND = 0.01
"""Share of its variance that each band has on its own."""
MODEL_FLOOR = 0.02
"""Reflectance below which it gets no smaller."""
MODEL_STEPS = 8
MODEL_WITHIN = 0.1
"""Fits to find its size, and the distance of the reduced chi-square from 1 that ends them."""
OUTSIDE_RMS = 0.1
OUTSIDE_SHARE = 0.25
"""Residual RMS, or share of bands beyond all spectra of the prior, that no specimen explains."""
FORM_CERTAIN = 0.95
"""Probability of the kept form below which the others are mentioned."""
#: Quantities that are one parameter times a factor.
_IN_ONE = {
    "oxygen_saturation": ("oxygen_saturation", 1.0),
    "water_percent": ("water", statevector.DERMIS_WATER_PERCENT),
}


def fit(
    spectrum: Any,
    surrogate: Any = None,
    *,
    noise: Any = None,
    free: Iterable[str] | None = None,
    fix: Mapping[str, Any] | None = None,
    specular: str = "included",
    wavelength_range: tuple[float, float] | None = None,
    starts: int = 4,
    key: Array | None = None,
    plan: Plan | None = None,
) -> Fit:
    """Fit one spectrum: melanin, blood and water with their uncertainty.

    Args:
        spectrum: what `as_spectra` takes, such as `(wavelength_nm, reflectance)`, holding one.
        surrogate: the large embedded one, if None. One that is on an instrument's wide bands
            (`Surrogate.on`) fits spectra of those bands, called by its wavelengths.
        noise: standard deviation of the reflectance: a number, one for each band (B,), or its
            covariance (B, B), of the bands that are used, in the order of the spectrum. None: what
            came with the spectra, else the instrument's model.
        free: names of the parameters that vary, and `usual` for pigments, blood, water and lipids
            (the default); see `statevector.state_vector` for where the others stay.
        fix: values of parameters that are known; `melanosome_form` may be one of them.
        specular: whether the surface's reflection is in the measurement ("included") or not.
        wavelength_range: shortest and longest wavelength to use, nm.
        starts: local searches for each form of the melanosomes.
        key: moves the states among which the starts are chosen; without one they are the same
            in every call.
        plan: of a scene whose bands the spectrum has, called by `plan.scene.centre_nm`. Takes its
            surrogate, frees what matters of what varies there, within the scene's ranges, and holds
            the rest (`surrogate`, `free` and `fix` are not given); what that leaves out is added to
            the noise.

    A spectrum that cannot be fitted comes back with the outcome `unusable` and the reason.

    Raises:
        HyliosError: options that do not fit the surrogate, or several spectra.
    """
    spectra = as_spectra(spectrum)
    if len(spectra) != 1:
        raise HyliosError(f"expected one spectrum, got {len(spectra)}: use fit_many")
    return fit_many(
        spectra, surrogate, noise=noise, free=free, fix=fix, specular=specular,
        wavelength_range=wavelength_range, starts=starts, key=key, plan=plan, progress=False,
    )[0]  # fmt: skip


def fit_many(
    spectra: Any,
    surrogate: Any = None,
    *,
    noise: Any = None,
    free: Iterable[str] | None = None,
    fix: Mapping[str, Any] | None = None,
    specular: str = "included",
    wavelength_range: tuple[float, float] | None = None,
    starts: int = 4,
    key: Array | None = None,
    plan: Plan | None = None,
    progress: bool = True,
) -> list[Fit]:
    """Fit each of `spectra` by itself; one `Fit` for each, in their order.

    Arguments and errors as for `fit`. `progress`: show a bar when it takes more than 2 s.
    """
    spectra = as_spectra(spectra, wavelength_range=wavelength_range)
    if plan is not None:
        if not (surrogate is None and free is None and fix is None):
            raise HyliosError("a plan says what surrogate, free and fix are: give it or them")
        surrogate, free, fix = plan.surrogate, tuple(plan.ranges), plan.fixed
        if not free:
            raise HyliosError(
                f"nothing that varies in the scene matters to within {plan.tolerance:g}: "
                "plan for a smaller tolerance"
            )
    if surrogate is None:
        from hylios_fit.surrogate import load_surrogate

        surrogate = load_surrogate()
    with jax.enable_x64(True), one_blas_thread():
        job = _job(spectra, surrogate, noise, free, fix, plan, specular, starts, key)
        order = range(len(spectra))
        if progress:
            from tqdm import tqdm

            order = tqdm(order, desc="fit", unit="spectrum", delay=2.0, leave=False)
        return [_fit_one(job, spectra, i) for i in order]


class Reported(eqx.Module):
    """A surrogate's member as the instrument reports it: (P,) parameters -> (B,) reflectance."""

    member: Any
    specular: str = eqx.field(static=True)

    def __call__(self, parameters: Float[Array, " P"]) -> Float[Array, " B"]:
        surface = self.member.surface_at(parameters)
        return self.member(parameters) + instrument.specular_offset(surface, self.specular)


@dataclass(frozen=True)
class Model:
    """One form of the melanosomes on the instrument's bands, with its scan of the prior."""

    form: str
    member: Reported
    unseen: Any
    """What the surface reflects, (B,) or 0, where the measurement excludes it."""
    scan: np.ndarray
    """(SCAN, B) spectra of the scan's states."""


@dataclass(frozen=True)
class _Job:
    """What all spectra of one call share."""

    models: tuple[Model, ...]
    vector: statevector.StateVector
    usable: np.ndarray  # (B,) bands that the surrogate has
    states: np.ndarray  # (SCAN, N)
    noise: Any  # reflectance (B,) -> covariance (B, B)
    noise_follows_reflectance: bool
    surrogate_error: Mapping[str, Callable[[np.ndarray], np.ndarray]]
    starts: int
    settings: Mapping[str, Any]


def _job(
    spectra: Spectra,
    surrogate: Any,
    noise: Any,
    free: Iterable[str] | None,
    fix: Mapping[str, Any] | None,
    plan: Plan | None,
    specular: str,
    starts: int,
    key: Array | None,
) -> _Job:
    instrument.specular_offset(0.0, specular)  # refuses an unknown word before any work
    if not isinstance(starts, int) or starts < 1:
        raise HyliosError(f"starts: expected a whole number from 1, got {starts!r}")
    fix = dict(fix or {})
    forms = _forms(surrogate, fix.pop("melanosome_form", None))
    values = {name: _number(name, value) for name, value in fix.items()}
    wavelength = spectra.wavelength_nm
    first = surrogate.at(forms[0])
    ranges = {} if plan is None else plan.ranges
    vector = statevector.state_vector(first.names, first.lower, first.upper, free, values, ranges)
    known = np.asarray(first.wavelength_nm, dtype=np.float64)
    usable = (wavelength >= known.min()) & (wavelength <= known.max()) | first.projected
    states = _scan_states(len(vector.free), key)
    noise_text, noise_of, follows = _noise_model(noise, spectra)
    if plan is not None:
        noise_of = _with_dropped(noise_of, plan.dropped_sd)
    models, error = [], {}
    for form in forms if usable.any() else ():
        projected = surrogate.at(form).on(wavelength[usable])
        member = Reported(as_float64(projected), specular)
        held = projected.surface_at(vector.held)
        unseen = -np.asarray(instrument.specular_offset(held, specular), float)
        scan = np.asarray(_spectra(member, vector, jnp.asarray(states)))
        models.append(Model(form, member, unseen, scan))
        error[form] = projected.error_covariance
    settings = {
        "noise": noise_text,
        "free": list(vector.free),
        "fix": {**values, **({"melanosome_form": forms[0]} if len(forms) == 1 else {})},
        "specular": specular,
        "wavelength_nm": [float(wavelength[0]), float(wavelength[-1])],
        "starts": starts,
        "key": None if key is None else np.asarray(key_data(key)).tolist(),
        "versions": versions(),
        "surrogate": str(getattr(surrogate, "about", {}).get("sha256", "")),
        **({"on_bands": True} if first.projected else {}),
        **({"ranges": {name: [*edges] for name, edges in ranges.items()}} if ranges else {}),
        "source": spectra.source,
        "notes": list(spectra.notes),
    }
    return _Job(tuple(models), vector, usable, states, noise_of, follows, error, starts, settings)


def _with_dropped(covariance: Any, sd: float) -> Any:
    """Noise, and what a plan holds though it varies, on each band by itself."""
    return lambda reflectance: covariance(reflectance) + sd**2 * np.eye(len(reflectance))


def _forms(surrogate: Any, wanted: Any) -> tuple[str, ...]:
    forms = tuple(surrogate.forms)
    if wanted is None:
        return forms
    if wanted not in forms:
        raise HyliosError(f"melanosome_form: expected one of {', '.join(forms)}, got {wanted!r}")
    return (wanted,)


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise HyliosError(f"{name}: expected a number, got {value!r}") from None


def key_data(key: Array) -> Array:
    """The words of a JAX key, new style or old."""
    return jax.random.key_data(key) if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else key


@functools.cache
def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    from importlib.metadata import version

    from hylios_fit import __version__

    packages = ("jax", "optimistix", "numpy")
    return {"hylios_fit": __version__, **{name: version(name) for name in packages}}


def as_float64(tree: Any) -> Any:
    """A pytree with its floating arrays in float64; call it where JAX's x64 is enabled."""

    def cast(leaf: Any) -> Any:
        if eqx.is_array_like(leaf) and np.issubdtype(np.asarray(leaf).dtype, np.floating):
            return jnp.asarray(leaf, dtype=jnp.float64)
        return leaf

    return jax.tree.map(cast, tree)


def _scan_states(size: int, key: Array | None) -> np.ndarray:
    """(SCAN, N) normal states, evenly spread by Roberts' additive recurrence; the first is 0.

    `key` shifts the sequence (Cranley and Patterson 1976).
    """
    from scipy.special import ndtri

    # The generalised golden ratio: the root of x^(N+1) = x + 1.
    ratio = 2.0
    for _ in range(60):
        ratio = (1.0 + ratio) ** (1.0 / (size + 1))
    steps = ratio ** -np.arange(1.0, size + 1)
    shift = 0.5 if key is None else np.asarray(jax.random.uniform(key, (size,)), dtype=np.float64)
    points = (shift + np.outer(np.arange(1, SCAN), steps)) % 1.0
    states = ndtri(np.clip(points, 1e-6, 1.0 - 1e-6))
    return np.concatenate([np.zeros((1, size)), states])


def _noise_model(noise: Any, spectra: Spectra) -> tuple[Any, Any, bool]:
    """What is recorded of the noise, the function from (B,) reflectance to its covariance, and
    whether that depends on the reflectance."""
    wavelength = spectra.wavelength_nm
    came = wavelength if spectra.came_nm is None else spectra.came_nm
    rising = np.argsort(came)
    text: Any = "given for each band"
    follows = False
    if noise is None and spectra.noise is not None:
        noise, text = spectra.noise, "given with the spectra"
    elif noise is None:
        text, follows = "repeatability of measured skin (NIST)", True
    elif np.ndim(noise) == 0:
        text = _number("noise", noise)
    elif np.ndim(noise) == 2:
        given = np.asarray(noise, dtype=np.float64)
        if given.shape != (wavelength.size,) * 2:
            raise HyliosError(
                f"noise: expected shape ({wavelength.size}, {wavelength.size}), got {given.shape}"
            )
        given = given[np.ix_(rising, rising)]
        if not np.all(np.isfinite(given)) or not np.allclose(given, given.T):
            raise HyliosError("noise: expected a symmetric covariance of finite numbers")
        if np.any(np.diag(given) <= 0) or np.linalg.eigvalsh(given)[0] < -1e-9 * given.max():
            raise HyliosError("noise: expected a covariance, got one with variances not above 0")
        return "given as a covariance", lambda reflectance: given, False
    instrument.noise_sd(wavelength, np.zeros(wavelength.size), noise)  # refuses what is no noise
    if noise is not None and noise is not spectra.noise and np.ndim(noise):  # that is sorted
        noise = np.asarray(noise, dtype=np.float64)[rising]

    def covariance(reflectance: np.ndarray) -> np.ndarray:
        return instrument.noise_covariance(wavelength, reflectance, noise)

    return text, covariance, follows


@eqx.filter_jit
def _spectra(
    member: Any, vector: statevector.StateVector, states: Float[Array, "S N"]
) -> Float[Array, "S B"]:
    return jax.vmap(lambda z: member(vector.parameters(z)))(states)


@eqx.filter_jit
@in_full
def _solve(
    member: Any,
    vector: statevector.StateVector,
    whitener: Float[Array, "B B"],
    target: Float[Array, " B"],
    start: Float[Array, " N"],
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """One local search: state, objective, K, spectrum, gradient of the objective, steps."""

    def residual(z: Array, args: None) -> Array:
        return jnp.concatenate([whitener @ (member(vector.parameters(z)) - target), z])

    solver = optx.LevenbergMarquardt(rtol=TOLERANCE, atol=TOLERANCE)
    found = optx.least_squares(residual, solver, start, max_steps=MAX_STEPS, throw=False)
    z = found.value
    objective = 0.5 * jnp.sum(residual(z, None) ** 2)
    jacobian = jax.jacfwd(lambda z: residual(z, None))(z)
    spectrum = member(vector.parameters(z))
    gradient = jacobian.T @ residual(z, None)
    k = jacobian[: target.shape[0]]
    return z, objective, k, spectrum, gradient, found.stats["num_steps"]


@eqx.filter_jit
def _linearised(
    vector: statevector.StateVector, z: Float[Array, " N"]
) -> tuple[Array, Array, dict[str, Array], dict[str, Array]]:
    """Free parameters and derived quantities at `z`, each with its gradient."""

    def free(z: Array) -> Array:
        return vector.from_u(vector.u(z))

    def quantities(z: Array) -> dict[str, Array]:
        return statevector.derived(vector.names, vector.parameters(z))

    return free(z), jax.jacfwd(free)(z), quantities(z), jax.jacfwd(quantities)(z)


def _fit_one(job: _Job, spectra: Spectra, i: int) -> Fit:
    name = spectra.names[i]
    problem = spectra.problems[i]
    measured = spectra.reflectance[i]
    if problem is None and not job.usable.any():
        problem = "no band lies within the surrogate's wavelengths"
    if problem is None and not np.isfinite(measured[job.usable]).any():
        problem = "no band has a value"
    if problem is not None:
        return unusable(name, problem, spectra.wavelength_nm, measured, job.vector, job.settings)
    try:
        return _inverted(job, spectra.wavelength_nm, measured, name)
    except (ArithmeticError, np.linalg.LinAlgError, RuntimeError, HyliosError) as error:
        # One bad spectrum must not lose the others.
        problem = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return unusable(name, problem, spectra.wavelength_nm, measured, job.vector, job.settings)


def unusable(
    name: str,
    why: str,
    wavelength_nm: np.ndarray,
    measured: np.ndarray,
    vector: statevector.StateVector,
    settings: Mapping[str, Any],
) -> Fit:
    """The `Fit` of a spectrum that could not be fitted."""
    free, nothing = len(vector.free), np.full(np.shape(measured), np.nan)
    return Fit(
        spectrum=name, outcome=Outcome.unusable, messages=(why,), wavelength_nm=wavelength_nm,
        measured=measured, fitted=nothing, sd=nothing, residual_rms=np.nan, reduced_chi2=np.nan,
        inflation=1.0, model_error=0.0, iterations=0, form="", form_probability={},
        names=vector.free, value=np.full(free, np.nan),
        covariance=np.full((free, free), np.nan), z=np.full(free, np.nan),
        z_covariance=np.full((free, free), np.nan),
        quantities=dict.fromkeys((*QUANTITIES, *vector.free), MISSING),
        fixed=_fixed(vector), settings=settings,
    )  # fmt: skip


def _fixed(vector: statevector.StateVector) -> dict[str, float]:
    return {
        name: float(value)
        for name, value in zip(vector.names, vector.held, strict=True)
        if name not in vector.free
    }


def whitener(covariance: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, float]:
    """(B, B) matrix W with W.T W = covariance^-1 over the `used` bands, zero in the others.

    Also half the log determinant of that part of the covariance. Raises `HyliosError` where it
    has no inverse.
    """
    from scipy.linalg import solve_triangular

    at = np.ix_(used, used)
    try:
        lower = np.linalg.cholesky(covariance[at])
    except np.linalg.LinAlgError:
        raise HyliosError("the covariance of noise and surrogate error has no inverse") from None
    whole = np.zeros_like(covariance)
    whole[at] = solve_triangular(lower, np.eye(len(lower)), lower=True)
    return whole, float(np.log(np.diag(lower)).sum())


@dataclass(frozen=True)
class _Solution:
    model: Model
    z: np.ndarray
    objective: float
    jacobian: np.ndarray  # K, whitened
    spectrum: np.ndarray
    converged: bool
    steps: int
    covariance: np.ndarray  # S_eps
    whitener: np.ndarray
    log_determinant: float  # half of log det S_eps


def _search(
    job: _Job,
    model: Model,
    covariance: np.ndarray,
    target: np.ndarray,
    start: np.ndarray | None = None,
) -> _Solution:
    """The best of several local searches with one form, or the one from `start`.

    A search is a call of its own: under `vmap` each would run to the end of the slowest.
    """
    used = np.isfinite(target)
    filled = np.where(used, target, 0.0)
    weights, log_determinant = whitener(covariance, used)
    if start is None:
        misses = (model.scan - filled) @ weights.T
        score = np.sum(misses**2, axis=1) + np.sum(job.states**2, axis=1)
        starts = job.states[np.argsort(score, kind="stable")[: job.starts]]
    else:
        starts = start[None]
    filled, weights_on = jnp.asarray(filled), jnp.asarray(weights)
    total = 0

    def better(best: _Solution | None, start: np.ndarray) -> _Solution | None:
        nonlocal total
        found = _solve(model.member, job.vector, weights_on, filled, jnp.asarray(start))
        z, objective, jacobian, spectrum, gradient, steps = jax.device_get(found)
        total += int(steps)
        if not np.isfinite(objective) or (best is not None and objective >= best.objective):
            return best
        # Distance to the minimum in posterior standard deviations, whatever stopped the search.
        distance = np.sqrt(max(gradient @ _s_hat(jacobian) @ gradient, 0.0))
        return _Solution(
            model, z, float(objective), jacobian, spectrum,
            bool(distance < CONVERGED_WITHIN), 0, covariance, weights, log_determinant,
        )  # fmt: skip

    best = None
    for one in starts:
        best = better(best, one)
    if best is None:
        raise HyliosError("the surrogate gives no finite spectrum from any start")
    for _ in range(MORE):  # the best goes on where its steps did not suffice
        further = best if best.converged else better(best, best.z)
        if further is None or further is best:
            break
        best = further
    return replace(best, steps=total)


def _inverted(job: _Job, wavelength_nm: np.ndarray, measured: np.ndarray, name: str) -> Fit:
    target = measured[job.usable]
    # Where a band is missing the noise model gets a stand-in; its row is not used.
    level = np.where(np.isfinite(measured), measured, np.nanmedian(measured))
    noise = job.noise(level)[np.ix_(job.usable, job.usable)]
    stated = _stated(job, noise, level)
    found = [_search(job, model, stated[model.form], target) for model in job.models]
    steps = sum(s.steps for s in found)

    def again(covariances: Mapping[str, np.ndarray]) -> list[_Solution]:
        nonlocal steps
        warm = [_search(job, s.model, covariances[s.model.form], target, s.z) for s in found]
        steps += sum(s.steps for s in warm)
        return warm

    # An error that scales with the measured value weighs low readings more, and so pulls the fit
    # down (Peelle's puzzle): take it at the fitted value.
    level[job.usable] = _best(found).spectrum
    if job.noise_follows_reflectance:
        noise = job.noise(level)[np.ix_(job.usable, job.usable)]
    stated = _stated(job, noise, level)
    found = again(stated)
    reduced, significant = _reduced_chi2(_best(found), target)
    inflation, model_error = 1.0, 0.0
    if significant:
        shape = _model_error(wavelength_nm[job.usable], level[job.usable])
        found, model_error = _with_model_error(again, stated, shape, found, target)
        if not job.noise_follows_reflectance:  # somebody stated it
            noisier = again({form: covariance * reduced for form, covariance in stated.items()})
            unlikely = 0.5 * (0.5 * np.log(reduced) / np.log(NOISE_WITHIN)) ** 2
            if _evidence(noisier).max() - unlikely > _evidence(found).max():
                found, model_error, inflation = noisier, 0.0, float(np.sqrt(reduced))
    evidence = _evidence(found)
    weights = np.exp(evidence - evidence.max())
    return _fit_from(
        job, found, weights / weights.sum(), wavelength_nm, measured, name,
        stated, reduced, inflation, model_error, steps,
    )  # fmt: skip


def _model_error(wavelength_nm: np.ndarray, level: np.ndarray) -> np.ndarray:
    """(B, B) covariance of what the model misses, as a share of the reflectance, where that is 1.

    Length and share of each band are from fits of measured skin (`python -m experiments
    model_error`). A smaller share has still higher evidence where bands are dense, but then the
    size that chi-square asks for is far above the residual, and the fit stays away from the data.
    """
    level = np.maximum(level, MODEL_FLOOR)
    correlation = (1.0 - MODEL_BAND) * instrument.smooth(wavelength_nm, MODEL_LENGTH)
    return np.outer(level, level) * (correlation + MODEL_BAND * np.eye(level.size))


def _with_model_error(
    again: Callable[[Mapping[str, np.ndarray]], list[_Solution]],
    stated: Mapping[str, np.ndarray],
    shape: np.ndarray,
    found: list[_Solution],
    target: np.ndarray,
) -> tuple[list[_Solution], float]:
    """The fits that allow for an error of the model, and its share of the reflectance: that which
    makes the reduced chi-square 1."""
    best = _best(found)
    share, reduced = np.sqrt(np.nanmean((best.spectrum - target) ** 2 / np.diag(shape))), 1.0
    for _ in range(MODEL_STEPS):
        share *= np.sqrt(reduced)
        found = again({form: part + share**2 * shape for form, part in stated.items()})
        reduced, _ = _reduced_chi2(_best(found), target)
        if abs(reduced - 1.0) < MODEL_WITHIN:
            break
    return found, float(share)


def _stated(job: _Job, noise: np.ndarray, level: np.ndarray) -> dict[str, np.ndarray]:
    """S_eps by form: the noise and the surrogate's own error at a reflectance."""
    return {
        model.form: noise + job.surrogate_error[model.form](level[job.usable] + model.unseen)
        for model in job.models
    }


def _evidence(found: list[_Solution]) -> np.ndarray:
    """Log of the probability of the data under each form, by Laplace's approximation.

    The forms differ in their surrogate error, hence the determinant of S_eps.
    """
    return np.array(
        [
            0.5 * np.linalg.slogdet(_s_hat(s.jacobian))[1] - s.objective - s.log_determinant
            for s in found
        ]
    )


def _best(found: list[_Solution]) -> _Solution:
    return found[np.argmax(_evidence(found))]


def _s_hat(k: np.ndarray) -> np.ndarray:
    """(N, N) covariance of the whitened state, from the whitened Jacobian."""
    covariance = np.linalg.inv(k.T @ k + np.eye(k.shape[1]))
    return 0.5 * (covariance + covariance.T)


def _reduced_chi2(solution: _Solution, target: np.ndarray) -> tuple[float, bool]:
    """Chi-square for each degree of freedom, and whether it is significantly above 1."""
    from scipy.special import chdtrc  # scipy.stats takes half a second to import

    used = np.isfinite(target)
    residual = solution.whitener @ np.where(used, solution.spectrum - target, 0.0)
    k = solution.jacobian
    gained = np.trace(np.linalg.solve(k.T @ k + np.eye(k.shape[1]), k.T @ k))
    # What the data give to the state is lost to the residual (Rodgers 2000, section 2.4).
    freedom = max(float(used.sum() - gained), 1.0)
    total = float(np.sum(residual**2))
    return total / freedom, bool(chdtrc(freedom, total) < SIGNIFICANCE)


def _fit_from(
    job: _Job,
    found: list[_Solution],
    weights: np.ndarray,
    wavelength_nm: np.ndarray,
    measured: np.ndarray,
    name: str,
    stated_by_form: Mapping[str, np.ndarray],
    reduced: float,
    inflation: float,
    model_error: float,
    steps: int,
) -> Fit:
    vector = job.vector
    kept = int(np.argmax(weights))
    best = found[kept]
    stated = stated_by_form[best.model.form]
    z_covariance = _s_hat(best.jacobian)
    value, slope, _, _ = jax.device_get(_linearised(vector, jnp.asarray(best.z)))
    covariance = slope @ z_covariance @ slope.T
    quantities = _estimates(vector, found, weights, kept)

    def on_all_bands(values: np.ndarray) -> np.ndarray:
        whole = np.full(wavelength_nm.shape, np.nan)
        whole[job.usable] = values
        return whole

    fitted = on_all_bands(best.spectrum)
    error = np.full((wavelength_nm.size,) * 2, np.nan)
    at = np.flatnonzero(job.usable)[np.isfinite(measured[job.usable])]
    error[np.ix_(at, at)] = best.covariance[np.ix_(*(np.isfinite(measured[job.usable]),) * 2)]
    residual = (measured - fitted)[at]
    rms = float(np.sqrt(np.mean(residual**2)))
    beyond = _beyond(job, best, measured[job.usable], stated)
    pressed = _pressed(vector, best.z)
    outcome, messages = _outcome(
        best.converged, quantities, reduced, inflation, model_error, rms, beyond, pressed
    )
    probability = {s.model.form: float(w) for s, w in zip(found, weights, strict=True)}
    if weights[kept] < FORM_CERTAIN:
        shares = ", ".join(f"{form} {share:.2f}" for form, share in probability.items())
        messages += (f"The form of the melanosomes is not certain ({shares}).",)
    if not job.usable.all():
        messages += (f"{(~job.usable).sum()} bands lie outside the surrogate's range.",)
    return Fit(
        spectrum=name, outcome=outcome, messages=messages, wavelength_nm=wavelength_nm,
        measured=measured, fitted=fitted, sd=on_all_bands(np.sqrt(np.diag(stated))),
        residual_rms=rms, reduced_chi2=reduced,
        inflation=inflation, model_error=model_error, iterations=steps,
        form=best.model.form, form_probability=probability, names=vector.free,
        value=value, covariance=covariance,
        z=best.z, z_covariance=z_covariance, quantities=quantities, fixed=_fixed(vector),
        error_covariance=error, settings=job.settings,
    )  # fmt: skip


def _estimates(
    vector: statevector.StateVector, found: list[_Solution], weights: np.ndarray, kept: int
) -> dict[str, Estimate]:
    """Value and 68 % interval of each quantity and free parameter.

    A parameter's interval is that of its unbounded variable, put through its transform. Melanin
    and blood are linearised in their logarithm: draws of the normal approximation would leave
    the curved valley along which the data hold the product, and widen what the data tell.

    The values are those of the form that is kept; the variance about them is that of the mixture
    of all forms, each weighted by its probability.
    """
    prior_u = np.sqrt(np.diag(vector.factor @ vector.factor.T))
    at = [jax.device_get(_linearised(vector, jnp.asarray(s.z)))[2:] for s in found]
    us = [vector.mean + vector.factor @ s.z for s in found]
    quantity, gradient = at[kept]
    u = us[kept]
    variance_u = np.zeros(len(vector.free))
    variance_log = dict.fromkeys(quantity, 0.0)
    for s, weight, u_here, (value, slope) in zip(found, weights, us, at, strict=True):
        s_hat = _s_hat(s.jacobian)
        own_u = np.diag(vector.factor @ s_hat @ vector.factor.T)
        variance_u += weight * (own_u + (u_here - u) ** 2)
        for name in quantity:
            k_log = slope[name] / value[name]
            shift = np.log(value[name] / quantity[name])
            variance_log[name] += float(weight * (k_log @ s_hat @ k_log + shift**2))

    sd_u = np.sqrt(variance_u)
    low, middle, high = (
        np.asarray(vector.from_u(jnp.asarray(u + side * sd_u))) for side in (-1.0, 0.0, 1.0)
    )
    own = {
        name: _estimate(low[j], middle[j], high[j], sd_u[j] < INFORMED_BELOW * prior_u[j])
        for j, name in enumerate(vector.free)
    }
    estimates: dict[str, Estimate] = {}
    for name, centre in quantity.items():
        parameter, factor = _IN_ONE.get(name, ("", 1.0))
        if parameter in own:
            e = own[parameter]
            estimates[name] = _estimate(
                factor * e.low, factor * e.value, factor * e.high, e.informed
            )
            continue
        sd = np.sqrt(variance_log[name])
        prior = np.linalg.norm(gradient[name] / centre)
        estimates[name] = _estimate(
            centre * np.exp(-sd), centre, centre * np.exp(sd), sd < INFORMED_BELOW * prior
        )
    ordered = {name: estimates.get(name, MISSING) for name in QUANTITIES}
    return ordered | {name: e for name, e in own.items() if name not in ordered}


def _estimate(low: Any, value: Any, high: Any, informed: Any) -> Estimate:
    low, value, high = float(low), float(value), float(high)
    # Rounding at the very edge of the box must not part the value from its interval.
    low, high = min(low, value), max(high, value)
    return Estimate(value, (high - low) / 2, low, high, bool(informed))


def _pressed(vector: statevector.StateVector, z: np.ndarray) -> list[str]:
    """Parameters that the data press to the edge of the box, in words."""
    share = vector.edge_share(z)
    sd = np.sqrt(np.diag(vector.factor @ vector.factor.T))
    pull = (vector.factor @ z) / sd
    words = []
    for j, name in enumerate(vector.free):
        if share[j] < EDGE_SHARE and pull[j] < -EDGE_PULL:
            words.append(f"{name} is at its lower edge")
        if share[j] > 1.0 - EDGE_SHARE and pull[j] > EDGE_PULL:
            words.append(f"{name} is at its upper edge")
    return words


def _beyond(job: _Job, best: _Solution, measured: np.ndarray, stated: np.ndarray) -> float:
    """Share of bands beyond every spectrum of the prior, and missed by the fit by over 3 sd."""
    used = np.isfinite(measured)
    sd = np.sqrt(np.diag(stated))
    low = np.min([model.scan.min(axis=0) for model in job.models], axis=0)
    high = np.max([model.scan.max(axis=0) for model in job.models], axis=0)
    with np.errstate(invalid="ignore"):
        out = (measured < low - 3 * sd) | (measured > high + 3 * sd)
        out &= np.abs(measured - best.spectrum) > 3 * sd
    return float(out[used].mean())


def _outcome(
    converged: bool,
    quantities: Mapping[str, Estimate],
    reduced: float,
    inflation: float,
    model_error: float,
    rms: float,
    beyond: float,
    pressed: list[str],
) -> tuple[Outcome, tuple[str, ...]]:
    """The outcome and its messages; the gravest comes first."""
    messages = []
    told = [name for name in QUANTITIES if quantities[name].informed]
    asked = [name for name in QUANTITIES if quantities[name].sd > 0.0]
    significant = inflation > 1.0 or model_error > 0.0
    misfit = significant and reduced > MISFIT_ABOVE
    if not converged:
        messages.append(f"The solver found no minimum within {(1 + MORE) * MAX_STEPS} steps.")
    if significant:
        taken = (
            f"the model to miss by {100 * model_error:.2g} % of the reflectance"
            if model_error
            else f"the noise to be {inflation:.3g} times what was stated"
        )
        messages.append(f"Reduced chi-square is {reduced:.3g}: the intervals take {taken}.")
    if pressed:
        messages.append(f"{'; '.join(pressed).capitalize()}.")
    if len(told) < len(asked):
        rest = ", ".join(name for name in asked if name not in told)
        messages.append(f"Not told by the data, mostly prior: {rest}.")
    if misfit and (rms > OUTSIDE_RMS or beyond > OUTSIDE_SHARE):
        return Outcome.outside_range, tuple(messages)
    if not converged:
        return Outcome.not_converged, tuple(messages)
    if misfit:
        return Outcome.misfit, tuple(messages)
    if pressed:
        return Outcome.at_bound, tuple(messages)
    if len(told) < min(2, len(asked)):
        return Outcome.prior_dominated, tuple(messages)
    return Outcome.fitted, tuple(messages)
