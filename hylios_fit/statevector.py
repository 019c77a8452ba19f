"""The state vector: names, order, bounds, priors and transforms of the free parameters.

A parameter `x` of the surrogate's box is a monotone function of an unbounded variable `u` with a
unit normal prior,

    f(x) = f_lower + (f_upper - f_lower) / (1 + exp(-(a + b u))),

where `f` is log(x + offset) for contents and the identity for the rest; `a` and `b` are set so
that u = 0 is the prior's median and the slope there its standard deviation in `f`. Every `u` is
inside the box, and prior draws are exact. The variables of the pigment contents are correlated
(dark skin is dark in every stratum), and so are those of blood; the Cholesky factor of that
correlation whitens them: u = mean + factor z with z a unit normal. Solvers and samplers work in z.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hylios_fit.errors import HyliosError
from hylios_fit.precision import product
from hylios_fit.skin import SPECS, STRATA
from hylios_fit.surrogate import SLACK


@dataclass(frozen=True)
class Prior:
    """Prior of one parameter, from physiology.

    `median` is in the parameter's unit; `sd` in log(x + offset) where `offset` is given, else in
    the parameter's unit. `factor` is a variable shared with the other parameters of that name,
    `loading` the correlation with it.
    """

    median: float
    sd: float
    offset: float | None = None
    factor: str = ""
    loading: float = 0.0
    source: str = ""
    usual: bool = True  # free unless said otherwise; else the model's own value unless asked for


_TABLE_I = "Table I of Chen et al. 2015 (S1 to S4), after Kollias 1991 and Hennessy 2005"

_INDEX = "1.36 to 1.43 in vivo (Ding 2006); the measured near infrared asks for up to 1.55"
_CELLS = "Whitton and Everall 1973; Sandby-Moller 2003"

#: The declared order is that of the surrogate; the names and priors are these. Together the
#: first six give a prior of melanin per volume of epidermis from about 0.3 to 15 mg/mL (2 sd).
PRIORS: Mapping[str, Prior] = {
    # Table I: 0 to 10 % in granulosum and spinosum, 1 to 10 % in basale. Light skin has few or
    # none above the basale, dark skin as many there (Szabo 1969, Olson 1973): the medians fall
    # and the spreads widen upwards. The offset lets a content be practically nothing.
    "melanosome_granulosum": Prior(1.0, 1.1, 0.3, "melanisation", 0.7, _TABLE_I),
    "melanosome_spinosum": Prior(1.5, 1.0, 0.3, "melanisation", 0.75, _TABLE_I),
    "melanosome_basale": Prior(3.2, 0.95, 0.3, "melanisation", 0.8, _TABLE_I),
    # Table I: 0.8 to 15 %.
    "colloidal_melanin": Prior(2.2, 1.2, 0.1, "melanisation", 0.85, _TABLE_I),
    # Table I: 32 to 90 mg/mL and 2 to 4 mg/mL; the spreads are wider, for red hair and albinism
    # do not end at four specimens.
    "eumelanin": Prior(55.0, 0.55, 0.0, source=_TABLE_I),
    "pheomelanin": Prior(2.8, 0.7, 0.0, source=_TABLE_I),
    # 0.2 to 4 % of the dermis (Jacques 1996; Angelopoulou 2001; Table I: 0.2 to 2.5 %), the same
    # perfusion in both plexus as a rule.
    "blood_papillary": Prior(0.9, 0.75, 0.0, "perfusion", 0.75, "Jacques 1996; Table I"),
    "blood_reticular": Prior(0.9, 0.75, 0.0, "perfusion", 0.75, "Jacques 1996; Table I"),
    # Dermal capillaries and venules to arterioles: 0.4 to 0.95 (Zonios 2001; Stratonnikov 2001).
    "oxygen_saturation": Prior(0.72, 0.15, source="Zonios 2001; Stratonnikov and Loschenov 2001"),
    # 0.7 to 1.1 of the default content (Blank 1952: up to 40 % loss; Nakagawa 2010).
    "water": Prior(0.95, 0.12, source="Blank 1952; Nakagawa 2010"),
    # No population study found for the dermis: within a factor two of the default.
    "lipids": Prior(1.0, 0.35, source="assumed, within a factor of two"),
    # What follows stays at the model's value unless it is asked for. Ultraviolet absorbers: the
    # measured ultraviolet asks for 0.9 to 3 times the corneum's tail.
    "keratin": Prior(1.0, 0.4, 0.3, source="assumed, within a factor of two", usual=False),
    "corneum_tail": Prior(1.5, 0.9, 0.3, source="0.9 to 3 on the NIST set, wider", usual=False),
    "dna": Prior(1.0, 0.4, 0.3, source="assumed, as keratin", usual=False),
    "urocanic_acid": Prior(1.0, 0.4, source="de Fine Olivarius 1997", usual=False),
    # Up to 1 to 2 % of the haemoglobin in health, more in smokers (Zijlstra 2000).
    "carboxyhaemoglobin": Prior(2.0, 0.7, 1.0, source="Zijlstra 2000", usual=False),
    "methaemoglobin": Prior(1.5, 0.6, 1.0, source="Zijlstra 2000", usual=False),
    "sulfhaemoglobin": Prior(0.15, 0.8, 0.3, source="Zijlstra 2000", usual=False),
    "bilirubin": Prior(0.006, 0.8, 0.01, source="0.002 to 0.012 mg/mL of serum", usual=False),
    "beta_carotene": Prior(1.0, 0.6, 0.3, source="Alaluf 2002", usual=False),
    "thickness_corneum": Prior(0.0012, 0.3, 0.0, source="Egawa 2007", usual=False),
    "thickness_granulosum": Prior(0.0033, 0.25, 0.0, source=_CELLS, usual=False),
    "thickness_spinosum": Prior(0.0033, 0.25, 0.0, source=_CELLS, usual=False),
    "thickness_basale": Prior(0.0033, 0.25, 0.0, source=_CELLS, usual=False),
    "thickness_papillary": Prior(0.018, 0.3, 0.0, source="Meglinski 2002", usual=False),
    "thickness_reticular": Prior(0.13, 0.35, 0.0, source="Laurent 2007", usual=False),
    "index_corneum": Prior(1.53, 0.02, source="Tearney 1995; Ding 2006", usual=False),
    "index_epidermis": Prior(1.43, 0.05, source=_INDEX, usual=False),
    "index_papillary": Prior(1.43, 0.05, source=_INDEX, usual=False),
    "index_reticular": Prior(1.43, 0.05, source=_INDEX, usual=False),
    "fibre_fraction": Prior(0.24, 0.06, source="0.22 in the paper", usual=False),
    "reticular_scattering": Prior(12.0, 0.7, 2.0, source="Jacques 2013", usual=False),
    "reticular_scattering_power": Prior(1.3, 0.35, source="Jacques 2013", usual=False),
    "bottom_reflectance": Prior(0.6, 0.18, source="0.5 to 0.9 on measured skin", usual=False),
    "index_dispersion": Prior(0.012, 0.009, source=_INDEX, usual=False),
}

#: Conditioning on a held value at the very edge of the box would put its variable at infinity.
_U_LIMIT = 3.0

EVEN = 1.702
"""A logistic curve that much steeper is the normal distribution to 0.01 (Haley 1952)."""
#: Water of the dermis in % at the model's content.
DERMIS_WATER_PERCENT = 75.0


class StateVector(eqx.Module):
    """The free parameters of one inversion, as a function of the whitened state.

    `P` counts the surrogate's continuous parameters, `N` the free ones. A pytree: two vectors
    with the same names compile to the same program, whatever their held values.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    """(P) all parameters, in the surrogate's order."""
    free: tuple[str, ...] = eqx.field(static=True)
    """(N) the free ones, in the same order."""
    lower: np.ndarray
    upper: np.ndarray
    """(P,) the box, in the units of the parameters."""
    logarithmic: np.ndarray
    offset: np.ndarray
    shift: np.ndarray
    slope: np.ndarray
    """(P,) `a` and `b` of the transform."""
    mean: np.ndarray
    """(N,) prior mean of u, given the held values."""
    factor: np.ndarray
    """(N, N) lower triangular; prior covariance of u is factor @ factor.T."""
    held: np.ndarray
    """(P,) values of the held parameters, the prior's median where free by default."""

    @property
    def index(self) -> np.ndarray:
        """(N,) positions of the free parameters among all."""
        return np.array([self.names.index(name) for name in self.free], dtype=int)

    def u(self, z: Float[Array, "... N"]) -> Float[Array, "... N"]:
        """The unbounded variables of the free parameters."""
        z = jnp.asarray(z)
        u = product(z, jnp.asarray(self.factor.T, z.dtype))
        return u + jnp.broadcast_to(jnp.asarray(self.mean, z.dtype), u.shape)

    def from_u(self, u: Float[Array, "... N"]) -> Float[Array, "... N"]:
        """Values of the free parameters, inside the box, from their unbounded variables."""
        u = jnp.asarray(u)

        def pick(values: Any) -> Array:
            return jnp.broadcast_to(jnp.asarray(values[self.index], u.dtype), u.shape)

        lower, upper = pick(self.lower), pick(self.upper)
        offset = pick(self.offset)
        logarithmic = jnp.broadcast_to(self.logarithmic[self.index], u.shape)
        share = jax.nn.sigmoid(pick(self.shift) + pick(self.slope) * u)
        # A safe stand-in keeps the branch that is not taken free of NaN, and so its gradient.
        base = jnp.where(logarithmic, lower + offset, 1.0)
        span = jnp.where(logarithmic, jnp.log((upper + offset) / base), 0.0)
        value = lower + jnp.where(
            logarithmic, base * jnp.expm1(span * share), (upper - lower) * share
        )
        return jnp.clip(value, lower, upper)

    def parameters(self, z: Float[Array, "... N"]) -> Float[Array, "... P"]:
        """All parameters of the surrogate, inside its box, from the whitened state."""
        free = self.from_u(self.u(z))
        held = jnp.asarray(self.held, free.dtype)
        whole = jnp.broadcast_to(held, (*free.shape[:-1], len(self.names)))
        return whole.at[..., self.index].set(free)

    def state(self, parameters: Float[Array | np.ndarray, "... P"]) -> np.ndarray:
        """The whitened state of given parameters; the held ones are not looked at.

        Raises `HyliosError` for a value at or beyond the edge of the box, where it is infinite.
        """
        values = np.asarray(parameters, dtype=np.float64)[..., self.index]
        u = _to_u(self, values, self.index)
        if not np.all(np.isfinite(u)):
            at = [self.free[i] for i in np.unique(np.argwhere(~np.isfinite(u))[:, -1])]
            raise HyliosError(f"not inside the surrogate's range: {', '.join(at)}")
        return np.linalg.solve(self.factor, (u - self.mean)[..., None])[..., 0]

    def prior_draws(self, key: Array, count: int) -> np.ndarray:
        """(count, P) parameters drawn from the prior, float64."""
        z = np.asarray(jax.random.normal(key, (count, len(self.free))), dtype=np.float64)
        with jax.enable_x64(True):
            return np.array(self.parameters(jnp.asarray(z)))

    def edge_share(self, z: np.ndarray) -> np.ndarray:
        """(N,) where each free parameter lies in its range: 0 at the lower edge, 1 at the upper.

        Measured in log(x + offset) for contents.
        """
        u = self.mean + np.asarray(z) @ self.factor.T
        exponent = self.shift[self.index] + self.slope[self.index] * u
        return 1.0 / (1.0 + np.exp(-np.clip(exponent, -700.0, 700.0)))


