"""Fig. 14: where S1 scatters light of 365 and of 1100 nm, at 45 degrees of incidence."""

from typing import Any

import jax
import numpy as np

from experiments import _paper, _shared
from hylios_fit.skin import Specimen

SHOWN_NM = (365.0, 1100.0)
INCIDENCE = 45.0
RAYS = 524_288
COLOURS = (*_shared.COLOURS[:2], "black")
SAYS = (
    "light of 1100 nm is reflected more diffusely than that of 365 nm, as light from below the "
    "surface (R_d) prevails over that of the surface (R_s) (the plot only, no numbers)."
)


def run(seed: int = 0, rays: int = RAYS) -> dict[str, Any]:
    """BRDF in the plane of incidence at both wavelengths."""
    skin = Specimen.preset("S1")
    keys = jax.random.split(jax.random.key(seed), len(SHOWN_NM))
    found = {
        f"{nm:g}": _paper.in_plane(skin, np.array([nm]), INCIDENCE, rays, key)
        for nm, key in zip(SHOWN_NM, keys, strict=True)
    }
    shares = {
        nm: own["subsurface_reflectance"]
        / (own["subsurface_reflectance"] + own["surface_reflectance"])
        for nm, own in found.items()
    }
    told = ", ".join(f"{100 * share:.0f} % at {nm} nm" for nm, share in shares.items())
    return {
        "paper_says": SAYS,
        "we_differ": f"as there: R_d is {told} of what is reflected. Drawn: BRDF times the cosine "
        "of the angle of reflection, over its largest value; arrow: incident light",
        "specimen": "S1",
        "incidence_deg": INCIDENCE,
        "rays": rays,
        "around_deg": _paper.AROUND_DEG,
        "at_nm": found,
    }


def draw(result: dict[str, Any], path: Any) -> None:
    """A polar plot for each wavelength."""
    figure = _shared.figure(11.0, 4.0)
    panels = figure.subplots(1, 2)
    for panel, (nm, own) in zip(panels, result["at_nm"].items(), strict=True):
        angle = np.deg2rad(own["angle_deg"])
        surface, below = (np.array(own[name]) * np.cos(angle) for name in ("surface", "subsurface"))
        largest = (surface + below).max()
        parts = {"R_s": surface, "R_d": below, "R_t": surface + below}
        for (label, value), colour in zip(parts.items(), COLOURS, strict=True):
            x, y = np.sin(angle) * value / largest, np.cos(angle) * value / largest
            panel.plot(x, y, color=colour, lw=1.5, label=label)
        circle = np.linspace(-np.pi / 2, np.pi / 2, 181)
        for radius in (0.25, 0.5, 0.75, 1.0):
            panel.plot(radius * np.sin(circle), radius * np.cos(circle), color="black", alpha=0.15)
        for degrees in range(-90, 91, 30):
            x, y = np.sin(np.deg2rad(degrees)), np.cos(np.deg2rad(degrees))
            panel.plot([0, x], [0, y], color="black", alpha=0.15)
            panel.text(1.08 * x, 1.08 * y, f"{degrees}°", ha="center", va="center", fontsize=8)
        incident = np.deg2rad(-result["incidence_deg"])
        panel.annotate(
            "", (0, 0), (np.sin(incident), np.cos(incident)),
            arrowprops={"arrowstyle": "->", "color": "#777777"},
        )  # fmt: skip
        panel.set_aspect("equal")
        panel.set_axis_off()
        panel.set_ylim(-0.2, 1.2)
        panel.legend(fontsize=8, loc="lower center", ncols=3)
        panel.set_title(
            f"{nm} nm: {own['surface_reflectance']:.3f} of the light from the surface, "
            f"{own['subsurface_reflectance']:.3f} from below", fontsize=10,
        )  # fmt: skip
    _paper.note(figure, result)
    _shared.save_figure(figure, path)
