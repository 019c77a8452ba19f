"""No more than a scene needs: `plan(scene, tolerance)` -> `Plan`.

A scene is the bands of an instrument and the specimens that may come. Some of them are solved by
adding-doubling, and from these follow: the order of the solver; a few wavelengths from which all
bands follow (empirical interpolation, Drmac and Gugercin 2016); what each parameter, absorber and
layer does to the bands; and by the Fisher information, what the bands can tell. What does less
than half the tolerance together is dropped. The rest of the tolerance is for order and
wavelengths, and everything is tried together on all specimens before it is believed.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, lru_cache
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from hylios_fit import adding, fresnel, instrument, skin, table
from hylios_fit.errors import HyliosError
from hylios_fit.simulation import Curve, check_request
from hylios_fit.skin import LAYERS, SPECS, Layers, Specimen
from hylios_fit.statevector import PRIORS, by_logarithm
from hylios_fit.surrogate import EMBEDDED, Surrogate, load_surrogate

SPECIMENS = 128  # that are solved at every wavelength
PROBES = 8  # of them, on which each parameter is tried
COLUMNS = 1024  # wavelengths solved at once, so that one compiled size serves all
STEP = 0.05  # of a range, of the differences that give the Fisher information
TOLD_BELOW = 0.7  # posterior over prior sd of what a scene can tell
STREAMS = ("roughness", *(name for name in SPECS if name.startswith("index_")))
ABSENT = (
    "water", "lipids", "keratin", "corneum_tail", "dna", "urocanic_acid", "carboxyhaemoglobin",
    "methaemoglobin", "sulfhaemoglobin", "bilirubin", "beta_carotene", "fibre_fraction",
    "reticular_scattering",
)  # fmt: skip
"""Parameters that at 0 leave something out, and a word of whose value is not asked."""


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """The bands of an instrument and the specimens that may come before it.

    Args:
        wavelength_nm: narrow bands (B,), nm; with `response`, where that was sampled (N,), rising.
        response: wide bands (B, N): sensitivity times illuminant, in any unit.
        incidence: degrees.
        ranges: lowest and highest value of each parameter that differs between specimens. If not
            given, those of the training table for pigments, blood, water and lipids. `roughness`
            and the indices cannot be among them.
        specimen: everything else, `melanosome_form` included.

    Raises:
        HyliosError: wavelengths, responses or ranges that cannot be.
    """

    wavelength_nm: Any
    response: Any = None
    incidence: float = 8.0
    ranges: Mapping[str, tuple[float, float]] = dataclasses.field(
        default_factory=lambda: {
            a.name: (a.lower, a.upper) for a in table.DESIGN if PRIORS[a.name].usual
        }
    )
    specimen: Specimen = dataclasses.field(default_factory=Specimen)

    def __post_init__(self) -> None:
        nm = np.atleast_1d(np.asarray(self.wavelength_nm, float))
        check_request(nm, "adding", 1, self.incidence, None)
        if (np.diff(nm) <= 0).any():
            raise HyliosError("wavelength_nm: expected rising wavelengths")
        if self.response is not None:
            response = np.atleast_2d(np.asarray(self.response, float))
            if response.ndim != 2 or response.shape[1] != nm.size or nm.size < 2:
                raise HyliosError(
                    f"response: expected shape (bands, {nm.size}), one value a wavelength (at "
                    f"least 2), got {response.shape}"
                )
            if not (np.isfinite(response).all() and (response >= 0).all()):
                raise HyliosError("response: expected finite numbers, none below 0")
            if not (response @ np.gradient(nm) > 0).all():
                raise HyliosError("response: expected one above 0 in each band")
            object.__setattr__(self, "response", response)
        if not self.ranges:
            raise HyliosError("ranges: expected at least one parameter that varies")
        for name, (low, high) in self.ranges.items():
            if name in STREAMS:
                raise HyliosError(
                    f"ranges: {name} cannot vary within a scene; plan one for each value of it"
                )
            for value in (low, high):
                self.specimen.replace(**{name: value})
            if not low < high:
                raise HyliosError(f"ranges: {name} goes from {low:g} to {high:g}: of no width")
        object.__setattr__(self, "wavelength_nm", nm)
        object.__setattr__(self, "ranges", MappingProxyType(dict(self.ranges)))

    @cached_property
    def weights(self) -> Float[np.ndarray, "b n"]:
        """Bands from the wavelengths: each row sums to 1."""
        if self.response is None:
            return np.eye(self.wavelength_nm.size)
        nm = self.wavelength_nm
        step = np.zeros(nm.size)
        step[1:] += 0.5 * np.diff(nm)
        step[:-1] += 0.5 * np.diff(nm)
        weights = self.response * step
        return weights / weights.sum(axis=1, keepdims=True)

    @cached_property
    def centre_nm(self) -> Float[np.ndarray, "b"]:
        """The bands' centres of weight, by which a spectrum that is fitted calls them."""
        return self.weights @ self.wavelength_nm

    def values(self, share: Float[np.ndarray, "n r"]) -> Float[np.ndarray, "n p"]:
        """All parameters, in the order of `SPECS`, from where each lies in its range (0 to 1)."""
        rows = np.tile(list(self.specimen.values.values()), (len(share), 1))
        for at, (name, (low, high)) in zip(share.T, self.ranges.items(), strict=True):
            wide = by_logarithm(low, high)
            value = low * (high / low) ** at if wide else low + (high - low) * at
            rows[:, _PLACE[name]] = np.clip(value, low, high)
        return rows

    def check(self, specimen: Specimen) -> None:
        """Raise `HyliosError` for a specimen that the scene does not speak of."""
        wrong = []
        for name, value in specimen.values.items():
            usual = self.specimen.values[name]
            low, high = self.ranges.get(name, (usual, usual))
            if not low <= value <= high:
                wrong.append(f"{name} = {value:g} (planned for {low:g} to {high:g})")
        if specimen.melanosome_form != self.specimen.melanosome_form:
            wrong.append(f"melanosome_form (planned for {self.specimen.melanosome_form})")
        if wrong:
            raise HyliosError("the scene was planned for other specimens: " + "; ".join(wrong))


