"""A specimen's reflectance by any of the methods: `simulate` -> `Curve`."""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import Any, Protocol

import jax
import numpy as np

from hylios_fit import adding, analog, fresnel, skin, tally, walker
from hylios_fit.errors import HyliosError
from hylios_fit.skin import Specimen
from hylios_fit.threads import side_by_side
from hylios_fit.units import WAVELENGTH_MAX, WAVELENGTH_MIN

METHODS = ("walker", "analog", "adding", "surrogate")
FIRST = 2 * walker.BATCH  # rays before a tolerance is asked for, where no pilot says how many
FORESEEN = 1.15  # of the rays that a pilot says: it is a little too hopeful
# Rays of one call on a CPU, at most. Every lot keeps lanes waiting for its last rays: few lots cost
# few core-seconds, and a usual curve keeps two cores busy.
LOT = 262_144
GRAIN = 1024  # rays come in multiples of this
MOST_RAYS = 20_000_000  # where a tolerance stops asking for more
MANY_RAYS = 2 * LOT  # of which not all set out before some are looked at
ANALOG_BATCH = 4096
ABSORB = 0.5  # see `walker.walk`: the answer does not depend on it, the cost does


@dataclasses.dataclass(frozen=True)
class Curve:
    """A directional-hemispherical reflectance curve, specular included.

    All arrays have one value a wavelength: `reflectance` is `surface` (reflected at once) plus
    `subsurface` (came back from inside), `standard_error` that of `reflectance`. `effective_rays`
    counts what the weighted rays that came back are worth. `note` says what a reader must know.
    """

    wavelength_nm: np.ndarray
    reflectance: np.ndarray
    standard_error: np.ndarray
    surface: np.ndarray
    subsurface: np.ndarray
    method: str
    rays: int
    effective_rays: np.ndarray
    note: str = ""


class Planned(Protocol):
    """What answers for a scene (`planning.Plan`)."""

    def simulate(self, specimen: Specimen) -> Curve: ...


def simulate(
    specimen: Specimen,
    wavelengths: Any = None,
    method: str = "walker",
    *,
    rays: int = 100_000,
    key: jax.Array | None = None,
    incidence: float = 8.0,
    tolerance: float | None = None,
    smooth_surface: bool = False,
    independent_particles: bool = False,
    plan: Planned | None = None,
    progress: bool = False,
) -> Curve:
    """Reflectance of `specimen` at `wavelengths` (nm, 250 to 2500) and `incidence` (degrees).

    `walker` spreads `rays` over all wavelengths and shares their paths; `analog` sends `rays` rays
    at each wavelength; `adding` solves without noise (its `standard_error` is what the next lower
    order differs by, and the rejection of particles is a mean over rays, `skin.let_stand`);
    `surrogate` asks the large embedded one (8 degrees, its own training range).
    With `tolerance`, rays are added until every standard error is below it, up to `MOST_RAYS`;
    `note` says so if that was not enough. Both walks need a `key` (`jax.random.key(seed)`).
    With the `plan` of a scene the bands are the scene's, by the method and at the incidence that it
    says: nothing else is given.
    """
    if plan is not None:
        said = method, rays, incidence, tolerance, smooth_surface, independent_particles
        usual = "walker", 100_000, 8.0, None, False, False
        if wavelengths is not None or key is not None or said != usual:
            raise HyliosError("a plan says the wavelengths, how, and how well: give it or them")
        return plan.simulate(specimen)
    if wavelengths is None:
        raise HyliosError("give wavelengths, or the plan of a scene")
    nm = np.atleast_1d(np.asarray(wavelengths, float))
    check_request(nm, method, rays, incidence, tolerance)
    if smooth_surface:
        specimen = specimen.replace(roughness=0.0)
    if method == "surrogate":
        return _surrogate(specimen, nm, incidence, independent_particles)
    if method == "adding":
        return _added(specimen, nm, math.radians(incidence), tolerance, independent_particles)
    if key is None:
        raise HyliosError(f"method {method!r} draws random numbers: give key=jax.random.key(seed)")
    medium = specimen.layers(nm)
    angle = math.radians(incidence)
    surface = fresnel.surface_reflectances(angle, np.asarray(medium.index[0]), specimen.roughness)
    run = _walked if method == "walker" else _traced
    return run(
        specimen, medium, nm, surface, rays, key, angle, tolerance, independent_particles, progress
    )


