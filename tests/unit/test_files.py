"""Files and folders are complete or absent, even with several writers."""

import errno
import functools
import io
import multiprocessing
import os
import signal
import subprocess
import threading
import time
import zipfile

import pytest

from sb3_eqr.common.saving import files
from sb3_eqr.common.saving.files import atomic_folder, atomic_write, is_unbroken, seal


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "deep" / "model"
    with atomic_write(path, "zip") as file:
        file.write(b"old")
    with pytest.raises(RuntimeError), atomic_write(path, "zip") as file:
        file.write(b"half")
        raise RuntimeError
    assert names(path.parent) == ["model.zip"] and (path.parent / "model.zip").read_bytes() == b"old"


def test_every_flipped_bit_of_a_sealed_zip_file_is_found(tmp_path):
    path = tmp_path / "some.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("name", "content")
    with open(path, "rb") as file:
        assert is_unbroken(file)  # without a seal
    with open(path, "r+b") as file:
        seal(file)
        assert is_unbroken(file)
    whole = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None and archive.read("name") == b"content"
    unsealed = whole[: -len("sha256:") - 64]
    path.write_bytes(unsealed)
    expected = subprocess.run(["sha256sum", path], capture_output=True, text=True, check=True).stdout.split()[0]
    assert whole.removeprefix(unsealed) == b"sha256:" + expected.encode()
    for place in range(len(whole)):
        for bit in range(8):
            changed = bytearray(whole)
            changed[place] ^= 1 << bit
            assert not is_unbroken(io.BytesIO(changed)), (place, bit)


def hang(path):
    """Write half a file and half a folder, then wait to be killed."""
    with atomic_write(path, "bin") as file, atomic_folder(path.with_name("folder")) as folder:
        file.write(b"half")
        file.flush()
        (folder / "half").write_bytes(b"half")
        time.sleep(60)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="not on Windows")
def test_partial_files_are_removed_unless_their_writer_is_running(tmp_path):
    path = tmp_path / "file.bin"
    context = multiprocessing.get_context("spawn")
    dead, alive = (context.Process(target=hang, args=(path,)) for _ in range(2))
    dead.start()
    while len(names(tmp_path)) < 2 or not list(tmp_path.glob(".folder*/half")):
        time.sleep(0.01)
    os.kill(dead.pid, signal.SIGKILL)
    dead.join()
    left = names(tmp_path)
    alive.start()
    try:
        while len(set(names(tmp_path)) - set(left)) < 2 or not list(tmp_path.glob(".folder*/half")):
            time.sleep(0.01)
        assert set(names(tmp_path)).isdisjoint(left)  # the new writer has removed the leftovers
        with atomic_write(path, "bin") as file, atomic_folder(tmp_path / "folder"):
            file.write(b"whole")
        assert len(names(tmp_path)) == 4 and path.read_bytes() == b"whole"  # the others belong to the process still alive
    finally:
        alive.kill()
        alive.join()
    with atomic_write(path, "bin") as file, atomic_folder(tmp_path / "folder"):
        file.write(b"last")
    assert names(tmp_path) == ["file.bin", "folder"]


def test_threads_can_write_the_same_file(tmp_path):
    path, errors = tmp_path / "file.bin", []

    def write(number):
        try:
            for _ in range(20):
                with atomic_write(path, "bin") as file:
                    file.write(bytes([number]) * 5_000)
                content = path.read_bytes()
                assert len(content) == 5_000 and len(set(content)) == 1
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=write, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors and names(tmp_path) == ["file.bin"]


def test_a_folder_appears_complete_and_is_not_replaced(tmp_path):
    path = tmp_path / "checkpoint"
    with atomic_folder(path) as folder:
        (folder / "deep").mkdir()
        (folder / "deep" / "a").write_text("first")
        assert not path.exists()
    with atomic_folder(path) as folder:
        (folder / "b").write_text("second")
    with pytest.raises(RuntimeError), atomic_folder(tmp_path / "other"):
        raise RuntimeError
    assert names(tmp_path) == ["checkpoint"] and names(path) == ["deep"]


def test_nothing_is_open_when_renamed_without_locks(tmp_path, monkeypatch):
    """On Windows there is no fcntl, a folder or read-only file cannot be flushed, and what is open cannot be renamed."""
    fcntl, moved = pytest.importorskip("fcntl"), []

    def move(source, destination, real):
        opened = [os.path.realpath(link.path) for link in os.scandir("/proc/self/fd") if os.path.exists(link.path)]
        assert not any(str(source) in path for path in opened)
        moved.append(destination)
        real(source, destination)

    def flush(descriptor):
        if fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, "Bad file descriptor")

    monkeypatch.setattr(files, "fcntl", None)
    monkeypatch.setattr(os, "replace", functools.partial(move, real=os.replace))
    monkeypatch.setattr(os, "rename", functools.partial(move, real=os.rename))
    monkeypatch.setattr(os, "fsync", flush)
    (tmp_path / ".file.bin.old.partial").touch()
    with atomic_write(tmp_path / "file.bin", "bin") as file, atomic_folder(tmp_path / "folder") as folder:
        file.write(b"whole")
        (folder / "a").write_text("first")
    assert moved == [tmp_path / "folder", tmp_path / "file.bin"] and (tmp_path / "file.bin").read_bytes() == b"whole"
    assert names(tmp_path) == [".file.bin.old.partial", "file.bin", "folder"] and names(tmp_path / "folder") == ["a"]