def _to_u(vector: StateVector, values: np.ndarray, index: np.ndarray) -> np.ndarray:
    lower, upper = vector.lower[index], vector.upper[index]
    logarithmic, offset = vector.logarithmic[index], vector.offset[index]
    with np.errstate(divide="ignore", invalid="ignore"):
        base = np.where(logarithmic, lower + offset, 1.0)
        share = np.where(
            logarithmic,
            np.log1p((values - lower) / base) / np.log((upper + offset) / base),
            (values - lower) / (upper - lower),
        )
        exponent = np.log(share) - np.log1p(-share)
    return (exponent - vector.shift[index]) / vector.slope[index]


def by_logarithm(low: float, high: float) -> bool:
    """Whether a range is even in the logarithm: one of orders of magnitude."""
    return low > 0 and high / low > 10


def prior_correlation(names: Iterable[str]) -> np.ndarray:
    """(P, P) correlation of the unbounded variables: product of the loadings on a shared factor."""
    priors = [PRIORS[name] for name in names]
    loading = np.array([prior.loading for prior in priors])
    shared = np.array([[a.factor == b.factor != "" for b in priors] for a in priors])
    correlation = np.outer(loading, loading) * shared
    np.fill_diagonal(correlation, 1.0)
    return correlation


def state_vector(
    names: Iterable[str],
    lower: Any,
    upper: Any,
    free: Iterable[str] | None = None,
    fix: Mapping[str, float] | None = None,
    ranges: Mapping[str, tuple[float, float]] | None = None,
) -> StateVector:
    """The state vector for a surrogate's parameters and box.

    `names` (P), `lower` and `upper` (P,): the surrogate's. `free`: which vary; the word `usual`
    among them, or None, stands for all that their prior calls usual and are not fixed. The others
    stay at the median of their prior, those that are not usual at the model's own value. `fix`:
    values that are known; the prior of the free ones is conditioned on them. `ranges`: two values
    between which a free one is known to lie, as likely everywhere there (see `by_logarithm`) and
    whatever the others are, in the place of its prior.

    Raises `HyliosError` for an unknown name, a value outside the box, a name both free and fixed,
    nothing left free, or a parameter that has no declared prior.
    """
    names = tuple(names)
    lower, upper = (np.asarray(edge, dtype=np.float64) for edge in (lower, upper))
    fix = dict(fix or {})
    free = _spelt_out(("usual",) if free is None else free, names, fix)
    known = ", ".join(names)
    for name in (*free, *fix):
        if name not in names:
            raise HyliosError(f"unknown parameter {name!r}; the surrogate knows: {known}")
    for name, (low, high) in (ranges or {}).items():
        if name not in free or not low < high:
            raise HyliosError(
                f"{name} from {low:g} to {high:g}: expected two rising values of one "
                f"that is free ({', '.join(free)})"
            )
    undeclared = [name for name in names if name not in PRIORS]
    if undeclared:
        raise HyliosError(
            f"no prior is declared for {', '.join(undeclared)}: add it to statevector.PRIORS"
        )
    both = set(free) & set(fix)
    if both:
        raise HyliosError(f"both free and fixed: {', '.join(sorted(both))}")

    def inside(name: str, value: float) -> float:
        low, high = lower[names.index(name)], upper[names.index(name)]
        slack = SLACK * (high - low)
        if not low - slack <= float(value) <= high + slack:
            raise HyliosError(
                f"{name} = {value} is outside the surrogate's range {low:g} to {high:g}"
            )
        return float(np.clip(value, low, high))

    fix = {name: inside(name, value) for name, value in fix.items()}
    ranges = {name: (inside(name, a), inside(name, b)) for name, (a, b) in (ranges or {}).items()}
    chosen = tuple(n for n in names if n in free)
    if not chosen:
        raise HyliosError(f"nothing is free: leave at least one of {known}")

    priors = [PRIORS[name] for name in names]
    logarithmic = np.array([prior.offset is not None for prior in priors])
    offset = np.array([prior.offset or 0.0 for prior in priors])
    median = np.array([prior.median for prior in priors])
    sd = np.array([prior.sd for prior in priors])
    correlation = prior_correlation(names)
    lower, upper = lower.copy(), upper.copy()
    for name, edges in ranges.items():
        i = names.index(name)
        lower[i], upper[i] = edges
        logarithmic[i], offset[i] = by_logarithm(*edges), 0.0
        low, high = np.log(edges) if logarithmic[i] else edges
        middle, sd[i] = (low + high) / 2, EVEN * (high - low) / 4
        median[i] = np.exp(middle) if logarithmic[i] else middle
        correlation[i] = correlation[:, i] = np.eye(len(names))[i]
    bad = ~((lower < median) & (median < upper))
    bad |= logarithmic & (lower + offset <= 0.0)
    if bad.any():
        at = names[int(np.argmax(bad))]
        raise HyliosError(
            f"the surrogate's range of {at} does not hold the prior's median {PRIORS[at].median}"
        )
    base = np.where(logarithmic, lower + offset, 1.0)
    span = np.where(logarithmic, np.log((upper + offset) / base), upper - lower)
    share = np.where(logarithmic, np.log((median + offset) / base), median - lower) / span

    vector = StateVector(
        names=names, free=chosen, lower=lower, upper=upper,
        logarithmic=logarithmic, offset=offset,
        shift=np.log(share / (1.0 - share)), slope=sd / (span * share * (1.0 - share)),
        mean=np.zeros(len(chosen)), factor=np.eye(len(chosen)), held=median,
    )  # fmt: skip
    held = median.copy()
    for i, (name, prior) in enumerate(zip(names, priors, strict=True)):
        if not prior.usual:
            held[i] = np.clip(SPECS[name].default, lower[i], upper[i])
    for name, value in fix.items():
        held[names.index(name)] = value
    i = vector.index
    k = np.array([names.index(name) for name in fix], dtype=int)
    known_u = np.clip(_to_u(vector, held[k], k), -_U_LIMIT, _U_LIMIT)
    # A normal conditioned on some of its elements (Rodgers 2000, appendix).
    gain = np.linalg.solve(correlation[np.ix_(k, k)], correlation[np.ix_(k, i)]).T
    covariance = correlation[np.ix_(i, i)] - gain @ correlation[np.ix_(k, i)]
    return eqx.tree_at(
        lambda v: (v.mean, v.factor, v.held),
        vector,
        (gain @ known_u, np.linalg.cholesky(covariance), held),
    )


