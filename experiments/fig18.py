"""Fig. 18: S3 without melanin and without blood."""

from typing import Any

from experiments import _paper

SAYS = (
    "removing either raises the visible reflectance, without blood the omega shape of 500 "
    "to 600 nm vanishes, and both matter outside the visible."
)


def run() -> dict[str, Any]:
    """Curves in the visible and indices by domain."""
    return _paper.pair(("melanin", "blood"), "Vis", SAYS)


def draw(result: dict[str, Any], path: Any) -> None:
    """Curves and bars beside Table II."""
    _paper.draw_pair(result, path)
