"""Run the tests marked ``socketcan``: on this machine's vcan0 where it has one, otherwise inside user-mode Linux.

User-mode Linux is a kernel that runs as a program on the host's own file system, without privileges; Debian's package of it has the CAN
modules. The tests inside use this very checkout and Python environment, and its compiled code. Arguments are handed to pytest::

    python -m tests.uml.run [-k EXPRESSION ...]

Exit code: pytest's. Where the tests cannot be run, a banner says why and the exit code is 0, or 1 if VANELOOP_NEED_VCAN is set.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

__all__ = ["main"]

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
INTERFACE = "vcan0"
MEMORY_MIB = 1536
BOOT_LIMIT = 60.0  # s; it takes one or two
TEST_LIMIT = 900.0  # s; the tests take two or three minutes, on a machine with ten programs for each processor seven
CAN_UTILS = {"candump": "can-utils", "cansend": "can-utils", "cangen": "can-utils", "canplayer": "can-utils", "ip": "iproute2"}
INSIDE = CAN_UTILS | {"linux.uml": "user-mode-linux", "insmod": "kmod"}
HANDED_ON = ("HOME", "LANG", "LC_ALL", "NUMBA_CACHE_DIR", "NUMBA_DISABLE_JIT", "VANELOOP_DATA", "VIRTUAL_ENV", "TERM")


def say(text: str) -> None:
    """Print one line of progress, marked as ours."""
    print(f"[vaneloop] {text}", flush=True)


def skipped(why: str) -> int:
    """Say loudly that nothing was tested, and why."""
    line = "!" * 100
    print(f"\n{line}\n!! SOCKETCAN TESTS NOT RUN: {why}\n{line}\n", flush=True)
    return 1 if os.environ.get("VANELOOP_NEED_VCAN") else 0


def is_up(interface: str = INTERFACE) -> bool:
    """Whether this kernel has the CAN interface, up and usable."""
    if not Path(f"/sys/class/net/{interface}").exists() or not hasattr(socket, "AF_CAN"):
        return False
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as s:
            s.bind((interface,))
            return bool(int(Path(f"/sys/class/net/{interface}/flags").read_text(), 16) & 1)
    except OSError:
        return False


def find(program: str) -> str | None:
    """Path of a program; sbin counts although it is not on every user's PATH."""
    return shutil.which(program, path=os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"]))


def install(wanted: dict[str, str]) -> str | None:
    """Install the packages of missing programs where that is allowed; None, or why the tests cannot be run."""
    packages = sorted({package for program, package in wanted.items() if find(program) is None})
    if not packages:
        return None
    missing = f"needs the Debian packages {' '.join(packages)}"
    if find("apt-get") is None:
        return f"{missing}, and this system has no apt-get"
    if os.geteuid() != 0:
        return f"{missing}; as root: apt-get install {' '.join(packages)}"
    say(f"installing {' '.join(packages)} with apt-get")
    environment = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
    try:
        subprocess.run(["apt-get", "update", "-qq"], check=False, env=environment, capture_output=True, timeout=300)
        ask = ["apt-get", "install", "-y", "-qq", "--no-install-recommends", *packages]
        done = subprocess.run(ask, check=False, env=environment, capture_output=True, text=True, timeout=300)
    except subprocess.TimeoutExpired:
        return f"{missing}; apt-get did not end within 5 min"
    if done.returncode != 0 or any(find(program) is None for program in wanted):
        return f"{missing}; apt-get could not install them ({(done.stderr.strip().splitlines() or ['no reason given'])[-1]})"
    return None


def memory_folder() -> str | None:
    """A folder that can hold the guest's memory: room for it, and mappings from it may be executed."""
    for folder in dict.fromkeys([os.environ.get("TMPDIR", "/dev/shm"), "/dev/shm", "/tmp", "/var/tmp"]):
        try:
            stat = os.statvfs(folder)
        except OSError:
            continue
        if not stat.f_flag & os.ST_NOEXEC and stat.f_bavail * stat.f_frsize > MEMORY_MIB * 2**20 and os.access(folder, os.W_OK):
            return folder
    return None


def command(arguments: list[str]) -> list[str]:
    """The pytest command; only files that carry the marker, since collecting the others takes longer than the tests."""
    marked = sorted(f for f in (ROOT / "tests").glob("test_*.py") if "mark.socketcan" in f.read_text(encoding="utf-8"))
    files = [f.relative_to(ROOT).as_posix() for f in marked]
    return [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-m", "socketcan", "--durations=5", *arguments, *files]


def warm_up() -> None:
    """Compile, on the host's processors, what the tests inside will find in the cache: there it would take one processor a minute."""
    for command in (
        ["app.main", "run", "--bus", "lockstep", "--duration", "0.1", "--quiet"],
        ["hil.inject", "demand_gap_40ms", "--quiet"],
        ["hil.replay", "examples/engine_run.blf", "--quiet"],
    ):
        subprocess.run(
            [sys.executable, "-m", *command], cwd=ROOT, check=False, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, timeout=300
        )


def in_user_mode_linux(arguments: list[str]) -> int:
    """Boot, run the tests inside, print what they print, halt."""
    folder = memory_folder()
    if folder is None:
        return skipped(f"user-mode Linux needs a folder with {MEMORY_MIB} MiB free from which code may run (/dev/shm, /tmp or TMPDIR)")
    with tempfile.TemporaryDirectory(prefix="vaneloop-uml-") as name:
        job = Path(name)
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])
        settings = {k: os.environ[k] for k in HANDED_ON if k in os.environ} | {"PATH": path, "VANELOOP_NEED_VCAN": "1"}
        exports = "".join(f"export {k}={shlex.quote(v)}\n" for k, v in settings.items())
        inside = shlex.join(command(arguments))
        (job / "command").write_text(f"{exports}cd {shlex.quote(str(ROOT))} || exit 9\nexec {inside}\n", encoding="utf-8")
        shutil.copy(HERE / "init.sh", job / "init.sh")
        (job / "init.sh").chmod(0o755)
        boot = [str(find("linux.uml")), f"mem={MEMORY_MIB}M", "root=/dev/root", "rootfstype=hostfs", "rootflags=/", "rw", "quiet"]
        boot += [f"init={job}/init.sh", f"VANELOOP_JOB={job}", f"uml_dir={job}", "con=null", "con0=fd:0,fd:1", "panic=1"]
        say("no vcan0 in this kernel: booting user-mode Linux, which has one")
        with (job / "console").open("wb") as console:
            guest = subprocess.Popen(
                boot, stdin=subprocess.DEVNULL, stdout=console, stderr=console, start_new_session=True, env=os.environ | {"TMPDIR": folder}
            )
            try:
                follow(guest, job)
            finally:
                if guest.poll() is None:
                    os.killpg(guest.pid, signal.SIGKILL)
                    guest.wait()
        if (job / "exit").exists():
            return int((job / "exit").read_text())
        screen = (job / "console").read_text(encoding="utf-8", errors="replace").strip().splitlines()[-12:]
        if (job / "output").exists():
            say(f"user-mode Linux was stopped before the tests ended (limit {TEST_LIMIT:g} s); its console:")
            print("\n".join(screen), flush=True)
            return 1
        why = "; ".join(screen[-3:]) or f"exit code {guest.returncode}"
        if (job / "failed").exists():
            why = (job / "failed").read_text().strip()
        return skipped(f"user-mode Linux did not come up here: {why}")


