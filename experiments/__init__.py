"""Evidence for the claims in README.md: one module for each figure or table.

A module here that is an experiment has

    run(...) -> dict                  plain numbers, strings, lists and dicts
    draw(result: dict, path) -> None  the figure, from the dict alone

`python -m experiments NAME` runs it, saves `results/NAME.json` with seed, versions, device and
commit beside the result, and draws `results/NAME.png` from that file.
"""