_PLACE = {name: i for i, name in enumerate(SPECS)}


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """What a scene needs, and how to get it.

    kept, dropped
        parameters of the scene's ranges, absorbers and layers, each with the largest change that
        it makes to a band: by moving through its range, by being there.
    held
        values of what was dropped: where a parameter is held, 0 for what is left out.
    clear
        layers that were dropped: they neither absorb nor scatter, and still refract.
    method, order
        the cheapest that meets the tolerance: `surrogate`, or `adding` at that order.
    size
        of the embedded surrogate that does, `small` or `large`; None for the solver.
    rays
        at most that many a band would bring a walk's standard error to the tolerance.
    wavelength_nm, offset, matrix
        bands (B,) = offset + matrix @ reflectance at these wavelengths.
    error
        the largest error of a band that was seen on the specimens tried.
    told
        parameters that the bands tell more of than their ranges do, the best told first, if all
        the others are known: posterior over prior sd of each.
    """

    scene: Scene
    tolerance: float
    kept: Mapping[str, float]
    dropped: Mapping[str, float]
    held: Mapping[str, float]
    clear: tuple[str, ...]
    method: str
    size: str | None
    order: int
    rays: int
    wavelength_nm: np.ndarray
    offset: np.ndarray
    matrix: np.ndarray
    error: float
    told: Mapping[str, float]

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Those of the scene that matter: what a fit frees, told or not, because what the bands do
        not tell is still not known. It is as likely everywhere there, not as in other skin."""
        return {name: edges for name, edges in self.scene.ranges.items() if name in self.kept}

    @property
    def fixed(self) -> dict[str, Any]:
        """What a fit holds: all else that its surrogate knows, where it was planned."""
        specimen = self.scene.specimen
        values: dict[str, Any] = {**specimen.values}
        values |= {name: self.held[name] for name in self._unseen}
        found = {name: values[name] for name in self._member.names if name not in self.ranges}
        return found | {"melanosome_form": specimen.melanosome_form}

    @property
    def dropped_sd(self) -> float:
        """What the ranges that are dropped do to a band, at most: a standard deviation."""
        return math.sqrt(sum(self.dropped[name] ** 2 for name in self._unseen) / 3.0)

    @property
    def _unseen(self) -> list[str]:
        return [name for name in self.scene.ranges if name in self.dropped]

    @cached_property
    def surrogate(self) -> Surrogate:
        """An embedded one on the scene's bands: that of the plan, or the large one where the plan
        takes the solver. For `fit` and `sample`.

        Raises `HyliosError` for a scene that no surrogate knows.
        """
        found = _projected(self.scene, self.size or "large")
        if found is None:
            raise HyliosError("no embedded surrogate knows the specimens or the angle of the scene")
        return found

    @property
    def _member(self) -> Any:
        return self.surrogate.at(self.scene.specimen.melanosome_form)

    def reflectance(self, specimens: Sequence[Specimen]) -> Float[np.ndarray, "n b"]:
        """The bands of many specimens, specular included, by the method of the plan.

        Raises `HyliosError` for specimens that the scene does not speak of.
        """
        for specimen in specimens:
            self.scene.check(specimen)
        rows = np.array([list(specimen.values.values()) for specimen in specimens])
        if self.method == "surrogate":
            return _asked(self._member, rows)
        rows, there = _without(rows, self.held, self.clear)
        medium = side_by_side(rows, self.scene.specimen.melanosome_form, self.wavelength_nm, there)
        found = _solve(medium, self.scene.incidence, self.order).reshape(len(rows), -1)
        return self.offset + found @ self.matrix.T

    def simulate(self, specimen: Specimen) -> Curve:
        """As `reflectance`, of one specimen; `standard_error` is the plan's largest error."""
        bands = self.reflectance([specimen])[0]
        surface = fresnel.surface_reflectance(
            math.radians(self.scene.incidence), 1.0, specimen.index_corneum, specimen.roughness
        )
        every = np.ones_like(bands)
        return Curve(
            self.scene.centre_nm, bands, self.error * every,
            surface * every, bands - surface, self.method, 0, math.nan * every,
        )  # fmt: skip

    def __str__(self) -> str:
        nm, bands = self.scene.wavelength_nm, len(self.offset)
        how = f"the {self.size} embedded surrogate"
        if self.method == "adding":
            how = f"adding of order {self.order} at {len(self.wavelength_nm)} of {nm.size} "
            how += "wavelengths"
        told = [f"{name} ({share:.2g})" for name, share in self.told.items()]
        lines = [
            f"{bands} bands, {nm[0]:g} to {nm[-1]:g} nm, to within {self.tolerance:g}",
            f"  take      {how}; largest error seen {self.error:.2g}",
            f"  a walk    needs at most {self.rays:,} rays a band",
            f"  can tell  {', '.join(told) or 'nothing'} (posterior over prior sd)",
            "  matters   (largest change of a band)",
        ]
        lines += [f"    {name:26s}{effect:9.2g}" for name, effect in self.kept.items()]
        lines.append("  dropped")
        for name, effect in self.dropped.items():
            if name in self.clear:
                done = "clear"
            elif name in self.scene.ranges:
                done = f"held at {self.held[name]:g}"
            else:
                done = "left out"
            lines.append(f"    {name:26s}{effect:9.2g}  {done}")
        return "\n".join(lines if self.dropped else [*lines[:-1], "  nothing can be dropped"])


