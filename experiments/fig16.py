"""Fig. 16: water loss in the infrared, as curves."""

from typing import Any

import numpy as np

from experiments import _paper, _shared
from experiments.fig15 import specimen
from hylios_fit.units import wavelengths

REDUCTIONS = (0, 20, 40)  # % of the water content of every layer
SHOWN_NM = 1650.0
SAYS = (
    "less water in the tissues raises the infrared reflectance, the more, the more is lost (images "
    "at 1650 nm, no numbers)."
)


def run() -> dict[str, Any]:
    """Reflectance at 8 degrees, 700 to 2500 nm."""
    nm = wavelengths(700.0, 2500.0, 5.0)
    skin = specimen(1.5)
    curves = {
        loss: _paper.reflectance(skin.replace(water=1.0 - loss / 100), nm) for loss in REDUCTIONS
    }
    at = int(np.argmin(np.abs(nm - SHOWN_NM)))
    rise = ", ".join(f"{curves[loss][at] - curves[0][at]:+.3f}" for loss in REDUCTIONS[1:])
    return {
        "paper_says": SAYS,
        "we_differ": f"as there: {rise} at 1650 nm with 20 and 40 % less, on light skin as in "
        "Fig. 15 with 1.5 % of melanin",
        "wavelength_nm": nm.tolist(),
        "curves": {str(loss): _shared.significant(curve) for loss, curve in curves.items()},
        "at_1650_nm": {str(loss): _shared.significant(c[at]) for loss, c in curves.items()},
        "mean": {str(loss): _shared.significant(c.mean()) for loss, c in curves.items()},
    }


def draw(result: dict[str, Any], path: Any) -> None:
    """The curves, and the wavelength of the paper's images."""
    figure = _shared.figure(8.0, 5.0)
    axes = figure.subplots()
    for i, (loss, curve) in enumerate(result["curves"].items()):
        label = f"{loss} % of the water lost: {result['at_1650_nm'][loss]:.3f} at 1650 nm"
        axes.plot(result["wavelength_nm"], curve, color=_shared.COLOURS[i], label=label)
    axes.axvline(SHOWN_NM, color="black", lw=0.8, alpha=0.5)
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=8)
    _shared.tidy(axes, "wavelength (nm)", "reflectance at 8° (specular included)")
    _paper.note(figure, result)
    _shared.save_figure(figure, path)