def with_covariance(
    specimen: Specimen, nm: np.ndarray, rays: int, key: jax.Array, incidence: float = 8.0
) -> tuple[np.ndarray, np.ndarray]:
    """Reflectance (w,) by the walker, and the covariance (w, w) of its error between wavelengths.

    Wavelengths share paths, and so errors; `simulate` states their standard errors alone.
    `incidence` in degrees.
    """
    layers = specimen.layers(nm)
    angle = math.radians(incidence)
    batch = min(walker.batch_rays(), rays)

    def lot(first: int) -> tuple[np.ndarray, np.ndarray]:
        paths = walker.walk(
            layers, specimen.melanosome_form, key,
            incidence=angle, first=first, rays=batch, absorb=ABSORB,
        )  # fmt: skip
        return tally.moments(paths, layers, ABSORB)

    lots = list(side_by_side(lot, range(0, rays, batch)))
    mean = np.mean([lot[0] for lot in lots], axis=0)
    covariance = np.mean([lot[1] for lot in lots], axis=0) / len(lots)
    surface = fresnel.surface_reflectance(angle, 1.0, specimen.index_corneum, specimen.roughness)
    return surface + (1.0 - surface) * mean, (1.0 - surface) ** 2 * covariance


def check_request(
    nm: np.ndarray, method: str, rays: int, incidence: float, tolerance: float | None
) -> None:
    if method not in METHODS:
        raise HyliosError(f"method is one of {', '.join(METHODS)}, got {method!r}")
    if nm.ndim != 1 or nm.size == 0:
        raise HyliosError(f"wavelengths must be a list of numbers, got shape {nm.shape}")
    outside = nm[~((nm >= WAVELENGTH_MIN) & (nm <= WAVELENGTH_MAX))]
    if outside.size:
        raise HyliosError(
            f"wavelengths must lie in {WAVELENGTH_MIN:g} to {WAVELENGTH_MAX:g} nm, "
            f"got {outside[0]:g}"
        )
    if not 1 <= rays < 2**32:
        raise HyliosError(f"rays must lie in 1 to {2**32 - 1} (a 32-bit counter), got {rays}")
    if not 0 <= incidence <= 85:
        raise HyliosError(f"incidence must lie in 0 to 85 degrees, got {incidence:g}")
    if tolerance is not None and not tolerance > 0:
        raise HyliosError(f"tolerance is a standard error above 0, got {tolerance:g}")


def _walked(
    specimen, medium, nm, surface, rays, key, angle, tolerance, independent, progress
) -> Curve:
    plan, own_only = walker.plan_or_own(medium, ABSORB)
    few = tolerance is None and rays < walker.BATCH
    most = rays if few else walker.batch_rays() if own_only else max(walker.batch_rays(), LOT)
    # two lots, so that two cores end together; not as many as this machine has cores, or the same
    # key would give other paths elsewhere
    at_once = 2 if jax.default_backend() == "cpu" and not few else 1
    walk = partial(
        walker.walk, form=specimen.melanosome_form, incidence=angle, rays=most,
        independent=independent,
    )  # fmt: skip
    more = rays if tolerance is None else FIRST
    if not few and not own_only:
        other, shares = jax.random.fold_in(key, 1), plan.shares
        pilot = walk(plan.layers, key=other, shares=shares, sent=tally.PILOT)
        plan, variance = tally.improve(pilot, plan, medium)
        if tolerance is not None:
            # fewer say little of their own error, and steady each other not at all
            least = tally.ENOUGH * tally.FOLDS / (tally.FOLDS - 1)
            needed = FORESEEN * variance * float(np.max((1.0 - surface) / tolerance)) ** 2
            needed *= 0.9 if needed > MANY_RAYS else 1.0
            more = math.ceil(min(max(needed, least), MOST_RAYS) / GRAIN) * GRAIN

    def lot(part: tuple[int, int]) -> tally.Sums:
        first, many = part
        paths = walk(plan.layers, key=key, first=first, shares=plan.shares, sent=many)
        return tally.gather(
            paths, plan.layers, medium, own_only=own_only, shares=plan.shares, sent=many
        )

    sums, sent = None, 0
    with progress_bar(rays if tolerance is None else None, progress) as bar:
        while more:
            if tolerance is not None:
                more = min(more, MOST_RAYS - sent)
            many = at_once * math.ceil(more / most / at_once)
            each = math.ceil(more / many / GRAIN) * GRAIN
            lots = [(i, min(each, sent + more - i)) for i in range(sent, sent + more, each)]
            for (_, some), found in zip(lots, side_by_side(lot, lots), strict=True):
                sums = tally.add(sums, found)
                bar.update(some)
            sent += more
            assert sums is not None
            total = tally.tell(sums)
            error = (1.0 - surface) * np.asarray(total.standard_error, float)
            more = 0
            if tolerance is not None and np.max(error) > tolerance and sent < MOST_RAYS:
                # less where much is missing, and at last a little more: the error is an estimate,
                # and the last rays of every lot leave lanes idle
                missing = ((np.max(error) / tolerance) ** 2 - 1.0) * sent
                share = 0.9 if missing > MANY_RAYS else 1.05
                more = math.ceil(share * missing / GRAIN) * GRAIN
    inside = (1.0 - surface) * np.asarray(total.mean, float)
    return Curve(
        nm, surface + inside, error, surface, inside, "walker", sent,
        np.asarray(total.effective_rays, float), _short(error, tolerance, sent),
    )  # fmt: skip


