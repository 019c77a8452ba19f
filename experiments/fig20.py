"""Fig. 20: S3 without DNA and without keratin."""

from typing import Any

from experiments import _paper

SAYS = (
    "removing DNA or keratin raises the ultraviolet reflectance, DNA the more; in other domains "
    "the effect is smaller."
)


def run() -> dict[str, Any]:
    """Curves in the ultraviolet and indices by domain."""
    return _paper.pair(("DNA", "keratin"), "UV", SAYS)


def draw(result: dict[str, Any], path: Any) -> None:
    """Curves and bars beside Table II."""
    _paper.draw_pair(result, path)
