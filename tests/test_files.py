"""Files that are written whole: `vaneloop.base.files`. A full disk, command by command: tests/test_full_disk.py."""

from __future__ import annotations

import errno
import os
import random
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import ROOT
from vaneloop.base import files
from vaneloop.base.errors import InputError

OLD, NEW = b"old" * 50_000, b"new" * 70_000


def mode_of(file: Path) -> int:
    return stat.S_IMODE(file.stat().st_mode)


def child(work: Callable[[], object]) -> int:
    """Do ``work`` in a process of its own; return its exit code, or -N where signal N ended it."""
    pid = os.fork()
    if pid == 0:
        try:
            work()
            os._exit(0)
        except BaseException:
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


# ---- what takes the place of what -----------------------------------------------------------------------------------


@pytest.mark.parametrize("mask", [0o022, 0o027, 0o077])
def test_a_new_file_has_the_mode_that_the_umask_leaves(tmp_path: Path, mask: int) -> None:
    before = os.umask(mask)
    try:
        assert files.write(tmp_path / "a", "ä\n") == tmp_path / "a"
        assert os.umask(mask) == mask
    finally:
        os.umask(before)
    assert (tmp_path / "a").read_bytes() == "ä\n".encode() and mode_of(tmp_path / "a") == 0o666 & ~mask
    assert os.listdir(tmp_path) == ["a"]


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o664, 0o755])
def test_a_file_keeps_its_mode_also_where_a_library_makes_it_anew(tmp_path: Path, mode: int) -> None:
    (tmp_path / "a").write_bytes(OLD)
    (tmp_path / "a").chmod(mode)
    files.write(tmp_path / "a", NEW)
    assert mode_of(tmp_path / "a") == mode and (tmp_path / "a").read_bytes() == NEW
    with files.whole(tmp_path / "a") as part:
        assert mode_of(part) & ~mode == 0, "others must not read what they may not read in the end"
        part.unlink()
        part.write_bytes(OLD)
    assert mode_of(tmp_path / "a") == mode and (tmp_path / "a").read_bytes() == OLD


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a file away")
def test_a_file_keeps_its_owner(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(OLD)
    os.chown(tmp_path / "a", 1234, 5678)
    files.write(tmp_path / "a", NEW)
    assert (os.stat(tmp_path / "a").st_uid, os.stat(tmp_path / "a").st_gid) == (1234, 5678)


@pytest.mark.parametrize("there", [True, False])
def test_a_link_stays_a_link(tmp_path: Path, there: bool) -> None:
    for name in ("far", "near"):
        (tmp_path / name).mkdir()
    (tmp_path / "near" / "a").symlink_to("../far/b")
    (tmp_path / "far" / "b").symlink_to(tmp_path / "far" / "c")
    if there:
        (tmp_path / "far" / "c").write_bytes(OLD)
    files.write(tmp_path / "near" / "a", NEW)
    assert os.readlink(tmp_path / "near" / "a") == "../far/b" and (tmp_path / "far" / "b").is_symlink()
    assert (tmp_path / "far" / "c").read_bytes() == NEW and not (tmp_path / "far" / "c").is_symlink()
    assert os.listdir(tmp_path / "near") == ["a"] and sorted(os.listdir(tmp_path / "far")) == ["b", "c"]


def test_a_file_may_be_read_while_it_is_written_under_its_own_name(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(OLD)
    with open(tmp_path / "a", "rb") as reading, files.whole(tmp_path / "a") as part, open(part, "wb") as writing:
        while block := reading.read(1000):
            writing.write(block.upper())
            assert (tmp_path / "a").read_bytes() == OLD
    assert (tmp_path / "a").read_bytes() == OLD.upper()


def test_a_pipe_and_a_device_are_written_themselves(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    got: list[bytes] = []
    reader = threading.Thread(target=lambda: got.append((tmp_path / "pipe").read_bytes()))
    reader.start()
    files.write(tmp_path / "link", NEW)
    reader.join(60)
    assert got == [NEW] and stat.S_ISFIFO(os.stat(tmp_path / "pipe").st_mode)
    files.write("/dev/null", NEW)
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode) and sorted(os.listdir(tmp_path)) == ["link", "pipe"]
    with pytest.raises(InputError, match="^cannot write /dev/full: No space left on device$"):
        files.write("/dev/full", NEW)


@pytest.mark.parametrize("name", ["/dev/stdout", "/dev/fd/1", "/proc/self/fd/1", "link"])
@pytest.mark.parametrize("to", ["pipe", "file"])
def test_the_output_of_the_process_is_written_where_it_goes(tmp_path: Path, name: str, to: str) -> None:
    """Where it goes to a file, what was said before is still there, and what is said after comes behind."""
    (tmp_path / "link").symlink_to("/dev/stdout")
    code = f"import os\nfrom vaneloop.base import files\nos.write(1, b'before ')\nfiles.write({name!r}, 'it ')\n"
    words = [sys.executable, "-c", f"import sys\nsys.path.insert(0, {str(ROOT)!r})\n{code}os.write(1, b'after')"]
    if to == "pipe":
        assert subprocess.run(words, cwd=tmp_path, stdout=subprocess.PIPE, check=True).stdout == b"before it after"
    else:
        with open(tmp_path / "said", "ab") as said:
            subprocess.run(words, cwd=tmp_path, stdout=said, check=True)
        assert (tmp_path / "said").read_bytes() == b"before it after"
        assert sorted(os.listdir(tmp_path)) == ["link", "said"]


# ---- what cannot be written -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("folder", "Is a directory"),
        ("no/a", "No such file or directory"),
        ("file/a", "Not a directory"),
        ("loop", "Too many levels of symbolic links"),
        ("a\0b", "embedded null byte"),
        ("x" * 256, "File name too long"),
    ],
)
def test_what_cannot_be_written_is_one_line_and_leaves_nothing(tmp_path: Path, name: str, why: str) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_bytes(OLD)
    (tmp_path / "loop").symlink_to("loop")
    for act in (files.check, lambda p: files.write(p, NEW)):
        with pytest.raises(InputError) as refused:
            act(f"{tmp_path}/{name}")
        assert str(refused.value) == f"cannot write {tmp_path}/{name}: {why}" and refused.value.__suppress_context__
    assert sorted(os.listdir(tmp_path)) == ["file", "folder", "loop"] and (tmp_path / "file").read_bytes() == OLD


