"""Tests locks on systems and file systems without flock."""

import errno
import os
import runpy
import warnings

import pytest

from rtd3jax.errors import UserError
from rtd3jax.study import filelock, lock
from rtd3jax.study.lock import deriver, is_held, writer


class Windows:
    """msvcrt.locking: exclusive locks of byte ranges, each owned by a handle."""

    LK_NBLCK = 2

    def __init__(self):
        self.held = {}

    def locking(self, handle, mode, count):
        start, file = os.lseek(handle, 0, os.SEEK_CUR), os.fstat(handle).st_ino
        bytes_ = {(file, byte) for byte in range(start, start + count)}
        for other, taken in self.held.items():
            if other != handle and taken & bytes_:
                raise OSError(errno.EACCES, "Permission denied")
        self.held[handle] = self.held.get(handle, set()) | bytes_


@pytest.fixture
def windows(monkeypatch):
    fake = Windows()
    monkeypatch.setattr(filelock, "fcntl", None)
    monkeypatch.setattr(filelock, "msvcrt", fake)
    return fake


@pytest.fixture
def handles(tmp_path):
    opened = [filelock.open_for_locking(tmp_path / "lock") for _ in range(3)]
    yield opened
    for handle in opened:
        os.close(handle)


@pytest.mark.parametrize("system", ["here", "windows"])
def test_one_exclusive_or_several_shared(system, handles, request):
    if system == "windows":
        request.getfixturevalue("windows")
    one, two, three = handles
    filelock.lock(one, shared=True)
    filelock.lock(two, shared=True)
    with pytest.raises(BlockingIOError):
        filelock.lock(three)


@pytest.mark.parametrize("system", ["here", "windows"])
def test_nothing_beside_an_exclusive_one(system, handles, request):
    if system == "windows":
        request.getfixturevalue("windows")
    filelock.lock(handles[0])
    for shared in (True, False):
        with pytest.raises(BlockingIOError):
            filelock.lock(handles[1], shared=shared)


@pytest.mark.parametrize("code", filelock.NO_LOCKS)
def test_a_file_system_without_locks_is_a_warning(code, tmp_path, monkeypatch):
    def flock(*_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(filelock.fcntl, "flock", flock)
    with pytest.warns(UserWarning, match="has no locks .*start only one"), writer(tmp_path, (1, 2)):
        pass
    with pytest.warns(UserWarning), deriver(tmp_path):
        pass
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not is_held(tmp_path)


def test_the_error_of_macos_for_no_locks_is_known(monkeypatch):
    """There, ENOTSUP and EOPNOTSUPP are two numbers."""
    monkeypatch.setattr(errno, "ENOTSUP", 45)
    monkeypatch.setattr(errno, "EOPNOTSUPP", 102)
    assert {45, 102} <= set(runpy.run_path(filelock.__file__)["NO_LOCKS"])


@pytest.mark.parametrize("system", ["here", "windows"])
def test_shards_that_look_for_other_divisions_at_the_same_time_do_not_refuse_each_other(
    system, tmp_path, request, monkeypatch
):
    """Files of an earlier division stay, and each new shard looks whether they are locked."""
    if system == "windows":
        request.getfixturevalue("windows")
    (tmp_path / ".lock-1-of-3").touch()
    real, looked = lock.lock, []

    def look(handle, **options):
        real(handle, **options)
        if os.path.samestat(os.fstat(handle), os.stat(tmp_path / ".lock-1-of-3")) and not looked:
            looked.append(handle)
            with writer(tmp_path, (1, 2)):  # the other shard, while this one looks
                pass

    monkeypatch.setattr(lock, "lock", look)
    with writer(tmp_path, (2, 2)):
        assert looked


def test_a_running_division_is_refused(tmp_path):
    with (
        writer(tmp_path, (1, 3)),
        pytest.raises(UserError, match="divides the study into 3 shards.*--shard i/3"),
        writer(tmp_path, (1, 2)),
    ):
        pass


def test_of_two_divisions_that_start_together_one_is_refused(tmp_path, monkeypatch):
    real, begun = lock._hold, []

    def hold(stack, directory, path, *rest):
        if path.name == ".lock-1-of-2":  # nothing was found; at this moment the other one begins
            begun.append(stack.enter_context(writer(tmp_path, (1, 3))))
        return real(stack, directory, path, *rest)

    monkeypatch.setattr(lock, "_hold", hold)
    with (
        pytest.raises(UserError, match="divides the study into 3 shards"),
        writer(tmp_path, (1, 2)),
    ):
        pass
    assert begun


def test_other_errors_are_not_hidden(handles, monkeypatch):
    def flock(*_):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(filelock.fcntl, "flock", flock)
    with pytest.raises(OSError, match="Input/output"):
        filelock.lock(handles[0])


def test_a_file_system_that_only_locks_files_open_for_writing(tmp_path, monkeypatch):
    """As NFS; see flock(2)."""
    real = filelock.fcntl.flock

    def flock(handle, kind):
        if filelock.fcntl.fcntl(handle, filelock.fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        real(handle, kind)

    monkeypatch.setattr(filelock.fcntl, "flock", flock)
    with writer(tmp_path, None):
        assert is_held(tmp_path)
    assert not is_held(tmp_path)
    real_open = os.open

    def only_for_reading(path, flags, *mode):
        if flags & os.O_RDWR:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        return real_open(path, flags, *mode)

    monkeypatch.setattr(os, "open", only_for_reading)
    assert not is_held(tmp_path)
