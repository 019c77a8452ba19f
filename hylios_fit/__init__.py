"""From a measured skin spectrum to melanin, blood and water, by the HyLIoS model of light in skin.

Data flows one way through the modules; each imports only from those above it:

    errors       the one exception for unusable input
    units        the unit system and its conversions at the edges
    files        written whole or not at all
    checkpoints  steps of a long computation, kept until its output is written
    threads      linear algebra held to one thread
    precision    products of matrices in full precision on every device
    counter      random words from a counter
    datasets     find, read and check what is in data/
    absorbers    specific absorption spectra
    fresnel      interfaces: reflectance, refraction, critical angle
    scattering   each scattering law: its density and its sampler
    melanosome   one particle or complex: attenuation, share absorbed per hit
    skin         Specimen (parameters, presets) -> coefficients by layer and wavelength
    tissue       plain layers with Henyey-Greenstein scattering, and their own fast walk
    analog       the paper's walk to the letter: one ray, one wavelength
    walker       the weighted walk: one set of paths for many wavelengths and contents
    tally        paths -> reflectance with its standard error
    streams      directions of the deterministic solver, and what interfaces do to them
    adding       layers -> reflectance by adding and doubling, without noise
    table        design of parameters, simulation, storing, resuming
    surrogate    parameters -> spectrum; knows its range and its own error
    simulation   Specimen -> Curve, by any method
    exits        Specimen -> BRDF and BSSRDF: where and in which direction light leaves
    sensitivity  how much each material matters: the mean sensitivity index
    spectra      measured spectra: read, checked, written
    instrument   bands, specular in or out, noise
    statevector  free parameters: names, order, bounds, priors, transforms
    planning     what a scene needs: the rest is dropped, the cheapest method taken
    perceptron   the regression that training fits, and how it is fitted
    training     table -> surrogate, its error measured on fresh specimens
    results      Outcome, Fit, Posterior
    inversion    spectra -> fits
    sampling     fit -> posterior
    appearance   swatches and colour differences
    report       tables, figures, the page
    cli          the command line

The public names below are loaded when first used: importing the package opens no file,
starts no thread and imports no other package.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any

__version__ = "0.1.0"

_MODULE_OF = {
    "HyliosError": "errors",
    "wavelengths": "units",
    "Specimen": "skin",
    "Tissue": "tissue",
    "Curve": "simulation",
    "simulate": "simulation",
    "Brdf": "exits",
    "simulate_brdf": "exits",
    "Bssrdf": "exits",
    "simulate_bssrdf": "exits",
    "Sensitivity": "sensitivity",
    "sensitivity": "sensitivity",
    "Surrogate": "surrogate",
    "load_surrogate": "surrogate",
    "Spectra": "spectra",
    "read_spectra": "spectra",
    "as_spectra": "spectra",
    "Scene": "planning",
    "Plan": "planning",
    "plan": "planning",
    "Outcome": "results",
    "Estimate": "results",
    "Fit": "results",
    "Posterior": "results",
    "fit": "inversion",
    "fit_many": "inversion",
    "sample": "sampling",
    "report": "report",
}

__all__ = [*_MODULE_OF]  # pyright: ignore[reportUnsupportedDunderAll]


class _Package(ModuleType):
    def __setattr__(self, name: str, value: object) -> None:
        # Importing a submodule binds it to its name here; where a public function has the
        # same name (`report`), the function stays what users see, in whatever order they import.
        if isinstance(value, ModuleType) and _MODULE_OF.get(name) == name:
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_MODULE_OF])