def plan(scene: Scene, tolerance: float) -> Plan:
    """What `scene` needs for every band to be right to within `tolerance` (reflectance).

    The specimens tried are Sobol points in the scene's ranges, the same in every call. Takes
    seconds; a scene of hundreds of wavelengths some ten, compiling included.

    Raises:
        HyliosError: a tolerance that is not in 0 to 1, or that no order of the solver reaches.
    """
    from scipy.stats import qmc

    if not isinstance(scene, Scene):
        raise HyliosError(f"scene: expected a Scene, got {type(scene).__name__}")
    if not 0 < tolerance < 1:
        raise HyliosError(f"tolerance: expected a reflectance above 0 and below 1, got {tolerance}")
    ranged = tuple(scene.ranges)
    share = qmc.Sobol(len(ranged), rng=np.random.default_rng(0)).random(SPECIMENS)
    rows = scene.values(share)
    order = _order(scene, rows, tolerance / 4)
    spectra = _spectra(scene, rows, np.ones((SPECIMENS, 6)), scene.wavelength_nm, order)
    truth = spectra @ scene.weights.T
    columns, offset, matrix = _thinned(spectra, scene.weights, tolerance / 4)
    nm = scene.wavelength_nm[columns]

    def bands(rows: np.ndarray, there: np.ndarray) -> np.ndarray:
        return offset + _spectra(scene, rows, there, nm, order) @ matrix.T

    effects, held, fisher = _effects(scene, share[:PROBES], bands)
    effects = dict(sorted(effects.items(), key=lambda item: item[1]))
    together = np.cumsum(list(effects.values()))
    out = list(effects)[: int(np.searchsorted(together, tolerance / 2))]
    while True:  # together they may do more than the sum of what each does
        values = {name: held[name] for name in out if name in held}
        clear = tuple(name for name in LAYERS if name in out)
        error = float(np.max(np.abs(bands(*_without(rows, values, clear)) - truth)))
        if error <= 0.75 * tolerance or not out:
            break
        out.pop()
    method, taken = "adding", None
    for size in EMBEDDED:
        found = _projected(scene, size)
        if found is None:
            continue
        member = found.at(scene.specimen.melanosome_form)
        missed = float(np.max(np.abs(_asked(member, rows) - truth)))
        if missed <= 0.75 * tolerance:
            method, taken, error = "surrogate", size, missed
            break
    told = _told(fisher / tolerance**2, ranged, out)
    return Plan(
        scene, tolerance,
        kept=MappingProxyType({n: effects[n] for n in reversed(effects) if n not in out}),
        dropped=MappingProxyType({n: effects[n] for n in reversed(effects) if n in out}),
        held=MappingProxyType(values), clear=clear, method=method, size=taken, order=order,
        rays=math.ceil(np.max(truth * (1.0 - truth)) / tolerance**2),
        wavelength_nm=nm, offset=offset, matrix=matrix, error=error,
        told=MappingProxyType(told),
    )  # fmt: skip


