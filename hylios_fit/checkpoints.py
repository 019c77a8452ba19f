"""Steps of a long computation, kept beside its output until that is written.

Killed at any moment, the computation goes on after the last step that is here. What a step gives
is arrays by name; what the computation follows from stands in `about.json`.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hylios_fit.errors import HyliosError
from hylios_fit.files import atomic_text, load_arrays, save_arrays

ABOUT = "about.json"


class Step(NamedTuple):
    """One step, done or not: the file of its arrays."""

    path: Path

    def load(self) -> dict[str, np.ndarray] | None:
        """What was saved last, or None. Raises `HyliosError` if it is damaged."""
        try:
            return load_arrays(self.path) if self.path.exists() else None
        except HyliosError as error:
            raise HyliosError(f"{error}: remove it, and this step is done again") from error

    def save(self, **arrays: Any) -> None:
        """In the place of what was there, at once. Raises `HyliosError` if that cannot be."""
        save_arrays(self.path, arrays)

    def once(self, make: Callable[[], Mapping[str, Any]]) -> dict[str, np.ndarray]:
        """The arrays by name, made and saved if they are not there."""
        found = self.load()
        if found is None:
            found = {name: np.asarray(array) for name, array in make().items()}
            self.save(**found)
        return found


class Checkpoints:
    """The steps under a folder, which is made if need be and is of this computation alone.

    Args:
        of: what the computation follows from, as JSON has it: steps of two do not mix.

    Raises:
        HyliosError: if the folder is another computation's, or cannot be read or written.
    """

    def __init__(self, folder: str | Path, of: dict[str, Any]):
        self.folder = Path(folder)
        about, asked = self.folder / ABOUT, json.loads(json.dumps(of))
        if not about.exists() and not self.begun():
            with atomic_text(about) as file:
                json.dump(asked, file, indent=1)
            return
        try:
            found = dict(json.loads(about.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError) as error:
            raise HyliosError(
                f"{about} cannot be read ({error}): remove {self.folder} to begin anew"
            ) from error
        other = sorted(name for name in {*asked, *found} if asked.get(name) != found.get(name))
        if other:
            raise HyliosError(
                f"{self.folder} holds the beginning of another one, with other {', '.join(other)}: "
                "finish that, or remove the folder to begin anew"
            )

    def step(self, name: str) -> Step:
        return Step(self.folder / f"{name}.npz")

    def begun(self) -> bool:
        """Whether any step was saved."""
        return any(self.folder.glob("*.npz"))

    def remove(self) -> None:
        """All of it, once the output is written."""
        done = self.folder.with_name(f".{self.folder.name}.done")
        shutil.rmtree(done, ignore_errors=True)  # of one that was killed here
        self.folder.replace(done)  # at once: no step is left without what it belongs to
        shutil.rmtree(done, ignore_errors=True)