def _spelt_out(
    free: Iterable[str], names: tuple[str, ...], fix: Mapping[str, float]
) -> tuple[str, ...]:
    usual = [n for n in names if n in PRIORS and PRIORS[n].usual and n not in fix]
    asked = list(free)
    if "usual" in asked:
        asked = [n for n in asked if n != "usual"] + usual
    return tuple(dict.fromkeys(asked))


def derived(
    names: tuple[str, ...], parameters: Float[Array | np.ndarray, "... P"]
) -> dict[str, Any]:
    """The quantities that follow from the parameters, as far as `names` suffice.

    melanin_mg_per_mL
        eumelanin and pheomelanin per volume of the living epidermis, mean over its three strata.
    blood_percent
        % volume of the dermis, mean by thickness.
    oxygen_saturation
        fraction.
    water_percent
        % volume of the dermis.
    """
    p = {name: parameters[..., i] for i, name in enumerate(names)}

    def mean(layers: tuple[str, ...], contents: Any) -> Any:
        """By volume."""
        widths = [p.get(f"thickness_{n}", SPECS[f"thickness_{n}"].default) for n in layers]
        return sum(w * x for w, x in zip(widths, contents, strict=True)) / sum(widths)

    quantities = {}
    strata = tuple(f"melanosome_{stratum}" for stratum in STRATA)
    if {*strata, "colloidal_melanin", "eumelanin", "pheomelanin"} <= p.keys():
        content = mean(STRATA, [p[stratum] + p["colloidal_melanin"] for stratum in strata])
        quantities["melanin_mg_per_mL"] = content / 100.0 * (p["eumelanin"] + p["pheomelanin"])
    if {"blood_papillary", "blood_reticular"} <= p.keys():
        parts = ("papillary", "reticular")
        quantities["blood_percent"] = mean(parts, [p[f"blood_{part}"] for part in parts])
    if "oxygen_saturation" in p:
        quantities["oxygen_saturation"] = p["oxygen_saturation"]
    if "water" in p:
        quantities["water_percent"] = DERMIS_WATER_PERCENT * p["water"]
    return quantities