# --- the solver on many specimens ---------------------------------------------------------------


def side_by_side(
    rows: Float[np.ndarray, "n p"], form: str, wavelength_nm: np.ndarray, there: Any = None
) -> Layers:
    """Layers of many specimens as further wavelengths, (6, n w), with the rejection of particles.

    `rows` in the order of `SPECS`, of one roughness; `there` (n, 6): 0 for a layer without
    contents.
    """
    there = np.ones((len(rows), 6)) if there is None else there
    nm = tuple(np.asarray(wavelength_nm, float).tolist())
    return _coefficients(form, nm)(np.asarray(rows, np.float32), np.asarray(there, np.float32))


@lru_cache(maxsize=32)
def _coefficients(form: str, nm: tuple[float, ...]) -> Callable[[Any, Any], Layers]:
    of = table.layers_of(tuple(SPECS), form, wavelength_nm=nm)

    def every(rows, there):
        medium = of(rows)
        each = there[:, :, None]
        return skin.side_by_side(
            medium._replace(
                mu_a=medium.mu_a * each,
                mu_particle=medium.mu_particle * each,
                mu_fibre=medium.mu_fibre * each[:, 4],
                mu_tissue=medium.mu_tissue * each,
            )
        )

    return jax.jit(every)


def _solve(medium: Layers, incidence: float, order: int) -> np.ndarray:
    found = adding.skin(medium, incidence=math.radians(incidence), order=order)
    return np.asarray(found.reflectance, float)


