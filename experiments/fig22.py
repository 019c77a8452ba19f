"""Fig. 22: S3 without water and without lipids."""

from typing import Any

from experiments import _paper

SAYS = (
    "both act in the infrared, water far more; in the ultraviolet and visible they are "
    "comparably negligible."
)


def run() -> dict[str, Any]:
    """Curves in the infrared and indices by domain."""
    return _paper.pair(("water", "lipids"), "IR", SAYS)


def draw(result: dict[str, Any], path: Any) -> None:
    """Curves and bars beside Table II."""
    _paper.draw_pair(result, path)