def _traced(
    specimen, medium, nm, surface, rays, key, angle, tolerance, independent, progress
) -> Curve:
    melanin = skin.melanin_coefficient(specimen.values, nm)
    inside, at_once, sent = np.zeros(nm.shape), np.zeros(nm.shape), np.zeros(nm.shape, int)
    batch = min(ANALOG_BATCH, rays)
    with progress_bar(rays * len(nm) if tolerance is None else None, progress) as bar:
        for i in range(len(nm)):
            error = math.inf
            while sent[i] < rays if tolerance is None else error > tolerance and sent[i] < 10**7:
                now = batch if tolerance is not None else min(batch, rays - int(sent[i]))
                part = jax.random.fold_in(jax.random.fold_in(key, i), int(sent[i]))
                back, top = analog.trace(
                    medium, melanin, specimen.melanosome_form, i, part, now,
                    incidence=angle, independent=independent,
                )  # fmt: skip
                inside[i], at_once[i], sent[i] = inside[i] + back, at_once[i] + top, sent[i] + now
                # one ray more of each kind keeps the error of a rare outcome above 0
                p = (inside[i] + at_once[i] + 1.0) / (sent[i] + 2.0)
                error = math.sqrt(p * (1.0 - p) / sent[i])
                bar.update(now)
    p = (inside + at_once + 1.0) / (sent + 2.0)
    error = np.sqrt(p * (1.0 - p) / sent)
    return Curve(
        nm, (inside + at_once) / sent, error, at_once / sent, inside / sent, "analog",
        int(sent.sum()), inside, _short(error, tolerance, int(sent.sum())),
    )  # fmt: skip


def _added(specimen, nm, angle, tolerance, independent) -> Curve:
    with jax.enable_x64(True):
        medium = specimen.layers(nm)
        if not independent:
            medium = skin.let_stand(medium, specimen.values, specimen.melanosome_form)
    orders = adding.ORDERS[adding.ORDERS.index(adding.ORDER) - 1 :]
    error = np.full(nm.shape, np.inf)
    before = None
    for order in orders[:2] if tolerance is None else orders:
        found = adding.skin(medium, incidence=angle, order=order)
        reflectance, surface, inside = (np.asarray(part, float) for part in found[:3])
        if before is not None:
            error = np.abs(reflectance - before)
            if tolerance is None or np.max(error) <= tolerance:
                break
        before = reflectance
    note = ""
    if tolerance is not None and np.max(error) > tolerance:
        note = (
            f"the tolerance {tolerance:g} was not reached at order {orders[-1]}: the last step "
            f"changed the reflectance by {np.max(error):.2g}"
        )
    return Curve(
        nm, reflectance, error, surface, inside, "adding", 0, np.full(nm.shape, np.nan), note
    )


def _short(error: np.ndarray, tolerance: float | None, sent: int) -> str:
    if tolerance is None or np.max(error) <= tolerance:
        return ""
    return (
        f"the tolerance {tolerance:g} was not reached with {sent:,} rays: the largest standard "
        f"error is {np.max(error):.2g}"
    )


def progress_bar(total: int | None, progress: bool) -> Any:
    from tqdm import tqdm

    return tqdm(total=total, unit="ray", unit_scale=True, disable=not progress, delay=2)


def _surrogate(specimen: Specimen, nm: np.ndarray, incidence: float, independent: bool) -> Curve:
    from hylios_fit.surrogate import load_surrogate

    surrogate = load_surrogate()
    if incidence != surrogate.incidence_deg or independent:
        raise HyliosError(
            f"the surrogate knows {surrogate.incidence_deg:g} degrees of incidence and particles "
            "that reject each other only: use --method walker"
        )
    reflectance = surrogate.of(specimen, nm)
    member = surrogate.at(specimen.melanosome_form).on(nm)
    error = np.sqrt(np.diag(member.error_covariance(reflectance)))
    surface = np.asarray(member.surface_at(specimen.parameters(member.names)), float)
    return Curve(
        nm, reflectance, error, surface, reflectance - surface, "surrogate", 0,
        np.full(nm.shape, np.nan), "standard_error is the surrogate's held-out error",
    )  # fmt: skip