def test_a_long_name_is_written(tmp_path: Path) -> None:
    name = "ä" * 127
    files.write(tmp_path / name, NEW)
    assert os.listdir(tmp_path) == [name]


def test_to_ask_changes_nothing(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(OLD)
    for name in ("a", "b"):
        files.check(tmp_path / name)
    assert os.listdir(tmp_path) == ["a"] and (tmp_path / "a").read_bytes() == OLD


@pytest.mark.parametrize(
    ("protected", "why"),
    [("a", "Permission denied"), (".", "its folder may not be written"), ("b", "Permission denied")],
)
def test_what_is_write_protected_is_not_replaced(tmp_path: Path, protected: str, why: str) -> None:
    """As another user, where this is root's."""
    (tmp_path / "a").write_bytes(OLD)
    os.chmod(tmp_path, 0o777)
    os.chmod(tmp_path / "a", 0o444 if protected == "a" else 0o666)
    os.chmod(tmp_path, 0o777 if protected == "a" else 0o555)
    folder = os.open(tmp_path, os.O_RDONLY)

    def refused() -> None:
        os.fchdir(folder)
        if os.getuid() == 0:
            os.setgid(65534)
            os.setuid(65534)
        with pytest.raises(InputError, match=f"^cannot write {'b' if protected == 'b' else 'a'}: {why}"):
            files.write("b" if protected == "b" else "a", NEW)

    assert child(refused) == 0
    os.close(folder)
    os.chmod(tmp_path, 0o777)
    assert os.listdir(tmp_path) == ["a"] and (tmp_path / "a").read_bytes() == OLD


@pytest.mark.parametrize("step", ["fsync", "replace", "chmod"])
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EDQUOT])
def test_an_error_at_any_step_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, code: int
) -> None:
    (tmp_path / "a").write_bytes(OLD)

    def fails(*_: object) -> None:
        raise OSError(code, "words of a library")

    monkeypatch.setattr(os, step, fails)
    with pytest.raises(InputError, match=f"^cannot write {tmp_path}/a: {os.strerror(code)}$"):
        files.write(tmp_path / "a", NEW)
    assert os.listdir(tmp_path) == ["a"] and (tmp_path / "a").read_bytes() == OLD


