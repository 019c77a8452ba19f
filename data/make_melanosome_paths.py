"""Write melanosome_paths.csv: how long light stays inside one melanosome.

Traces rays with hylios_fit.melanosome.trace_inside (no absorption), for the light and the dark
spheroid and for index ratios melanin over surroundings, and keeps the distribution of the path
length as weights on fixed, geometrically spaced lengths; each ray's weight is shared by its two
neighbours so that the mean path stays exact.

Run from the repository: python data/make_melanosome_paths.py
"""

import csv
import pathlib
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from hylios_fit import melanosome

RAYS = 1_000_000
RATIOS = np.round(np.arange(1.0, 1.401, 0.05), 2)
LENGTHS = np.concatenate([[0.0], np.geomspace(0.02, 400.0, 200)])
SEED = 20150413


@partial(jax.jit, static_argnums=3)
def trace(key, aspect, ratio, rays):
    def one(k):
        none = jnp.float32(1e-12)
        return melanosome.trace_inside(k, jnp.float32(1.0), aspect, none, ratio)[1]

    return jax.lax.map(one, jax.random.split(key, rays), batch_size=50_000)


def main() -> None:
    out = pathlib.Path(__file__).parent / melanosome.PATHS_FILE
    with out.open("w", encoding="utf-8", newline="") as file:
        file.write(
            "# Path length of light inside one melanosome, in units of its semi-minor axis.\n"
        )
        file.write(f"# Written by data/make_melanosome_paths.py: {RAYS} rays each, seed {SEED}.\n")
        file.write("# Model: Chen et al. 2015 (doi 10.1145/2701416), section 4.2.1.\n")
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["melanosome", "index_ratio", "path_over_a", "weight"])
        for name, form in (("light", "complex"), ("dark", "dispersed")):
            a, b = melanosome.semi_axes(form)
            for i, ratio in enumerate(RATIOS):
                key = jax.random.fold_in(jax.random.key(SEED), 100 * (name == "dark") + i)
                path = np.asarray(trace(key, jnp.float32(b / a), jnp.float32(ratio), RAYS), float)
                path = np.clip(path, 0.0, LENGTHS[-1])
                upper = np.clip(np.searchsorted(LENGTHS, path, side="right"), 1, len(LENGTHS) - 1)
                part = (path - LENGTHS[upper - 1]) / (LENGTHS[upper] - LENGTHS[upper - 1])
                weight = np.bincount(upper - 1, 1.0 - part, len(LENGTHS))
                weight += np.bincount(upper, part, len(LENGTHS))
                for length, w in zip(LENGTHS, weight / RAYS, strict=True):
                    writer.writerow([name, f"{ratio:.2f}", f"{length:.6g}", f"{w:.8g}"])
                print(name, ratio, "mean path / a:", path.mean(), "max", path.max())


if __name__ == "__main__":
    main()
