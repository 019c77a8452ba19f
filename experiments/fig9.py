"""Figs. 9, 10 and 19: swatches under D65 of S1, S2, S3, and of S3 without melanin or blood."""

from typing import Any

from experiments import _paper, _shared
from experiments.fig8 import INCIDENCE, MEASURED
from hylios_fit.appearance import Appearance, appearance, colour_difference
from hylios_fit.sensitivity import REMOVALS
from hylios_fit.skin import Specimen
from hylios_fit.units import wavelengths

SAYS = (
    "the swatches of Figs. 9 and 10 are all believable skin, model beside measured; in Fig. 19 the "
    "skin is lighter without melanin and without blood (images, no numbers)."
)


def run() -> dict[str, Any]:
    """Colours of the curves, 400 to 700 nm in 5 nm, CIE 1931 observer."""
    nm = wavelengths(400.0, 700.0, 5.0)
    rows: dict[str, list[dict[str, Any]]] = {}
    for figure, name in (("Fig. 9", "S1"), ("Fig. 10", "S2")):
        model = _paper.reflectance(Specimen.preset(name), nm, INCIDENCE)
        measured = _paper.ncsu(MEASURED[name], nm)
        seen = {f"{name} at 45°": model}
        if measured is not None:
            seen[f"measured, NCSU {MEASURED[name]}"] = measured
        rows[figure] = _row({label: appearance(nm, curve) for label, curve in seen.items()}, -1)
    skin = Specimen.preset("S3")
    seen = {"S3": appearance(nm, _paper.reflectance(skin, nm))}
    for material in ("melanin", "blood"):
        without = skin.replace(**dict.fromkeys(REMOVALS[material], 0.0))
        seen[f"S3, no {material}"] = appearance(nm, _paper.reflectance(without, nm))
    rows["Fig. 19"] = _row(seen, 0)
    away = ", ".join(
        f"{row[0]['label']} {row[0]['ciede2000']:.1f}"
        for row in rows.values()
        if row[0]["ciede2000"]
    )
    told = f"CIEDE2000 (in each row from its measured or complete skin): {away or 'not at hand'}"
    return {
        "paper_says": SAYS,
        "we_differ": told,
        "illuminant": "D65",
        "observer": "CIE 1931, 2 degrees",
        "rows": rows,
    }


def _row(seen: dict[str, Appearance | None], reference: int) -> list[dict[str, Any]]:
    base = list(seen.values())[reference]
    found = []
    for label, colour in seen.items():
        assert colour is not None
        found.append(
            {
                "label": label,
                "srgb": colour.hex,
                "lab": _shared.significant(colour.lab),
                "ita_deg": _shared.significant(colour.ita, 3),
                "ciede2000": _shared.significant(colour_difference(colour, base), 3),
            }
        )
    return found


def draw(result: dict[str, Any], path: Any) -> None:
    """A row of swatches for each figure of the paper."""
    figure = _shared.figure(8.0, 7.2)
    grid = figure.subplots(len(result["rows"]), 3)
    for panels, (name, row) in zip(grid, result["rows"].items(), strict=True):
        for panel in panels:
            panel.axis("off")
        panels[0].set_title(name, fontsize=10, loc="left")
        for panel, own in zip(panels, row, strict=False):
            panel.add_patch(_square(own["srgb"]))
            lightness, a, b = own["lab"]
            text = f"{own['label']}\n{own['srgb']}, L* {lightness:.0f} a* {a:.0f} b* {b:.0f}\n"
            text += f"ΔE00 {own['ciede2000']:.1f}"
            panel.text(0.5, -0.04, text, ha="center", va="top", fontsize=8)
            panel.set_xlim(0, 1)
            panel.set_ylim(-0.45, 1)
    _paper.note(figure, result)
    _shared.save_figure(figure, path)


def _square(colour: str) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((0, 0), 1, 1, color=colour)
