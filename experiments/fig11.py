"""Fig. 11: light of 302 nm that has crossed the epidermis of S2, by angle."""

from typing import Any

import jax
import numpy as np

from experiments import _paper, _shared
from hylios_fit import fresnel, walker
from hylios_fit.skin import Specimen

NM = 302.0
RAYS = 1_048_576
STEP_DEG = 2.5
SAYS = (
    "epidermis scatters strongly forward, most of all in the ultraviolet, and the model follows "
    "the distribution that Bruls and van der Leun measured in 1984 (the plot only, no numbers)."
)


def run(seed: int = 0, rays: int = RAYS) -> dict[str, Any]:
    """Transmitted light by polar angle, per solid angle and incident ray."""
    skin = Specimen.preset("S2")
    medium = skin.layers(np.array([NM]))
    found, hits = [], []
    batch = min(walker.batch_rays(), rays)
    for first in range(0, rays, batch):
        paths, exits = walker.walk_out(
            medium, skin.melanosome_form, jax.random.key(seed),
            incidence=0.0, first=first, rays=batch, last="basale",
        )  # fmt: skip
        through = np.asarray(paths.escaped) < 0
        found.append(np.asarray(exits.direction[:, 2])[through])
        hits.append(np.asarray(paths.sums[:, walker.HITS]).sum(axis=1)[through])
    cosine, hits = np.concatenate(found), np.concatenate(hits)
    # rays that the surface reflects at once are not walked
    entered = 1.0 - fresnel.surface_reflectance(0.0, 1.0, skin.index_corneum, skin.roughness)
    angle = np.rad2deg(np.arccos(np.clip(cosine, 0.0, 1.0)))
    edges = np.arange(0.0, 90.0 + STEP_DEG, STEP_DEG)
    count, _ = np.histogram(angle, edges)
    solid = -2 * np.pi * np.diff(np.cos(np.deg2rad(edges)))
    scale = entered / rays / solid
    within = np.mean(angle < 20)
    return {
        "paper_says": SAYS,
        "we_differ": f"{100 * within:.0f} % of what crosses stays within 20°, at normal incidence, "
        "as it enters the papillary dermis; the measured data are not at hand",
        "specimen": "S2",
        "wavelength_nm": NM,
        "rays": rays,
        "index_below": skin.index_papillary,
        "angle_deg": (0.5 * (edges[:-1] + edges[1:])).tolist(),
        "intensity_per_sr": _shared.significant(count * scale),
        "standard_error": _shared.significant(np.sqrt(count * (1 - count / rays)) * scale),
        "transmitted": _shared.significant(entered * cosine.size / rays),
        "share_not_hit": _shared.significant(np.mean(hits == 0)),
        "share_within_deg": {
            str(limit): _shared.significant(np.mean(angle < limit), 3)
            for limit in (5, 10, 20, 30, 45)
        },
        "mean_cosine": _shared.significant(cosine.mean()),
    }


def draw(result: dict[str, Any], path: Any) -> None:
    """Intensity by angle, and its orthographic projection as in the paper's insets."""
    from matplotlib.colors import LogNorm

    figure = _shared.figure(10.5, 4.8)
    curve = figure.add_subplot(1, 2, 1)
    angle = np.array(result["angle_deg"])
    value, error = np.array(result["intensity_per_sr"]), np.array(result["standard_error"])
    curve.errorbar(angle, value / value[0], yerr=error / value[0], color=_shared.COLOURS[0], lw=1.4)
    curve.set_yscale("log")
    title = (
        f"{100 * result['transmitted']:.2g} % transmitted, "
        f"{100 * result['share_within_deg']['20']:.0f} % of it within 20°"
    )
    _shared.tidy(curve, "polar angle (degrees)", "intensity per solid angle, 1 forward", title)
    disk = figure.add_subplot(1, 2, 2)
    x = np.linspace(-1, 1, 401)
    radius = np.hypot(*np.meshgrid(x, x))
    polar = np.rad2deg(np.arcsin(np.minimum(radius, 1)))
    seen = np.where(radius < 1, np.interp(polar, angle, value / value[0]), np.nan)
    image = disk.imshow(seen, extent=(-1, 1, -1, 1), cmap="magma", norm=LogNorm(1e-4, 1))
    disk.set_axis_off()
    disk.set_title("orthographic projection, sin(angle) from the centre", fontsize=10)
    figure.colorbar(image, ax=disk, label="intensity per solid angle, 1 forward", shrink=0.8)
    _paper.note(figure, result)
    _shared.save_figure(figure, path)
