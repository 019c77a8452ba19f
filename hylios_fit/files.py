"""Files that appear under their names only when they are complete, and who may write them."""

from __future__ import annotations

import io
import os
import threading
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from hylios_fit.errors import HyliosError


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Another path to write to, which takes the place of this one if nothing fails.

    Raises:
        HyliosError: if it cannot be written.
    """
    path = Path(path)
    # In the same folder, so that the replacement is one atomic rename.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise HyliosError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            temporary.unlink()


@contextmanager
def atomic_text(path: str | os.PathLike[str]) -> Iterator[TextIO]:
    """A text file (UTF-8) that appears only when it is complete. Raises as `atomic_path`."""
    with (
        atomic_path(path) as temporary,
        open(temporary, "w", encoding="utf-8", newline="") as stream,
    ):
        yield stream


def save_arrays(
    path: str | os.PathLike[str], arrays: Mapping[str, Any], compress: bool = False
) -> None:
    """An .npz file of arrays by name. Raises as `atomic_path`."""
    buffer = io.BytesIO()
    write = np.savez_compressed if compress else np.savez
    write(buffer, allow_pickle=False, **arrays)
    with atomic_path(path) as temporary:
        temporary.write_bytes(buffer.getvalue())


def load_arrays(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The arrays of an .npz file by name; no pickle is loaded.

    Raises:
        HyliosError: if it cannot be read, or is not one.
    """
    try:
        # from memory: numpy leaves a damaged file open
        with np.load(io.BytesIO(Path(path).read_bytes()), allow_pickle=False) as arrays:
            return dict(arrays)
    except (  # damage in a zip archive shows as any of these, such as a compression that is none
        OSError, ValueError, TypeError, KeyError, EOFError, NotImplementedError,
        zipfile.BadZipFile, zlib.error,
    ) as error:  # fmt: skip
        raise HyliosError(f"{path}: not an .npz file, or damaged or cut short ({error})") from error


@contextmanager
def claimed(folder: Path, wait: bool = False) -> Iterator[bool]:
    """Whether nobody else is at work under `folder`, and will not be within this context.

    The system takes the lock back when its holder ends, in whatever way. Where it has none
    (Windows, some network drives) two may do the same work, and come to the same bits.
    """
    try:
        import fcntl
    except ImportError:
        yield True
        return
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder, os.O_RDONLY)
    try:
        free = True
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            free = False
        except OSError:
            pass  # no locks here
        yield free
    finally:
        os.close(handle)
