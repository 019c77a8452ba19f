"""Where light comes back out, and in which direction: BRDF and BSSRDF of a specimen.

Both are made of the paths that `simulate` makes its reflectance of, told apart by their exits. The
BRDF leaves out the places, the BSSRDF (here its radial profile) the directions. Light that the
surface reflects at once is a quadrature over the same facets that the walk draws.
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from hylios_fit import fresnel, tally, walker
from hylios_fit.errors import HyliosError
from hylios_fit.simulation import ABSORB, check_request, progress_bar
from hylios_fit.skin import Specimen
from hylios_fit.threads import side_by_side

if TYPE_CHECKING:
    import xarray

THETA_EDGES_RAD = np.radians(np.arange(0.0, 91.0, 5.0))
PHI_EDGES_RAD = np.radians(np.arange(0.0, 181.0, 10.0))
RADIUS_EDGES_CM = np.concatenate([[0.0], np.geomspace(1e-3, 3.0, 36)])


@dataclasses.dataclass(frozen=True)
class Brdf:
    """BRDF in 1/sr, as `subsurface` + `surface`; arrays (wavelength, theta, phi).

    theta is the polar angle of the direction towards the viewer, from the normal; phi its azimuth
    from the plane of incidence, 0 on the side of the mirror direction and pi on that of the source.
    Both sides of the plane are alike and were averaged. Values are means over the bins between the
    edges. `standard_error` is that of `subsurface`; `surface` is exact.
    """

    wavelength_nm: np.ndarray
    theta_edges_rad: np.ndarray
    phi_edges_rad: np.ndarray
    subsurface: np.ndarray
    standard_error: np.ndarray
    surface: np.ndarray
    incidence_rad: float
    rays: int

    @property
    def theta_rad(self) -> np.ndarray:
        """Middles of the bins."""
        return 0.5 * (self.theta_edges_rad[1:] + self.theta_edges_rad[:-1])

    @property
    def phi_rad(self) -> np.ndarray:
        """Middles of the bins."""
        return 0.5 * (self.phi_edges_rad[1:] + self.phi_edges_rad[:-1])

    @property
    def value(self) -> np.ndarray:
        """Surface and subsurface together."""
        return self.surface + self.subsurface

    @property
    def projected_solid_angle(self) -> np.ndarray:
        """Integral of cos(theta) over the solid angle of each bin, on both sides of the plane of
        incidence, in sr: (theta, phi)."""
        return _projected(self.theta_edges_rad, self.phi_edges_rad)

    @property
    def reflectance(self) -> np.ndarray:
        """Integral of the BRDF over the bins, weighted by cos(theta): (wavelength,)."""
        return np.sum(self.value * self.projected_solid_angle, axis=(1, 2))

    def to_xarray(self) -> xarray.Dataset:
        """With the coordinates wavelength_nm, theta_rad, phi_rad."""
        import xarray

        names = ("wavelength_nm", "theta_rad", "phi_rad")
        parts = ("value", "subsurface", "standard_error", "surface")
        return xarray.Dataset(
            {part: (names, getattr(self, part), {"units": "1/sr"}) for part in parts},
            {name: getattr(self, name) for name in names},
            {"incidence_rad": self.incidence_rad, "rays": self.rays},
        )

    def rows(self) -> tuple[tuple[str, ...], Any]:
        """Header and rows of the CSV file, angles in degrees."""
        header = (
            "wavelength_nm", "theta_deg", "phi_deg", "brdf_per_sr", "standard_error", "surface",
            "subsurface",
        )  # fmt: skip
        values = (self.value, self.standard_error, self.surface, self.subsurface)
        axes = (self.wavelength_nm, np.degrees(self.theta_rad), np.degrees(self.phi_rad))
        return header, _long(axes, values)


@dataclasses.dataclass(frozen=True)
class Bssrdf:
    """Radial profile of the light that comes back out, in 1/cm^2; arrays (wavelength, radius).

    The share of the incident light that leaves at a distance from where it met the skin, by area,
    in all directions together. Values are means over the rings between the edges. `surface` is the
    share that the surface reflects at once, at no distance, and `beyond` the share that leaves
    farther out than the last edge: (wavelength,).
    """

    wavelength_nm: np.ndarray
    radius_edges_cm: np.ndarray
    value: np.ndarray
    standard_error: np.ndarray
    surface: np.ndarray
    beyond: np.ndarray
    incidence_rad: float
    rays: int

    @property
    def radius_cm(self) -> np.ndarray:
        """Middles of the rings."""
        return 0.5 * (self.radius_edges_cm[1:] + self.radius_edges_cm[:-1])

    @property
    def area_cm2(self) -> np.ndarray:
        """Area of each ring."""
        return math.pi * np.diff(self.radius_edges_cm**2)

    @property
    def reflectance(self) -> np.ndarray:
        """Integral over the plane, with `surface` and `beyond`: (wavelength,)."""
        return self.value @ self.area_cm2 + self.surface + self.beyond

    def to_xarray(self) -> xarray.Dataset:
        """With the coordinates wavelength_nm, radius_cm."""
        import xarray

        names = ("wavelength_nm", "radius_cm")
        parts = ("value", "standard_error")
        return xarray.Dataset(
            {part: (names, getattr(self, part), {"units": "1/cm2"}) for part in parts}
            | {part: (names[:1], getattr(self, part)) for part in ("surface", "beyond")},
            {name: getattr(self, name) for name in names},
            {"incidence_rad": self.incidence_rad, "rays": self.rays},
        )

    def rows(self) -> tuple[tuple[str, ...], Any]:
        """Header and rows of the CSV file; what leaves beyond the last ring has none."""
        header = ("wavelength_nm", "radius_cm", "bssrdf_per_cm2", "standard_error")
        axes = (self.wavelength_nm, self.radius_cm)
        return header, _long(axes, (self.value, self.standard_error))


def simulate_brdf(
    specimen: Specimen,
    wavelengths: Any,
    *,
    rays: int = 100_000,
    key: jax.Array | None = None,
    incidence: float = 8.0,
    smooth_surface: bool = False,
    independent_particles: bool = False,
    theta_edges_rad: Any = THETA_EDGES_RAD,
    phi_edges_rad: Any = PHI_EDGES_RAD,
    progress: bool = False,
) -> Brdf:
    """BRDF of `specimen` at `wavelengths` (nm) for light from `incidence` (degrees, 0 to 85).

    `rays` are spread over all wavelengths. Edges of the bins rise, theta's within 0 to pi/2 and
    phi's within 0 to pi. Raises `HyliosError` for what cannot be.
    """
    theta = _edges("theta_edges_rad", theta_edges_rad, math.pi / 2)
    phi = _edges("phi_edges_rad", phi_edges_rad, math.pi)
    columns = (len(theta) - 1) * (len(phi) - 1)

    def bins(exits: walker.Exits) -> np.ndarray:
        x, y, z = np.asarray(exits.direction, float).T
        # a direction at the very edge of the hemisphere belongs to the last bin
        up = np.clip(-z, 0.0, 1.0)
        t = _bin(theta, np.arctan2(np.hypot(x, y), up))
        p = _bin(phi, np.arctan2(np.abs(y), x))
        return np.where((t >= 0) & (p >= 0), t * (len(phi) - 1) + p, -1)

    found = _walk(
        specimen, wavelengths, rays, key, incidence, smooth_surface, independent_particles,
        progress, bins, columns,
    )  # fmt: skip
    shape = (len(found.nm), len(theta) - 1, len(phi) - 1)
    per_bin = _projected(theta, phi)
    surface = np.stack(
        [_surface_bins(found.angle, n, found.roughness, theta, phi) for n in found.index]
    )
    return Brdf(
        found.nm, theta, phi,
        found.share.reshape(shape) / per_bin,
        found.error.reshape(shape) / per_bin,
        surface / per_bin,
        found.angle, found.rays,
    )  # fmt: skip


def simulate_bssrdf(
    specimen: Specimen,
    wavelengths: Any,
    *,
    rays: int = 100_000,
    key: jax.Array | None = None,
    incidence: float = 8.0,
    smooth_surface: bool = False,
    independent_particles: bool = False,
    radius_edges_cm: Any = RADIUS_EDGES_CM,
    progress: bool = False,
) -> Bssrdf:
    """Radial BSSRDF of `specimen` at `wavelengths` (nm) for light from `incidence` (degrees).

    Edges of the rings rise from 0. Raises `HyliosError` for what cannot be.
    """
    radius = _edges("radius_edges_cm", radius_edges_cm, math.inf)
    if radius[0] != 0:
        raise HyliosError(f"radius_edges_cm: the first edge is 0, got {radius[0]:g}")

    def bins(exits: walker.Exits) -> np.ndarray:
        place = np.hypot(*np.asarray(exits.place, float).T)
        return np.clip(np.searchsorted(radius, place, side="right") - 1, -1, len(radius) - 1)

    found = _walk(
        specimen, wavelengths, rays, key, incidence, smooth_surface, independent_particles,
        progress, bins, len(radius),
    )  # fmt: skip
    area = math.pi * np.diff(radius**2)
    return Bssrdf(
        found.nm, radius,
        found.share[:, :-1] / area,
        found.error[:, :-1] / area,
        found.surface, found.share[:, -1],
        found.angle, found.rays,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class _Found:
    """Shares of the incident light by bin, (wavelength, bin), and what they came from."""

    nm: np.ndarray
    share: np.ndarray
    error: np.ndarray
    surface: np.ndarray
    index: np.ndarray
    roughness: float
    angle: float
    rays: int


def _walk(
    specimen, wavelengths, rays, key, incidence, smooth, independent, progress, bins, columns
) -> _Found:
    nm = np.atleast_1d(np.asarray(wavelengths, float))
    check_request(nm, "walker", rays, incidence, None)
    if key is None:
        raise HyliosError("a walk draws random numbers: give key=jax.random.key(seed)")
    if smooth:
        specimen = specimen.replace(roughness=0.0)
    medium = specimen.layers(nm)
    plan, own_only = walker.plan_or_own(medium, ABSORB)
    angle = math.radians(incidence)
    batch = min(walker.batch_rays(), rays)

    def lot(first: int) -> tuple[np.ndarray, ...]:
        paths, exits = walker.walk_out(
            plan.layers, specimen.melanosome_form, key, incidence=angle, first=first, rays=batch,
            independent=independent, shares=plan.shares,
        )  # fmt: skip
        into = jnp.asarray(bins(exits), jnp.int32)
        sums = tally.collect_bins(paths, into, columns, plan, medium, own_only)
        return tuple(np.asarray(part, float) for part in sums)

    total, sent = None, 0
    with progress_bar(rays, progress) as bar:
        for found in side_by_side(lot, range(0, rays, batch)):
            total = found if total is None else tuple(map(np.add, total, found))
            sent += batch
            bar.update(batch)
    assert total is not None
    index = np.asarray(medium.index, float)[0]
    surface = fresnel.surface_reflectances(angle, index, specimen.roughness)
    entered = (1.0 - surface)[:, None]
    mean, square = total[0].T / sent, total[1].T / sent
    error = np.sqrt(np.maximum(square - mean**2, 0.0) / sent)
    return _Found(
        nm, entered * mean, entered * error, surface, index, specimen.roughness, angle, sent
    )


def _edges(name: str, values: Any, most: float) -> np.ndarray:
    edges = np.asarray(values, float)
    good = edges.ndim == 1 and edges.size >= 2 and np.all(np.isfinite(edges))
    if not (good and np.all(np.diff(edges) > 0) and edges[0] >= 0 and edges[-1] <= most + 1e-9):
        within = "from 0" if math.isinf(most) else f"within 0 to {most:.6g}"
        raise HyliosError(f"{name}: expected two or more rising edges {within}, got {values!r}")
    return edges


def _bin(edges: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Place of each value between the edges, the last one counted in; -1 outside."""
    place = np.searchsorted(edges, values, side="right") - 1
    last = len(edges) - 2
    place = np.where((place > last) & (values <= edges[-1] * (1 + 1e-6)), last, place)
    return np.where(place > last, -1, place)