def test_other_errors_come_as_they_are_and_leave_the_old_file(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(OLD)
    for error in (KeyError("x"), ValueError("x"), KeyboardInterrupt(), InputError("its value")):
        with pytest.raises(type(error)) as raised, files.whole(tmp_path / "a") as part:
            part.write_bytes(NEW)
            raise error
        assert raised.value is error
    assert os.listdir(tmp_path) == ["a"] and (tmp_path / "a").read_bytes() == OLD


# ---- files that belong together -------------------------------------------------------------------------------------


def test_files_that_belong_together_change_together(tmp_path: Path) -> None:
    names = [tmp_path / name for name in "abc"]
    for file in names[:2]:
        file.write_bytes(OLD)
    os.mkfifo(tmp_path / "closed")
    with pytest.raises(InputError, match=f"^cannot write {tmp_path}/no/d: No such file"):
        files.write_all({**dict.fromkeys(names, NEW), tmp_path / "no" / "d": NEW})
    assert [f.read_bytes() for f in names[:2]] == [OLD, OLD] and len(os.listdir(tmp_path)) == 3
    assert files.write_all(dict.fromkeys(names, NEW)) == names
    assert [f.read_bytes() for f in names] == [NEW] * 3 and len(os.listdir(tmp_path)) == 4


def test_only_new_is_made_by_one_alone(tmp_path: Path) -> None:
    with files.replacing(tmp_path / "a", only_new=True) as part:
        part.write_bytes(OLD)
        (tmp_path / "a").write_bytes(NEW)  # by another process, meanwhile
        with pytest.raises(FileExistsError), files.replacing(tmp_path / "a", only_new=True):
            raise AssertionError("it is there")
        (tmp_path / "a").unlink()
    assert (tmp_path / "a").read_bytes() == OLD
    with pytest.raises(FileExistsError), files.replacing(tmp_path / "b", only_new=True) as part:
        part.write_bytes(OLD)
        (tmp_path / "b").write_bytes(NEW)
    assert (tmp_path / "b").read_bytes() == NEW and sorted(os.listdir(tmp_path)) == ["a", "b"]


# ---- kill -9 --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", ["open", "fsync", "chmod", "replace", "unlink"])
@pytest.mark.parametrize("after", [False, True])
def test_a_kill_at_any_step_leaves_the_old_file_or_the_new(tmp_path: Path, step: str, after: bool) -> None:
    (tmp_path / "a").write_bytes(OLD)

    def killed() -> None:
        do = getattr(os, step)

        def die(*words: object) -> object:
            try:
                return do(*words) if after else None
            finally:
                os.kill(os.getpid(), signal.SIGKILL)

        with files.whole(tmp_path / "a") as part:
            part.write_bytes(NEW[: len(NEW) // 2])
            setattr(os, step, die)
            with open(part, "ab") as f:
                f.write(NEW[len(NEW) // 2 :])

    assert child(killed) == -signal.SIGKILL
    assert (tmp_path / "a").read_bytes() == (NEW if step == "unlink" or (step, after) == ("replace", True) else OLD)


def test_a_kill_at_any_time_leaves_one_of_what_was_written(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(OLD)
    rng = random.Random(1)
    for _ in range(20):
        pid = os.fork()
        if pid == 0:
            while True:
                files.write(tmp_path / "a", NEW)
                files.write(tmp_path / "a", OLD)
        time.sleep(rng.uniform(0.0, 0.01))
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        assert (tmp_path / "a").read_bytes() in (OLD, NEW)


# ---- a full file system ---------------------------------------------------------------------------------------------


def full_file_system(folder: Path, code: str, size: str = "64k") -> subprocess.CompletedProcess[str]:
    """Run Python code in ``folder``, where a file system of ``size`` is mounted that holds a file ``a``, "old"."""
    if (
        shutil.which("unshare") is None
        or subprocess.run(["unshare", "-rm", "true"], capture_output=True, check=False).returncode
    ):
        pytest.skip("this machine lets no user mount a file system (unshare -rm)")
    python = f"PYTHONPATH={ROOT} {sys.executable} -c '{code}'"
    mount = f"mount -t tmpfs -o size={size} none {folder} && cd {folder} && printf old > a && {python}"
    return subprocess.run(["unshare", "-rm", "sh", "-c", mount], capture_output=True, text=True, check=False)


def test_a_full_file_system_keeps_the_old_file(tmp_path: Path) -> None:
    code = (
        "import os\nfrom vaneloop.base.files import *\nfrom vaneloop.base.errors import *\n"
        'try: write("a", b"x" * 100_000)\nexcept InputError as e: print(e)\nprint(open("a").read(), os.listdir("."))'
    )
    done = full_file_system(tmp_path, code)
    assert done.stdout == "cannot write a: No space left on device\nold ['a']\n", done.stderr
