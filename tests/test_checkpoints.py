"""Steps of long computations: kept, found again, not mixed, and removed."""

import numpy as np
import pytest

from hylios_fit.checkpoints import Checkpoints
from hylios_fit.errors import HyliosError

OF = {"seed": 0, "sizes": (3, 4)}


def test_a_step_is_done_once(tmp_path):
    def make():
        made.append(1)
        return {"a": np.arange(3), "b": [0.5]}

    made = []
    for _ in range(2):
        step = Checkpoints(tmp_path / "folder", OF).step("one")
        found = step.once(make)
        np.testing.assert_array_equal(found["a"], [0, 1, 2])
        np.testing.assert_array_equal(found["b"], [0.5])
    assert made == [1]
    assert Checkpoints(tmp_path / "folder", OF).step("other").load() is None


def test_what_is_saved_again_replaces_what_was_there(tmp_path):
    step = Checkpoints(tmp_path, OF).step("one")
    step.save(a=np.zeros(2))
    step.save(b=np.ones(3))
    assert list(step.load()) == ["b"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["about.json", "one.npz"]


def test_another_computation_is_refused_and_both_stay(tmp_path):
    Checkpoints(tmp_path, OF).step("one").save(a=np.zeros(2))
    with pytest.raises(HyliosError, match=r"beginning of another one, with other seed: .* remove"):
        Checkpoints(tmp_path, {**OF, "seed": 1})
    assert Checkpoints(tmp_path, OF).step("one").load() is not None


def test_damaged_files_are_errors(tmp_path):
    step = Checkpoints(tmp_path, OF).step("one")
    step.save(a=np.zeros(2))
    step.path.write_bytes(step.path.read_bytes()[:-30])
    with pytest.raises(HyliosError, match=r"one\.npz: .*damaged .*: remove it"):
        step.load()
    for content in ("{", "[1]"):
        (tmp_path / "about.json").write_text(content)
        with pytest.raises(HyliosError, match=r"about\.json cannot be read .* begin anew"):
            Checkpoints(tmp_path, OF)
    (tmp_path / "about.json").unlink()  # nobody knows what the steps belong to
    with pytest.raises(HyliosError, match=r"about\.json cannot be read .* begin anew"):
        Checkpoints(tmp_path, OF)


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(HyliosError, match="cannot be written"):
        Checkpoints(tmp_path / "file" / "folder", OF)


def test_when_all_is_written_the_folder_goes(tmp_path):
    steps = Checkpoints(tmp_path / "folder", OF)
    steps.step("one").save(a=np.zeros(2))
    steps.remove()
    assert list(tmp_path.iterdir()) == []