def _projected(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    # both sides of the plane of incidence
    return np.outer(0.5 * np.diff(np.sin(theta) ** 2), 2.0 * np.diff(phi))


def _surface_bins(
    angle: float, index: float, roughness: float, theta: np.ndarray, phi: np.ndarray
) -> np.ndarray:
    """Share of the light that the surface reflects at once into each bin: (theta, phi).

    The quadrature of `fresnel.surface_reflectance`, each facet's light put where it goes.
    """
    size = 1 if roughness == 0 else 2048
    table = fresnel.facet_table(roughness)
    cos_s = np.interp((np.arange(size) + 0.5) / size, np.linspace(0, 1, len(table)), table)
    azimuth = np.pi * (np.arange(720) + 0.5) / 720
    cos_s, azimuth = (part.ravel() for part in np.meshgrid(cos_s, azimuth, indexing="ij"))
    found = fresnel.facet_outcomes(cos_s, np.cos(azimuth), math.sin(angle), 1.0, index)
    share = found.reflected
    across = 2.0 * np.clip(found.cos_i, 0.0, 1.0) * np.sqrt(1.0 - cos_s**2)
    x, y = math.sin(angle) + across * np.cos(azimuth), across * np.sin(azimuth)
    t = _bin(theta, np.arctan2(np.hypot(x, y), np.maximum(found.up, 0.0)))
    p = _bin(phi, np.arctan2(np.abs(y), x))
    place = np.where((t >= 0) & (p >= 0), t * (len(phi) - 1) + p, -1)
    shape = (len(theta) - 1, len(phi) - 1)
    inside = place >= 0
    sums = np.bincount(place[inside], share[inside], minlength=math.prod(shape)).reshape(shape)
    total = fresnel.surface_reflectance(angle, 1.0, index, roughness)
    return sums * (total / max(float(share.sum()), 1e-30))


def _long(axes: tuple[np.ndarray, ...], values: tuple[np.ndarray, ...]) -> Any:
    """One row for each element of arrays with these axes."""
    grid = np.meshgrid(*axes, indexing="ij")
    for row in zip(*(part.ravel() for part in (*grid, *values)), strict=True):
        yield [f"{value:.7g}" for value in row]
