"""Fit to posterior, by emcee: independent ensembles in the whitened state, and their verdict.

The density is that of `inversion`, with the form of the melanosomes that the fit kept and the
noise as the fit widened it. Moves are those of differential evolution, one in ten of them
snooker (ter Braak 2006; ter Braak and Vrugt 2008). Of emcee's moves they had the shortest
autocorrelation in time on 11 parameters: 65 to 85 steps, the stretch move 106; draws from a
Student t about the fit 140 to 170, because the data hold products of parameters in a curved valley.

A chain, for R-hat, is one ensemble: its walkers move by each other's positions, so that they agree
before they have converged. Every ensemble has its own random state, drawn from the key; NumPy's
global one is neither read for that nor moved.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hylios_fit import inversion, statevector
from hylios_fit.errors import HyliosError
from hylios_fit.precision import in_full
from hylios_fit.results import QUANTITIES, Fit, Posterior
from hylios_fit.threads import one_blas_thread

ENSEMBLES = 2
ENOUGH = 50
"""Autocorrelation times that a chain must have (emcee's rule)."""
RHAT_BELOW = 1.02
BURN_IN = 5
"""Autocorrelation times that are left out at the start; the walkers start from the fit."""
BLOCK = 250
GROWTH = 1.25
"""Steps between two updates of the bar; growth of the chain between two looks at its length."""
DRAWS = 2048
"""Draws that each chain keeps."""


def sample(
    fit: Fit,
    *,
    key: Array,
    surrogate: Any = None,
    walkers: int | None = None,
    steps: int = 12_000,
    progress: bool = True,
) -> Posterior:
    """Sample the posterior of one fit, started from it and its covariance.

    Args:
        fit: what `fit` or `fit_many` gave, with estimates.
        key: a JAX key; the same key gives the same draws.
        surrogate: the one that was fitted with, which need not be said of an embedded one.
        walkers: of each of the 2 ensembles, an even number, at least twice the free parameters;
            None: four times.
        steps: at most, of each ensemble; sampling ends early once the chains are 50
            autocorrelation times long.
        progress: show a bar when it takes more than 2 s.

    The result says in `converged` and `verdict` whether it can be used: a chain under 50
    autocorrelation times, or ensembles that disagree, are called not converged.

    Raises:
        HyliosError: a fit without estimates, too few walkers or steps, or another surrogate.
    """
    if not np.all(np.isfinite(fit.z)) or fit.error_covariance.size == 0:
        raise HyliosError(
            f"{fit.spectrum!r} has no estimates to start from (outcome {fit.outcome.code})"
        )
    free = len(fit.names)
    walkers = max(4 * free, 8) if walkers is None else walkers
    if not isinstance(walkers, int) or walkers < 2 * free or walkers < 4 or walkers % 2:
        raise HyliosError(
            f"walkers: expected an even number from {max(2 * free, 4)}, got {walkers!r}"
        )
    if not isinstance(steps, int) or steps < 10:
        raise HyliosError(f"steps: expected a whole number from 10, got {steps!r}")
    if surrogate is None:
        surrogate = _embedded(fit)
    with jax.enable_x64(True), one_blas_thread():
        vector, density = log_posterior(fit, surrogate)
        chains, acceptance = _run(fit, density, key, walkers, steps, progress)
        return _posterior(fit, vector, chains, acceptance, key)


def _embedded(fit: Fit) -> Any:
    """The embedded surrogate that was fitted with; the large one, if none of them was."""
    from hylios_fit.surrogate import EMBEDDED, load_surrogate

    for size in EMBEDDED:
        one = load_surrogate(size=size)
        if one.about["sha256"] == fit.settings.get("surrogate"):
            return one
    return load_surrogate()


def log_posterior(
    fit: Fit, surrogate: Any
) -> tuple[statevector.StateVector, Callable[[np.ndarray], np.ndarray]]:
    """The state vector of a fit, and its log posterior (S, N) -> (S,), -inf where it is NaN.

    To be called where JAX's x64 is enabled. Raises `HyliosError` for another surrogate.
    """
    mine = str(fit.settings.get("surrogate") or "")
    given = str(getattr(surrogate, "about", {}).get("sha256") or "")
    if mine and given and mine != given:
        raise HyliosError(
            f"{fit.spectrum!r} was fitted with the surrogate {mine[:8]}, got {given[:8]}: "
            "give the one that it was fitted with"
        )
    if fit.form not in surrogate.forms:
        raise HyliosError(f"the surrogate has no form {fit.form!r}: expected that of the fit")
    whole = surrogate.at(fit.form)
    if whole.projected != bool(fit.settings.get("on_bands")):
        raise HyliosError(
            f"{fit.spectrum!r} was fitted with a surrogate that is "
            f"{'' if fit.settings.get('on_bands') else 'not '}on an instrument's bands: give that "
            "one (that of a plan is `plan.surrogate`)"
        )
    fixed = {k: v for k, v in fit.settings.get("fix", {}).items() if k != "melanosome_form"}
    vector = statevector.state_vector(
        whole.names, whole.lower, whole.upper, fit.names, fixed, fit.settings.get("ranges")
    )
    used = np.isfinite(np.diag(fit.error_covariance))
    specular = fit.settings.get("specular", "included")
    projected = whole.on(fit.wavelength_nm[used])
    member = inversion.Reported(inversion.as_float64(projected), specular)
    covariance = np.asarray(fit.error_covariance)[np.ix_(used, used)]
    weights, _ = inversion.whitener(covariance, np.ones(int(used.sum()), dtype=bool))
    measured = jnp.asarray(fit.measured[used])
    arguments = jax.tree.map(_as_array, (member, vector, jnp.asarray(weights), measured))
    dynamic, static = eqx.partition(arguments, eqx.is_array)
    compiled = _log_posterior(static)

    def density(states: np.ndarray) -> np.ndarray:
        return np.asarray(compiled(dynamic, jnp.asarray(states)))

    return vector, density


def _as_array(leaf: Any) -> Any:
    return jnp.asarray(leaf) if isinstance(leaf, np.ndarray) else leaf


@functools.lru_cache(maxsize=32)
def _log_posterior(static: Any) -> Callable[[Any, Array], Array]:
    """The compiled density for all arguments alike but for their arrays.

    `eqx.filter_jit` does the same and takes 0.1 ms a call, as long as the density itself.
    """

    @jax.jit
    @in_full
    def density(dynamic: Any, states: Float[Array, "S N"]) -> Float[Array, " S"]:
        member, vector, weights, target = eqx.combine(dynamic, static)

        def one(z: Array) -> Array:
            residual = weights @ (member(vector.parameters(z)) - target)
            return -0.5 * (jnp.sum(residual**2) + jnp.sum(z**2))

        value = jax.vmap(one)(states)
        return jnp.where(jnp.isfinite(value), value, -jnp.inf)

    return density


def _run(
    fit: Fit,
    density: Callable[[np.ndarray], np.ndarray],
    key: Array,
    walkers: int,
    steps: int,
    progress: bool,
) -> tuple[np.ndarray, float]:
    """(ensemble, step, walker, N) states, and the mean acceptance."""
    import emcee
    from tqdm import tqdm

    free = len(fit.names)
    factor = np.linalg.cholesky(fit.z_covariance)
    seeds = np.asarray(jax.random.bits(key, (ENSEMBLES, 8), dtype=jnp.uint32))
    samplers, states = [], []
    for seed in seeds:
        random = np.random.RandomState(seed)
        start = fit.z + random.standard_normal((walkers, free)) @ factor.T
        sampler = emcee.EnsembleSampler(
            walkers, free, density, vectorize=True,
            moves=[
                (emcee.moves.DEMove(), 0.9),
                (emcee.moves.DESnookerMove(), 0.1),
            ],
        )  # fmt: skip
        # emcee copies NumPy's global state, so that unseeded samplers share one stream.
        sampler.random_state = random.get_state()
        samplers.append(sampler)
        states.append(emcee.State(start))
    done, look = 0, 0.0
    chains = np.empty((0,))
    with tqdm(
        total=ENSEMBLES * steps, desc=f"sample {fit.spectrum}", unit="step", delay=2.0,
        leave=False, disable=not progress,
    ) as bar:  # fmt: skip
        while done < steps:
            block = min(BLOCK, steps - done)
            for i, sampler in enumerate(samplers):
                for state in sampler.sample(
                    states[i], iterations=block, skip_initial_state_check=done > 0
                ):
                    states[i] = state
                bar.update(block)
            done += block
            if done < look and done < steps:
                continue
            look = GROWTH * done
            chains = np.stack([sampler.get_chain() for sampler in samplers])
            if done >= 1.05 * (ENOUGH + BURN_IN) * autocorrelation_times(chains).max():
                break
    return chains, float(np.mean([sampler.acceptance_fraction for sampler in samplers]))


def autocorrelation_times(chains: np.ndarray) -> np.ndarray:
    """(N,) integrated autocorrelation times in steps, of chains (ensemble, step, walker, N).

    Averaged over all walkers of all ensembles; an estimate also where the chain is too short.
    """
    steps, size = chains.shape[1], chains.shape[-1]
    window = np.arange(1, steps + 1)
    times = np.empty(size)
    # One parameter after another: the transform of all at once would take a gigabyte.
    for j in range(size):
        series = chains[..., j].transpose(0, 2, 1).reshape(-1, steps)
        series = series - series.mean(axis=1, keepdims=True)
        length = 1 << (2 * steps - 1).bit_length()
        power = np.abs(np.fft.rfft(series, length)) ** 2
        correlation = np.fft.irfft(power, length)[:, :steps]
        with np.errstate(invalid="ignore", divide="ignore"):
            correlation = correlation / correlation[:, :1]
        # A walker that never moved is wholly correlated.
        correlation = np.where(np.isfinite(correlation), correlation, 1.0).mean(axis=0)
        estimate = 2.0 * np.cumsum(correlation) - 1.0
        # Sokal's window: the first that is 5 times the estimate it gives (as emcee does).
        enough = window >= 5.0 * estimate
        times[j] = estimate[np.argmax(enough) if enough.any() else -1]
    return np.maximum(times, 1.0)


def _posterior(
    fit: Fit,
    vector: statevector.StateVector,
    chains: np.ndarray,
    acceptance: float,
    key: Array,
) -> Posterior:
    import arviz

    times = autocorrelation_times(chains)
    longest = float(times.max())
    total = chains.shape[1]
    burn_in = min(int(np.ceil(BURN_IN * longest)), total // 2)
    chains = chains[:, burn_in:]
    steps, walkers = chains.shape[1:3]

    # Whole steps, evenly spread, in their order: draws of one step are nearly independent.
    kept = max(DRAWS // walkers, 1)
    at = np.linspace(0, steps - 1, kept).round().astype(int)
    drawn = chains[:, at].reshape(len(chains), kept * walkers, -1)
    draws = _quantities(vector, drawn)
    every = _quantities(vector, chains)
    rhat = {name: float(arviz.rhat(value, method="rank")) for name, value in draws.items()}
    ess = {
        name: float(value.size / autocorrelation_times(value[..., None])[0])
        for name, value in every.items()
    }
    prior = vector.prior_draws(jax.random.fold_in(key, ENSEMBLES), 4096)
    told = _quantities_of(vector, prior)
    coordinates = {"chain": np.arange(len(chains)), "draw": np.arange(kept * walkers)}
    data: Any = arviz.from_dict(posterior=draws, coords=coordinates)
    for name, value in draws.items():
        ratio = _spread(name, value.ravel()) / _spread(name, told[name])
        data.posterior[name].attrs["informed"] = int(ratio < inversion.INFORMED_BELOW)
    converged, verdict = _verdict(steps, longest, rhat)
    return Posterior(
        spectrum=fit.spectrum, data=data, converged=converged, verdict=verdict, rhat=rhat,
        ess=ess, autocorrelation_time=longest, steps=steps, burn_in=burn_in,
        acceptance=acceptance,
        settings={
            "ensembles": len(chains), "walkers": walkers, "form": fit.form,
            "key": np.asarray(inversion.key_data(key)).tolist(),
        },
    )  # fmt: skip


def _verdict(steps: int, longest: float, rhat: Mapping[str, float]) -> tuple[bool, str]:
    worst = max(rhat, key=lambda name: np.inf if np.isnan(rhat[name]) else rhat[name])
    lengths = steps / longest
    if lengths < ENOUGH:
        return False, (
            f"not converged: {steps} steps are {lengths:.0f} autocorrelation times, under"
            f" {ENOUGH}; sample with more steps"
        )
    if not rhat[worst] < RHAT_BELOW:
        return False, (
            f"not converged: the ensembles disagree, R-hat of {worst} is {rhat[worst]:.3f};"
            " sample with more steps, or look for several solutions"
        )
    return True, f"converged: {lengths:.0f} autocorrelation times, R-hat at most {rhat[worst]:.3f}"


def _quantities(vector: statevector.StateVector, states: np.ndarray) -> dict[str, np.ndarray]:
    """Of states (..., N) every quantity and every other free parameter, each (...)."""
    parameters = _parameters(vector, jnp.asarray(states.reshape(-1, states.shape[-1])))
    named = _quantities_of(vector, np.asarray(parameters))
    return {name: value.reshape(states.shape[:-1]) for name, value in named.items()}


@eqx.filter_jit
def _parameters(
    vector: statevector.StateVector, states: Float[Array, "S N"]
) -> Float[Array, "S P"]:
    return jax.vmap(vector.parameters)(states)


def _quantities_of(
    vector: statevector.StateVector, parameters: np.ndarray
) -> dict[str, np.ndarray]:
    moving = statevector.derived(vector.names, parameters)
    ordered = {
        name: np.asarray(moving[name])
        for name in QUANTITIES
        if name in moving and np.ptp(moving[name]) > 0.0
    }
    for name, i in zip(vector.free, vector.index, strict=True):
        ordered.setdefault(name, parameters[..., i])
    return ordered


def _spread(name: str, values: np.ndarray) -> float:
    """Standard deviation, of the logarithm for contents."""
    prior = statevector.PRIORS.get(name)
    content = name in ("melanin_mg_per_mL", "blood_percent")
    if prior is not None and prior.offset is not None:
        return float(np.std(np.log(values + prior.offset)))
    return float(np.std(np.log(values) if content else values))
