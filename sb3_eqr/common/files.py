"""Files and folders that are complete or absent, whoever else writes there and whenever a process is killed."""

import contextlib
import errno
import glob
import hashlib
import os
import pathlib
import shutil
import struct
import uuid
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

try:
    import fcntl
except ImportError:  # Windows: leftovers of killed processes stay there
    fcntl = None  # type: ignore[assignment]


SEAL = b"sha256:"  # and the digits: the comment of a sealed zip file


@contextmanager
def atomic_write(path: str | pathlib.Path, suffix: str) -> Iterator[BinaryIO]:
    """
    A file opened beside ``path`` that takes its place only once it is complete and on the disk. Of two writers the last one
    wins. What killed ones have left beside ``path`` is removed.

    :param path: destination; ``suffix`` is appended where it has none, and its folder is made, as SB3 does
    :param suffix: without the dot
    """
    path = pathlib.Path(path)
    if path.suffix == "":
        path = path.with_suffix(f".{suffix}")
    path.parent.mkdir(parents=True, exist_ok=True)
    with _partial(path, is_folder=False) as partial:
        with open(partial, "w+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
        _sync(path.parent)


def checksum(file: BinaryIO, size: int) -> str:
    """SHA-256 of the first ``size`` bytes of an open file, as hexadecimal digits."""
    found = hashlib.sha256()
    file.seek(0)
    while size > 0 and (piece := file.read(min(size, 1 << 20))):
        found.update(piece)
        size -= len(piece)
    return found.hexdigest()


def seal(file: BinaryIO) -> None:
    """
    Give a zip file without a comment the checksum of all its bytes as one. The checksums of the format leave out its headers.

    :param file: open for reading and writing
    """
    end = file.seek(-2, os.SEEK_END) + 2  # the length of the comment stands there
    file.write(struct.pack("<H", len(SEAL) + 64))
    file.write(SEAL + checksum(file, end).encode())


def is_unbroken(file: BinaryIO) -> bool:
    """Whether a zip file, open for reading, is as it was sealed; one without a comment never was."""
    try:
        comment = zipfile.ZipFile(file).comment
    except (zipfile.BadZipFile, NotImplementedError, ValueError, struct.error):  # of damaged headers
        return False
    end = file.seek(0, os.SEEK_END) - len(comment)
    return comment in (b"", SEAL + checksum(file, end).encode())


@contextmanager
def atomic_folder(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """
    A new folder beside ``path`` that takes its name only once it is complete and on the disk. If there is a ``path`` by then,
    that one stays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with _partial(path, is_folder=True) as partial:
        yield partial
        for found in [*partial.rglob("*"), partial]:
            _sync(found)
        try:
            os.rename(partial, path)
        except OSError as error:
            if error.errno not in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR, errno.EACCES) or not path.exists():
                raise
        _sync(path.parent)


@contextmanager
def _partial(path: pathlib.Path, is_folder: bool) -> Iterator[pathlib.Path]:
    """
    An empty file or folder beside ``path`` whose name nobody else has, gone afterwards. As long as it is written, its process
    holds a lock of it: one without a lock is a leftover.
    """
    remove_leftovers(path.parent, glob.escape(path.name))
    descriptor = None
    while descriptor is None:  # it may be taken for a leftover before it is locked
        partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
        partial.mkdir() if is_folder else partial.touch()
        with contextlib.suppress(FileNotFoundError):
            descriptor = _open(partial)
            if _lock(descriptor) is False or not partial.exists():
                os.close(descriptor)
                descriptor = None
    try:
        with _full_disk_named(path):
            yield partial
    finally:
        _remove(partial)
        os.close(descriptor)  # and the lock with it


@contextmanager
def _full_disk_named(path: pathlib.Path) -> Iterator[None]:
    """What a full disk makes of a write, PyTorch's errors included, as an OSError that says what is left."""
    try:
        yield
    except Exception as error:
        cause: BaseException | None = error
        while cause is not None and getattr(cause, "errno", None) != errno.ENOSPC:
            cause = cause.__context__
        if cause is None:
            raise
        state = "is as it was" if path.exists() else "was not written"
        raise OSError(errno.ENOSPC, f"No space left on the disk of {path.parent}: {path.name} {state}") from error


def remove_leftovers(folder: pathlib.Path, names: str) -> None:
    """
    Remove what killed processes have left in a folder; what is being written is locked, and stays.

    :param folder: where they wrote
    :param names: of what they wrote, as a pattern
    """
    for leftover in folder.glob(f".{names}.*.partial"):
        with contextlib.suppress(OSError):
            descriptor = _open(leftover)
            try:
                if _lock(descriptor):
                    _remove(leftover)
            finally:
                os.close(descriptor)


def _open(path: pathlib.Path) -> int:
    return os.open(os.devnull if os.name == "nt" and path.is_dir() else path, os.O_RDONLY)


def _lock(descriptor: int) -> bool | None:
    """Whether the lock is ours now; ``None`` if there are no locks on this system or in this folder."""
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
    except BlockingIOError:
        return False
    except OSError:
        return None
    return None


def _remove(path: pathlib.Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _sync(path: pathlib.Path) -> None:
    """Onto the disk; Windows has no such call for folders."""
    with contextlib.suppress(PermissionError):
        descriptor = _open(path)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
