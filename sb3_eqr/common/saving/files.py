"""Atomic writes: files and folders are complete or absent, even with concurrent writers and killed processes."""

import atexit
import contextlib
import errno
import glob
import hashlib
import os
import pathlib
import shutil
import struct
import tempfile
import uuid
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

try:
    import fcntl
except ImportError:  # Windows: it does not rename what is open, so nothing is locked and leftovers are not removed
    fcntl = None  # type: ignore[assignment]


LONGEST = 200  # bytes of a name; file systems allow 255, and a temporary name is 42 longer
SEAL = b"sha256:"  # followed by the digits: the comment of a sealed zip file


@contextmanager
def atomic_write(path: str | pathlib.Path, suffix: str) -> Iterator[BinaryIO]:
    """
    Open a temporary file next to ``path`` that replaces it once it is complete and on disk. If there are two writers, the
    last one wins. Leftovers of killed writers are removed.

    :param path: destination; ``suffix`` is appended if it has none, and its folder is created, as in SB3
    :param suffix: file extension without the dot
    """
    path = pathlib.Path(path)
    path = path if path.suffix else path.with_suffix(f".{suffix}")
    path = pathlib.Path(os.path.realpath(path))  # as open does, write where a link leads
    path.parent.mkdir(parents=True, exist_ok=True)
    with _partial(path, is_folder=False) as partial:
        with open(partial, "w+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
        _sync(path.parent)


def temporary_folder() -> pathlib.Path:
    """A new folder that is removed when the process ends."""
    folder = tempfile.mkdtemp(prefix="sb3-eqr-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return pathlib.Path(folder)


def checksum(file: BinaryIO, size: int) -> str:
    """SHA-256 of the first ``size`` bytes of an open file, as hexadecimal digits."""
    found = hashlib.sha256()
    file.seek(0)
    while size > 0 and (piece := file.read(min(size, 1 << 20))):
        found.update(piece)
        size -= len(piece)
    return found.hexdigest()


def seal(file: BinaryIO) -> None:
    """Append its checksum to a zip file, open for reading and writing, as its comment: those of the format omit headers."""
    end = file.seek(-2, os.SEEK_END) + 2  # the last two bytes hold the length of the comment
    file.write(struct.pack("<H", len(SEAL) + 64))
    file.write(SEAL + checksum(file, end).encode())


def is_unbroken(file: BinaryIO) -> bool:
    """Whether a zip file, open for reading, is unchanged since it was sealed; files without a comment count as unchanged."""
    try:
        comment = zipfile.ZipFile(file).comment
    except (zipfile.BadZipFile, NotImplementedError, ValueError, struct.error):  # raised for damaged headers
        return False
    end = file.seek(0, os.SEEK_END) - len(comment)
    return comment in (b"", SEAL + checksum(file, end).encode())


def stored_members(archive: zipfile.ZipFile) -> list[str]:
    """The names of a zip file's members; raises ValueError if they would take more memory than the file has bytes."""
    infos = archive.infolist()
    if any(info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size for info in infos):
        raise ValueError("its members are compressed, which files of this package never are")
    end = archive.start_dir  # type: ignore[attr-defined]
    if sum(info.file_size for info in infos) > end:
        raise ValueError("its members overlap")
    return [info.filename for info in infos]


@contextmanager
def atomic_folder(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """
    Create a temporary folder next to ``path`` that is renamed to it once it is complete and on disk. If ``path`` exists by
    then, it is kept.
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
    Create an empty file or folder next to ``path`` with a unique name, and remove it afterwards. Its process holds a lock on
    it while writing, so one without a lock is a leftover.
    """
    name = os.fsencode(path.name)[:LONGEST].decode(errors="ignore")
    remove_leftovers(path.parent, glob.escape(name))
    descriptor = None
    while True:  # another process may mistake it for a leftover before it is locked
        partial = path.with_name(f".{name}.{uuid.uuid4().hex}.partial")
        partial.mkdir() if is_folder else partial.touch()
        if fcntl is None:
            break
        with contextlib.suppress(FileNotFoundError):
            descriptor = os.open(partial, os.O_RDONLY)
            if _lock(descriptor) is not False and partial.exists():
                break
            os.close(descriptor)
    try:
        yield partial
    except Exception as error:
        cause: BaseException | None = error  # any error caused by a full disk, including PyTorch's, shall say so
        while cause is not None and getattr(cause, "errno", None) != errno.ENOSPC:
            cause = cause.__context__
        if cause is None:
            raise
        state = "is unchanged" if path.exists() else "was not written"
        raise OSError(errno.ENOSPC, f"No space left on the disk of {path.parent}: {path.name} {state}") from error
    finally:
        _remove(partial)
        if descriptor is not None:
            os.close(descriptor)  # and the lock with it


def remove_leftovers(folder: pathlib.Path, names: str) -> None:
    """Remove leftovers of killed processes, which wrote files or folders of these names (a pattern); others are locked."""
    if fcntl is None:
        return
    for leftover in folder.glob(f".{names}.*.partial"):
        with contextlib.suppress(OSError):
            descriptor = os.open(leftover, os.O_RDONLY)
            try:
                if _lock(descriptor):
                    _remove(leftover)
            finally:
                os.close(descriptor)


def _lock(descriptor: int) -> bool | None:
    """Try to lock, and return whether it succeeded; ``None`` if this folder does not support locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True
    except BlockingIOError:
        return False
    except OSError:
        return None


def _remove(path: pathlib.Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _sync(path: pathlib.Path) -> None:
    """Flush a file or folder to disk."""
    if fcntl is None:  # Windows flushes only files that are open for writing
        return
    with contextlib.suppress(PermissionError):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