def follow(guest: subprocess.Popen[bytes], job: Path) -> None:
    """Print the tests' output as it grows, until the guest has ended or a limit is exceeded."""
    started, shown, output = time.monotonic(), 0, job / "output"
    while True:
        ended = guest.poll() is not None or (job / "exit").exists()
        if output.exists():
            with output.open("rb") as f:
                f.seek(shown)
                text = f.read()
            shown += len(text)
            sys.stdout.write(text.decode("utf-8", "replace"))
            sys.stdout.flush()
        if ended:
            return
        waited = time.monotonic() - started
        if waited > TEST_LIMIT or (waited > BOOT_LIMIT and not output.exists()):
            return
        time.sleep(0.2)


def main(arguments: list[str]) -> int:
    """Run the marked tests where they can be run; return the exit code."""
    if not sys.platform.startswith("linux"):
        return skipped(f"SocketCAN is part of Linux; this is {sys.platform}")
    here = is_up()
    why = install(CAN_UTILS if here else INSIDE)
    if why is not None:
        return skipped(why if here else f"this kernel has no {INTERFACE}, and user-mode Linux {why}")
    say("compiling what is not compiled yet")
    warm_up()
    if not here:
        return in_user_mode_linux(arguments)
    say(f"tests on this machine's {INTERFACE}")
    return subprocess.run(command(arguments), check=False, cwd=ROOT, env=os.environ | {"VANELOOP_NEED_VCAN": "1"}).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