def _spectra(
    scene: Scene, rows: np.ndarray, there: np.ndarray, nm: np.ndarray, order: int
) -> Float[np.ndarray, "n w"]:
    """Reflectance of rows of parameters, in lots of one size."""
    each = max(1, COLUMNS // nm.size)
    found = []
    for start in range(0, len(rows), each):
        lot = np.arange(start, start + each).clip(max=len(rows) - 1)  # the last may be repeated
        medium = side_by_side(rows[lot], scene.specimen.melanosome_form, nm, there[lot])
        spare = max(COLUMNS, each * nm.size) - each * nm.size
        medium = Layers(
            *(
                jnp.pad(part, [*[(0, 0)] * (part.ndim - 1), (0, spare)], mode="edge")
                if part.ndim else part
                for part in medium
            )
        )  # fmt: skip
        solved = _solve(medium, scene.incidence, order)[: each * nm.size]
        found.append(solved.reshape(each, -1)[: len(rows) - start])
    return np.concatenate(found)


# --- what a scene needs -------------------------------------------------------------------------


def _order(scene: Scene, rows: np.ndarray, limit: float) -> int:
    """The lowest order that the next one changes by no more than `limit`, on a few specimens."""
    nm = scene.wavelength_nm
    nm = nm[np.unique(np.linspace(0, nm.size - 1, 64).round().astype(int))]
    few = rows[: max(2, COLUMNS // nm.size)][:SPECIMENS]
    before = None
    for lower, order in zip((0, *adding.ORDERS), adding.ORDERS, strict=False):
        found = _spectra(scene, few, np.ones((len(few), 6)), nm, order)
        if before is not None and np.max(np.abs(found - before)) <= limit:
            return lower
        before = found
    raise HyliosError(
        f"no order of the solver up to {adding.ORDERS[-1]} reaches the tolerance {4 * limit:g}"
    )


def _thinned(
    spectra: np.ndarray, weights: np.ndarray, limit: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Few columns, and how the bands follow from them: (columns, offset (B,), matrix (B, m)).

    Principal components of three in four spectra, at as many wavelengths as they are (pivoted QR);
    the others say how many are enough.
    """
    from scipy.linalg import qr

    factorise: Any = qr
    mean, count = spectra.mean(axis=0), spectra.shape[1]
    last = np.arange(len(spectra)) % 4 == 3
    known, tried = spectra[~last] - mean, spectra[last]
    basis = np.linalg.svd(known, full_matrices=False)[2]
    for m in range(1, min(count, len(known) - 1)):
        pivots = factorise(basis[:m], mode="r", pivoting=True)[1]
        columns = np.sort(pivots[:m])
        matrix = np.linalg.solve(basis[:m, columns], basis[:m] @ weights.T).T
        offset = weights @ mean - matrix @ mean[columns]
        missed = offset + tried[:, columns] @ matrix.T - tried @ weights.T
        if np.max(np.abs(missed)) <= limit:
            return columns, offset, matrix
    used = np.flatnonzero(weights.any(axis=0))
    return used, np.zeros(len(weights)), weights[:, used]


def _without(
    rows: np.ndarray, held: Mapping[str, float], clear: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    rows, there = rows.copy(), np.ones((len(rows), 6))
    for name, value in held.items():
        rows[:, _PLACE[name]] = value
    for name in clear:
        there[:, LAYERS.index(name)] = 0.0
    return rows, there


def _effects(
    scene: Scene, share: np.ndarray, bands: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> tuple[dict[str, float], dict[str, float], np.ndarray]:
    """The largest change of a band by each name; where it would be held; the Fisher information
    (R, R) of the ranges' parameters for bands of unit noise, in units of their priors' sd."""
    tried: list[tuple[np.ndarray, np.ndarray]] = []
    base = scene.values(share)

    def add(rows: np.ndarray, clear: Sequence[str] = ()) -> None:
        tried.append(_without(rows, {}, clear))

    def moved(rows: np.ndarray, name: str, value: float) -> np.ndarray:
        return _without(rows, {name: value}, ())[0]

    add(base)
    usual = scene.specimen.values
    held = {}
    for name, (low, high) in scene.ranges.items():
        middle = scene.values(np.full((1, share.shape[1]), 0.5))[0, _PLACE[name]]
        held[name] = usual[name] if low <= usual[name] <= high else float(middle)
        for value in (held[name], low, high):
            add(moved(base, name, value))
    absent = [name for name in ABSENT if name not in scene.ranges and usual[name] > 0]
    for name in absent:
        held[name] = 0.0
        add(moved(base, name, 0.0))
    for name in LAYERS:
        add(base, (name,))
    inner = share.clip(STEP, 1.0 - STEP)
    for i in range(share.shape[1]):
        for sign in (-STEP, STEP):
            add(scene.values(inner + sign * (np.arange(share.shape[1]) == i)))
    found = bands(*(np.concatenate(part) for part in zip(*tried, strict=True)))
    found = iter(found.reshape(len(tried), len(share), -1))

    before = next(found)
    effects = {}
    for name in scene.ranges:
        at, low, high = next(found), next(found), next(found)
        effects[name] = float(max(np.max(np.abs(low - at)), np.max(np.abs(high - at))))
    for name in (*absent, *LAYERS):
        effects[name] = float(np.max(np.abs(next(found) - before)))
    slope = np.stack([-(next(found) - next(found)) / (2 * STEP) for _ in scene.ranges], axis=-1)
    slope = slope / math.sqrt(12.0)  # the sd of what is as likely everywhere in its range
    return effects, held, np.mean(np.swapaxes(slope, 1, 2) @ slope, axis=0)


def _told(fisher: np.ndarray, names: tuple[str, ...], out: Sequence[str]) -> dict[str, float]:
    """Names added one by one, the best told first, while the posterior is narrower than the prior;
    with posterior over prior sd of each when all of them are free."""
    chosen: list[int] = []
    left = [i for i, name in enumerate(names) if name not in out]

    def sd(among: list[int]) -> np.ndarray:
        inverse = np.linalg.inv(fisher[np.ix_(among, among)] + np.eye(len(among)))
        return np.sqrt(np.diag(inverse))

    while left:
        best = min(left, key=lambda i: sd([*chosen, i])[-1])
        if sd([*chosen, best])[-1] > TOLD_BELOW:
            break
        chosen.append(best)
        left.remove(best)
    return {names[i]: float(s) for i, s in zip(chosen, sd(chosen), strict=True)} if chosen else {}


# --- the surrogate ------------------------------------------------------------------------------


def _projected(scene: Scene, size: str) -> Surrogate | None:
    """An embedded surrogate on the scene's bands; None where it knows no such scene."""
    try:
        surrogate = load_surrogate(size=size)
        usual = Specimen().values
        strange = [
            name for name, value in scene.specimen.values.items()
            if name not in surrogate.names and (value != usual[name] or name in scene.ranges)
        ]  # fmt: skip
        if strange or scene.incidence != surrogate.incidence_deg:
            return None
        grid = instrument.interpolation_matrix(surrogate.wavelength_nm, scene.wavelength_nm)
        weights = scene.weights @ grid
        on = {form: surrogate.at(form).onto(weights) for form in surrogate.forms}
        return Surrogate(on, surrogate.about) if scene.specimen.melanosome_form in on else None
    except HyliosError:
        return None


def _asked(member: Any, rows: np.ndarray) -> np.ndarray:
    """NaN outside the surrogate's box."""
    columns = [_PLACE[name] for name in member.names]
    return np.asarray(member(np.asarray(rows[:, columns], np.float32)), float)
