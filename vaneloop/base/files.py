"""Every file that is written for a user: whole, or as it was before, whatever is killed and however full the disk is.

A temporary file beside the target is written, brought to the disk, and takes the target's name in one step (rename(2)).
So a file that is read may be written under its own name. A kill may leave the temporary file, `.NAME.*.part`.
Only the standard library is imported here.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from vaneloop.base.errors import InputError

__all__ = ["cannot_write", "check", "own_folder", "replacing", "whole", "write", "write_all"]


def cannot_write(path: object, error: OSError) -> str:
    """The one line that says why a file was not written."""
    why = os.strerror(error.errno) if error.errno else str(error)  # libraries put words of their own around it
    return f"cannot write {path}: {' '.join(why.split())}"


@contextlib.contextmanager
def whole(path: str | Path, refusal: type[InputError] = InputError) -> Iterator[Path]:
    """Give the name of an empty temporary file for whatever writes one; it takes the place of ``path`` where nothing
    fails. Raises ``refusal`` in one line where something does, and leaves the old file.

    What is no regular file (a pipe, /dev/null), and the output of this process (/dev/stdout), is given itself.
    """
    try:
        with replacing(path) as part:
            yield part
    except OSError as e:
        raise refusal(cannot_write(path, e)) from None


def write(path: str | Path, content: str | bytes) -> Path:
    """Write text (UTF-8) or bytes as a whole file; return its path. Raises InputError in one line."""
    return write_all({path: content})[0]


def write_all(contents: Mapping[str | Path, str | bytes] | Mapping[Path, str | bytes]) -> list[Path]:
    """As `write`, for files that belong together: none takes its place before all are on the disk."""
    with contextlib.ExitStack() as stack:
        for path, content in contents.items():
            part = stack.enter_context(whole(path))
            with open(part, "ab") as f:  # it is empty; the output of this process goes on where it is
                f.write(content.encode() if isinstance(content, str) else content)
                f.flush()
                if stat.S_ISREG(os.fstat(f.fileno()).st_mode):
                    os.fsync(f.fileno())
    return [Path(path) for path in contents]


def check(path: str | Path) -> None:
    """Raise InputError in one line where ``path`` could not be written: to be asked before work that takes a while."""
    try:
        target = _begin(path)
    except OSError as e:
        raise InputError(cannot_write(path, e)) from None
    target.drop()


@contextlib.contextmanager
def replacing(path: str | Path, only_new: bool = False) -> Iterator[Path]:
    """As `whole`, with every error as it comes.

    only_new  raise FileExistsError where there is such a file, also one that another process has made meanwhile
    """
    target = _begin(path, only_new)
    try:
        yield Path(target.part)
        if target.part != target.name:
            target.finish()
            (os.link if only_new else os.replace)(target.part, target.name)  # a link also on NFS is made by one alone
            with contextlib.suppress(OSError):  # the new name is on the disk; some file systems cannot promise it
                _sync(os.path.dirname(target.name) or ".")
    finally:
        target.drop()


class _Target(NamedTuple):
    """A file to be written: its name behind all links, the temporary file (the same name: it is written itself), mode
    and owner that it will have.
    """

    name: str
    part: str
    mode: int
    owner: tuple[int, int]

    def finish(self) -> None:
        """Bring the temporary file to the disk, with the mode and, where that is allowed, the owner of the old one."""
        _sync(self.part)
        now = os.stat(self.part)
        if (now.st_uid, now.st_gid) != self.owner:
            with contextlib.suppress(PermissionError):
                os.chown(self.part, *self.owner)
        os.chmod(self.part, self.mode)

    def drop(self) -> None:
        """Remove the temporary file, where it is still there."""
        if self.part != self.name:
            with contextlib.suppress(OSError):
                os.unlink(self.part)


def _begin(path: str | Path, only_new: bool = False) -> _Target:
    """Make the temporary file. Raises OSError where the target may not be written."""
    try:
        name, direct = _behind_links(os.fspath(path))
    except ValueError as e:  # a null byte
        raise OSError(str(e)) from None
    old = None
    with contextlib.suppress(FileNotFoundError):
        old = os.stat(name)
    if old is not None and stat.S_ISDIR(old.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), name)
    if direct or (old is not None and not stat.S_ISREG(old.st_mode)):
        return _Target(name, name, 0, (0, 0))
    if old is not None:
        if only_new:
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), name)
        os.close(os.open(name, os.O_WRONLY))  # one that is write-protected is not replaced either
    folder, last = os.path.split(name)
    if not last:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), name)
    part = os.path.join(folder, f".{last[:40]}.{os.urandom(6).hex()}.part")
    try:
        mode = 0o666 if old is None else old.st_mode & 0o666 | 0o200  # no one reads it who may not read the old one
        os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode))
    except PermissionError:
        if old is None:
            raise
        raise OSError("its folder may not be written, where the new file is made before it takes its place") from None
    about = old or os.stat(part)
    return _Target(name, part, stat.S_IMODE(about.st_mode), (about.st_uid, about.st_gid))


def _behind_links(name: str) -> tuple[str, bool]:
    """The name that links lead to, and whether it is one of a device or an open file (/dev/stdout, /proc/self/fd/1).

    Behind an open file may be a regular one, in which the process that opened it goes on writing: it is not replaced.
    """
    for _ in range(40):  # as many as the kernel follows
        folder = os.path.realpath(os.path.dirname(os.path.abspath(name)))
        if folder == "/dev" or folder.startswith("/proc/"):
            return name, True
        try:
            name = os.path.join(os.path.dirname(name), os.readlink(name))
        except OSError:  # no link
            return name, False
    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), name)


def _sync(name: str) -> None:
    """Bring a file or a folder to the disk."""
    fd = os.open(name, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def own_folder(prefix: str) -> Path:
    """Make a folder for temporary files that only this user may enter, and that goes with its process; nobody can have
    made it before, as its name is drawn.
    """
    place = tempfile.mkdtemp(prefix=prefix)
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    return Path(place)
