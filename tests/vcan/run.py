"""Run the tests marked ``socketcan`` on a real vcan0, wherever one can be had. Ways, in this order:

    host  this machine's own vcan0
    uml   user-mode Linux: a kernel that runs as a program on the host's own files; all tests
    qemu  Debian's kernel in QEMU, every instruction emulated, on the host's own files; only the tests marked
          ``any_speed``

The last two boot a kernel that has CAN, run the tests there with this very checkout and Python environment, and bring
back what was printed and the exit code. Nothing of the host's kernel is touched. ``VANELOOP_CAN`` = host, uml or qemu
allows that way only. Arguments are handed to pytest::

    python -m tests.vcan.run [-k EXPRESSION ...]
    python -m tests.vcan.run --beside COMMAND ...

With ``--beside`` they are run while a command runs, which is `make test-all`'s other tests: they wait most of the time.
What they print is shown when the command has ended. That needs a kernel of their own which may go before ordinary work.
Where none can be had, they are run after the command, if it succeeds.

The last lines say in capitals what was not tested, and why. Exit code: pytest's; 1 where a kernel died or hung after
the tests had begun; 2 for a wrong ``VANELOOP_CAN``. Where no way leads to a vcan0: 0, or 1 with ``VANELOOP_CAN`` or
``VANELOOP_NEED_VCAN`` set.
"""

from __future__ import annotations

import contextlib
import hashlib
import lzma
import os
import platform
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, NoReturn

__all__ = ["main"]

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
INTERFACE = "vcan0"
MEMORY_MIB = 1536
CAN_UTILS = {
    "candump": "can-utils",
    "cansend": "can-utils",
    "cangen": "can-utils",
    "canplayer": "can-utils",
    "ip": "iproute2",
}
IN_UML = CAN_UTILS | {"linux.uml": "user-mode-linux", "insmod": "kmod"}
IN_QEMU = CAN_UTILS | {"qemu-system-x86_64": "qemu-system-x86", "insmod": "kmod", "dpkg-deb": "dpkg"}
KERNEL, BUSYBOX = "linux-image-amd64", "busybox-static"  # taken apart in a folder of ours, never installed
PCI = (
    "virtio_ring",
    "virtio",
    "virtio_pci_modern_dev",
    "virtio_pci_legacy_dev",
    "virtio_pci",
)  # modules, in the order of loading
FILES = (*PCI, "netfs", "fscache", "9pnet", "9pnet_virtio", "9p")
CAN = ("can", "can-raw", "can-bcm", "can-dev", "vcan")
APT_LIMIT, DOWNLOAD_LIMIT, WARM_LIMIT = 900.0, 900.0, 900.0  # s
ITSELF = [sys.executable, "-m", "tests.vcan.run"]
NUMBA = ("NUMBA_CACHE_DIR", "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "NUMBA_DISABLE_JIT")
HANDED_ON = (*NUMBA, "HOME", "LANG", "LC_ALL", "PYTHONPATH", "TERM", "VANELOOP_DATA", "VIRTUAL_ENV")
# Python runs, with what takes longest to load, and a socket can be had: from then on what fails is a test's failure,
# not the way's.
CHECK = f"import socket, numba; socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).bind(({INTERFACE!r},))"


class Outcome(NamedTuple):
    """How one way ended."""

    code: int | None  # exit code; None: it never got to the tests
    why: str = ""  # why it did not get to the tests, or what went wrong in them
    untested: tuple[str, ...] = ()  # lines: tests that were not run this way, and why


class Kernel(NamedTuple):
    """A kernel that can be booted with the host's files, and how long that may take on a machine that is slow
    and busy.
    """

    name: str
    command: list[str]
    boot_limit: float  # s, until Python runs; user-mode Linux takes a few seconds, QEMU half a minute
    test_limit: float  # s, for the tests; two to three minutes each
    short: bool = False  # only the tests marked any_speed
    first: bool = (
        False  # before ordinary work on this machine, where that is allowed: its controllers want to be on time
    )
    settings: dict[str, str] = {}  # of the environment inside


def say(text: str) -> None:
    """Print one line of progress, marked as ours."""
    print(f"[vaneloop] {text}", flush=True)


def loudly(lines: list[str]) -> None:
    """Print lines that nobody overlooks."""
    rule = "!" * 100
    print("\n".join(["", rule, *(f"!! {line}" for line in lines), rule]), flush=True)


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


def apt_get(*arguments: str, limit: float = APT_LIMIT, cwd: Path | None = None) -> str | None:
    """Run apt-get; None, or why it did not succeed. Another apt-get at work is waited for."""
    command = ["apt-get", "-qq", "-o", "DPkg::Lock::Timeout=300", *arguments]
    environment = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
    try:
        done = subprocess.run(
            command,
            check=False,
            env=environment,
            capture_output=True,
            text=True,
            timeout=limit,
            cwd=cwd,
            stdin=subprocess.DEVNULL,
        )
    except subprocess.TimeoutExpired:
        return f"apt-get {arguments[0]} did not end within {limit / 60:g} min"
    if done.returncode:
        return f"apt-get {arguments[0]} failed ({(done.stderr.strip().splitlines() or ['no reason given'])[-1]})"
    return None


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
    apt_get("update")  # an old list may do: whether the packages can be had, the next line says
    why = apt_get("install", "-y", "--no-install-recommends", *packages)
    still = sorted(program for program in wanted if find(program) is None)
    return f"{missing}; {why or 'apt-get installed them without ' + ' '.join(still)}" if why or still else None


def memory_folder() -> str | None:
    """A folder that can hold user-mode Linux's memory: room for it, and mappings from it may be executed."""
    for folder in dict.fromkeys([os.environ.get("TMPDIR", "/dev/shm"), "/dev/shm", "/tmp", "/var/tmp"]):
        try:
            stat = os.statvfs(folder)
        except OSError:
            continue
        if (
            not stat.f_flag & os.ST_NOEXEC
            and stat.f_bavail * stat.f_frsize > MEMORY_MIB * 2**20
            and os.access(folder, os.W_OK)
        ):
            return folder
    return None


def command(arguments: list[str], *, short: bool = False) -> list[str]:
    """The pytest command; only files that carry the marker, since collecting the others takes longer than the tests."""
    marked = sorted(f for f in (ROOT / "tests").glob("test_*.py") if "mark.socketcan" in f.read_text(encoding="utf-8"))
    files = [f.relative_to(ROOT).as_posix() for f in marked]
    mark = "socketcan and any_speed" if short else "socketcan"
    return [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-m", mark, "--durations=5", *arguments, *files]


def warm_up(*commands: list[str], settings: dict[str, str] | None = None) -> None:
    """Compile, on the host's processors, what the tests inside will find in the cache: there it would take minutes."""
    say("compiling what is not compiled yet")
    for arguments in commands:
        try:
            subprocess.run(
                [sys.executable, "-m", *arguments], cwd=ROOT, check=False, env=os.environ | (settings or {}),
                timeout=WARM_LIMIT,
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            say(f"stopped after {WARM_LIMIT:g} s: {shlex.join(arguments)}")


LOOPS = (
    ["vaneloop.cli.main", "run", "--bus", "lockstep", "--duration", "0.1", "--quiet"],
    ["hil.inject", "demand_gap_40ms", "--quiet"],
    ["hil.replay", "examples/engine_run.blf", "--quiet"],
)
# The short list's twins on the embedded bus: what they compile is what the short list needs.
EMBEDDED = (
    "tests/test_bus.py::TestLocal",
    "tests/test_realtime.py::test_controller_and_ecu_as_two_processes_on_the_embedded_bus",
)


# ---- ways to a vcan0 -------------------------------------------------------------------------------------------------


def on_this_machine(arguments: list[str]) -> Outcome:
    """On the host's own vcan0."""
    if not is_up():
        return Outcome(None, f"this machine's kernel has no {INTERFACE}, or it is down")
    why = install(CAN_UTILS)
    if why is not None:
        return Outcome(None, f"this machine's {INTERFACE}: {why}")
    warm_up(*LOOPS)
    say(f"tests on this machine's {INTERFACE}")
    with tempfile.TemporaryDirectory(prefix="vaneloop-vcan-") as name:
        told = Path(name) / "not_tested"
        settings = {"VANELOOP_NEED_VCAN": "1", "VANELOOP_NOT_TESTED": str(told)}
        done = subprocess.run(command(arguments), check=False, cwd=ROOT, env=os.environ | settings)
        return Outcome(done.returncode, untested=lines_of(told))


def in_user_mode_linux(arguments: list[str]) -> Outcome:
    """Inside user-mode Linux."""
    why = install(IN_UML)
    if why is not None:
        return Outcome(None, f"user-mode Linux {why}")
    folder = memory_folder()
    if folder is None:
        return Outcome(
            None,
            f"user-mode Linux needs {MEMORY_MIB} MiB in a folder from which code may run (/dev/shm, /tmp or TMPDIR)",
        )
    warm_up(*LOOPS)
    with tempfile.TemporaryDirectory(prefix="vaneloop-uml-") as name:
        job = Path(name)
        boot = [
            str(find("linux.uml")),
            f"mem={MEMORY_MIB}M",
            "root=/dev/root",
            "rootfstype=hostfs",
            "rootflags=/",
            "rw",
            "quiet",
        ]
        boot += [
            f"init={job}/init.sh",
            f"VANELOOP_JOB={job}",
            "VANELOOP_MODULES=/usr/lib/uml/modules",
            f"uml_dir={job}",
        ]
        boot += ["con=null", "con0=fd:0,fd:1", "panic=1"]
        return in_guest(
            Kernel("user-mode Linux", ["env", f"TMPDIR={folder}", *boot], 300.0, 2400.0, first=True), arguments, job
        )


def in_qemu(arguments: list[str]) -> Outcome:
    """Inside QEMU, without the help of the processor: -accel kvm hangs inside some virtual machines that show
    /dev/kvm.
    """
    if platform.machine() != "x86_64":
        return Outcome(
            None, f"QEMU: the kernel booted there needs x86-64 programs; this machine is {platform.machine()}"
        )
    why = install(IN_QEMU)
    if why is not None:
        return Outcome(None, f"QEMU {why}")
    try:
        parts = kernel_parts()
    except (OSError, subprocess.SubprocessError, tarfile.TarError, ValueError) as error:
        return Outcome(None, f"QEMU: the kernel to boot there could not be had: {error}")
    # Host and guest share compiled code only for a processor that both have; without that the guest compiles for many
    # minutes.
    processor = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    warm_up(["pytest", "-p", "no:cacheprovider", *EMBEDDED], settings=processor | {"VANELOOP_NOT_TESTED": ""})
    with tempfile.TemporaryDirectory(prefix="vaneloop-qemu-") as name:
        job = Path(name)
        boot = [
            str(find("qemu-system-x86_64")),
            "-accel",
            "tcg,thread=multi",
            "-cpu",
            "max",
            "-smp",
            "2",
            "-m",
            f"{MEMORY_MIB}",
        ]
        boot += ["-nodefaults", "-no-user-config", "-display", "none", "-serial", "stdio", "-no-reboot"]
        boot += ["-kernel", str(parts / "vmlinuz"), "-initrd", str(initramfs(parts, job))]
        told = f"VANELOOP_JOB={job} VANELOOP_MODULES={parts}/modules"
        # An emulated clock ticks too seldom on a busy machine for the kernel's test of it, which stops the boot.
        boot += ["-append", f"console=ttyS0 quiet panic=1 no_timer_check mitigations=off nokaslr {told}"]
        for tag, path in (("host", "/"), ("job", str(job))):
            boot += ["-virtfs", f"local,path={path},mount_tag={tag},security_model=none,multidevs=remap"]
        inside = processor | {"TMPDIR": "/run/tmp"}
        return in_guest(Kernel("QEMU", boot, 600.0, 2400.0, short=True, settings=inside), arguments, job)


WAYS: dict[str, Callable[[list[str]], Outcome]] = {"host": on_this_machine, "uml": in_user_mode_linux, "qemu": in_qemu}


# ---- what QEMU boots -------------------------------------------------------------------------------------------------


def kernel_parts() -> Path:
    """Folder with Debian's kernel (vmlinuz), the modules that are wanted of it, and a static busybox; downloaded on
    first use.
    """
    folder = ROOT / "out" / "vcan" / hashlib.sha256(" ".join([KERNEL, *FILES, *CAN]).encode()).hexdigest()[:8]
    if folder.exists():
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="making-", dir=folder.parent) as name:
        parts = Path(name) / "parts"
        parts.mkdir()
        package = kernel_package()
        say(
            f"downloading {package} and {BUSYBOX}, some 70 MB, into {folder.parent.relative_to(ROOT)} (nothing is "
            f"installed of them)"
        )
        take_apart(fetch(package, Path(name)), parts)
        take_apart(fetch(BUSYBOX, Path(name)), parts)
        lacking = [f for f in ("vmlinuz", "busybox", "modules") if not (parts / f).exists()]
        if lacking:
            raise ValueError(f"no {' and no '.join(lacking)} in the packages {package} and {BUSYBOX}")
        parts.rename(folder)
    return folder


def kernel_package() -> str:
    """Name of the package that holds today's kernel: the one that Debian's linux-image-amd64 depends on."""
    for again in (False, True):
        if again and (os.geteuid() != 0 or apt_get("update") is not None):
            break
        done = subprocess.run(
            ["apt-cache", "depends", KERNEL], check=False, capture_output=True, text=True, timeout=120
        )
        names = [
            line.split()[1] for line in done.stdout.splitlines() if line.strip().startswith("Depends: linux-image-")
        ]
        if names:
            return names[0]
    raise ValueError(f"the package lists have no {KERNEL} (Debian's); apt-get update may help")


def fetch(package: str, folder: Path) -> Path:
    """Download a package into a folder of its own; with fresh lists, if the old ones name a version that is gone."""
    into = folder / package
    into.mkdir()
    why = apt_get("download", package, cwd=into, limit=DOWNLOAD_LIMIT)
    if why is not None and os.geteuid() == 0 and apt_get("update") is None:
        why = apt_get("download", package, cwd=into, limit=DOWNLOAD_LIMIT)
    found = sorted(into.glob("*.deb"))
    if why is not None or not found:
        raise ValueError(why or f"apt-get download {package} brought nothing")
    return found[0]


def take_apart(package: Path, into: Path) -> None:
    """Write what is wanted of a Debian package: boot/vmlinuz-*, bin/busybox, and modules as
    modules/VERSION/kernel/...
    """
    wanted = {*FILES, *CAN}
    with subprocess.Popen(["dpkg-deb", "--fsys-tarfile", str(package)], stdout=subprocess.PIPE) as unpacked:
        assert unpacked.stdout is not None
        with tarfile.open(fileobj=unpacked.stdout, mode="r|") as archive:
            for member in archive:
                path = Path(member.name)
                held = archive.extractfile(member) if member.isfile() else None
                if held is None:
                    continue
                if path.name.startswith("vmlinuz-"):
                    (into / "vmlinuz").write_bytes(held.read())
                elif path.parts[-2:] == ("bin", "busybox"):
                    (into / "busybox").write_bytes(held.read())
                    (into / "busybox").chmod(0o755)
                elif path.name.split(".")[0] in wanted and ".ko" in path.suffixes and "modules" in path.parts:
                    target = into.joinpath(*path.parts[path.parts.index("modules") :]).with_name(
                        path.name.split(".")[0] + ".ko"
                    )
                    target.parent.mkdir(parents=True, exist_ok=True)
                    target.write_bytes(lzma.decompress(held.read()) if path.suffix == ".xz" else held.read())
    if unpacked.returncode:
        raise ValueError(f"{package.name} is no whole package (dpkg-deb: exit code {unpacked.returncode})")


def initramfs(parts: Path, job: Path) -> Path:
    """Write QEMU's first files: busybox, the modules for the host's files in the order of loading, and initramfs.sh."""
    tree = job / "initramfs"
    for folder in ("bin", "modules", "proc", "host", "dev"):
        (tree / folder).mkdir(parents=True)
    shutil.copy(parts / "busybox", tree / "bin" / "busybox")
    shutil.copy(HERE / "initramfs.sh", tree / "init")
    (tree / "init").chmod(0o755)
    modules = [
        f for name in FILES for f in (parts / "modules").rglob(f"{name}.ko")
    ]  # later kernels have some of them built in
    for f in modules:
        shutil.copy(f, tree / "modules" / f.name)
    (tree / "modules" / "order").write_text("\n".join(f.name for f in modules), encoding="ascii")
    names = "\n".join(f.relative_to(tree).as_posix() for f in sorted(tree.rglob("*")))
    packed = job / "initramfs.cpio"
    with packed.open("wb") as out:
        subprocess.run(
            [parts / "busybox", "cpio", "-o", "-H", "newc"], cwd=tree, input=names.encode(), stdout=out,
            stderr=subprocess.DEVNULL,
            check=True, timeout=120,
        )  # fmt: skip
    return packed


# ---- a booted kernel -------------------------------------------------------------------------------------------------


def in_guest(kernel: Kernel, arguments: list[str], job: Path) -> Outcome:
    """Boot, run the tests inside, print what they print, halt. ``job`` is the folder over which host and guest speak
    (init.sh).
    """
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])
    settings = {k: os.environ[k] for k in HANDED_ON if k in os.environ} | {"PATH": path, **kernel.settings}
    settings |= {"VANELOOP_NEED_VCAN": "1", "VANELOOP_NOT_TESTED": f"{job}/not_tested"}
    settings |= {"PYTHONDONTWRITEBYTECODE": "1"}  # of a module that is just written into the share half may be read
    exports = "".join(f"export {k}={shlex.quote(v)}\n" for k, v in settings.items())
    for file, inside in (("check", [sys.executable, "-c", CHECK]), ("command", command(arguments, short=kernel.short))):
        (job / file).write_text(
            f"{exports}cd {shlex.quote(str(ROOT))} || exit 9\nexec {shlex.join(inside)}\n", encoding="utf-8"
        )
    shutil.copy(HERE / "init.sh", job / "init.sh")
    (job / "init.sh").chmod(0o755)
    say(f"booting {kernel.name}, which has a {INTERFACE}")
    # should this process be killed, the kernel it booted goes with it
    tied = ["setpriv", "--pdeathsig", "KILL"] if find("setpriv") else []
    with (job / "console").open("wb") as console:
        guest = subprocess.Popen(
            [*tied, *kernel.command], stdin=subprocess.DEVNULL, stdout=console, stderr=console, start_new_session=True
        )
        if kernel.first:
            put_first(guest)
        try:
            hung = follow(guest, job, kernel)
        finally:
            if guest.poll() is None:
                os.killpg(guest.pid, signal.SIGKILL)
                guest.wait()
    untested = lines_of(job / "not_tested")
    if kernel.short:
        untested = (
            f"{kernel.name} EMULATES THE PROCESSOR: ONLY THE SHORT LIST WAS RUN, THE TESTS MARKED any_speed",
            *untested,
        )
    if (job / "exit").exists():
        return Outcome(int((job / "exit").read_text()), untested=untested)
    screen = [
        line for line in (job / "console").read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()
    ]
    last_words = "; ".join(line.strip() for line in screen[-3:]) or f"exit code {guest.returncode}"
    if (job / "output").exists():
        limit = f"was stopped: the tests took longer than {kernel.test_limit:g} s"
        return Outcome(
            1, f"{kernel.name} {limit if hung else 'died in the midst of the tests'}: {last_words}", untested
        )
    if (job / "failed").exists():
        last_words = (job / "failed").read_text(encoding="utf-8", errors="replace").strip()
    ended = f"did not come up here within {kernel.boot_limit:g} s" if hung else "did not come up here"
    return Outcome(None, f"{kernel.name} {ended}: {last_words}")


def put_first(guest: subprocess.Popen[bytes]) -> None:
    """Let a guest and all it starts run before ordinary work, where this user may ask for it, and on one processor.

    A real-time class would not do: what has it is stopped for 50 ms in every second in which it is busy. User-mode
    Linux hands over between two processes at each call of a guest's program: on one processor that is quick, between
    two that had gone to sleep it is not.
    """
    with contextlib.suppress(OSError):
        os.sched_setaffinity(guest.pid, {max(os.sched_getaffinity(0))})
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, guest.pid, -20)
        Path(f"/proc/{guest.pid}/autogroup").write_text(
            "-20"
        )  # where each session has its share, a process's priority counts within


def follow(guest: subprocess.Popen[bytes], job: Path, kernel: Kernel) -> bool:
    """Print the tests' output as it grows, until the guest has ended; return True if a limit was exceeded before."""
    started, begun, shown, output = time.monotonic(), None, 0, job / "output"
    while True:
        ended = guest.poll() is not None or (job / "exit").exists()
        now = time.monotonic()
        if output.exists():
            if begun is None:
                begun = now
                say(f"{kernel.name} is up: {INTERFACE} and Python work after {now - started:.0f} s")
            with output.open("rb") as f:
                f.seek(shown)
                text = f.read()
            shown += len(text)
            sys.stdout.write(text.decode("utf-8", "replace"))
            sys.stdout.flush()
        if ended:
            return False
        if now - started > kernel.boot_limit if begun is None else now - begun > kernel.test_limit:
            return True
        time.sleep(0.2)


# ---- decision --------------------------------------------------------------------------------------------------------


def lines_of(file: Path) -> tuple[str, ...]:
    """Lines of a file of tests that were skipped (conftest.py); none where there is no such file."""
    return tuple(file.read_text(encoding="utf-8").splitlines()) if file.is_file() else ()


def conclude(outcome: Outcome, before: list[str], *, forced: bool) -> int:
    """Say as the last lines what was not tested; return the exit code. ``before``: why the ways tried before did not
    lead there.
    """
    if os.environ.get("VANELOOP_BESIDE"):
        sys.stdin.read()  # ends with the command that this ran beside
    earlier = lines_of(
        Path(os.environ.get("VANELOOP_NOT_TESTED") or os.devnull)
    )  # what pytest skipped before, in `make test-all`
    lines: list[str] = []
    if outcome.code is None:
        lines += [
            f"NOT TESTED ON A REAL {INTERFACE}: ANYTHING. NONE OF THE SOCKETCAN TESTS WAS RUN, because:",
            *(f"  {w}" for w in before),
        ]
    elif outcome.why:
        lines += ["THE SOCKETCAN TESTS FAILED:", f"  {outcome.why}"]
    if outcome.untested:
        because = [f"  {w}" for w in before]
        lines += [f"NOT TESTED ON A REAL {INTERFACE}:", *because, *(f"  - {u}" for u in outcome.untested)]
    if earlier:
        lines += ["NOT TESTED, TESTS SKIPPED:", *(f"  - {e}" for e in earlier)]
    if lines:
        loudly(lines)
    if outcome.code is None:
        return 1 if forced or os.environ.get("VANELOOP_NEED_VCAN") else 0
    return outcome.code


def may_go_first() -> bool:
    """Whether a kernel of user-mode Linux would be on time beside other work (`put_first`): as root, where the way is
    not the host's own ``vcan0``.
    """
    asked = os.environ.get("VANELOOP_CAN", "")
    return (asked or ("host" if is_up() else "uml")) == "uml" and sys.platform.startswith("linux") and os.geteuid() == 0


def beside(words: list[str]) -> int:
    """Run a command, and the marked tests in a process beside it; return the command's exit code, or else theirs.

    That process says last what was not tested, so it waits with that until this one has closed its input.
    """
    if not may_go_first():
        return subprocess.run(words, check=False).returncode or main([])
    with tempfile.TemporaryFile() as printed:
        tests = subprocess.Popen(
            ITSELF, cwd=ROOT, env=os.environ | {"VANELOOP_BESIDE": "1"},
            stdin=subprocess.PIPE, stdout=printed, stderr=printed,
        )  # fmt: skip
        try:
            code = subprocess.run(words, check=False).returncode
            if tests.poll() is None:
                say(f"tests on a {INTERFACE}, which began beside the others")
            tests.communicate()
        finally:
            if tests.poll() is None:
                tests.terminate()
                tests.wait()
        printed.seek(0)
        sys.stdout.write(printed.read().decode("utf-8", "replace"))
        sys.stdout.flush()
    return code or tests.returncode


def stopped(number: int, frame: object) -> NoReturn:
    """End by a signal as by Ctrl-C: what was booted is ended first."""
    raise SystemExit(128 + number)


def main(arguments: list[str]) -> int:
    """Run the marked tests where they can be run; return the exit code."""
    wanted = os.environ.get("VANELOOP_CAN", "")
    if wanted and wanted not in WAYS:
        print(
            f"VANELOOP_CAN={wanted!r} is not known; allowed: {', '.join(WAYS)}, or nothing for the first that works",
            file=sys.stderr,
        )
        return 2
    before: list[str] = []
    outcome = Outcome(None, f"SocketCAN is part of Linux; this is {sys.platform}")
    if not sys.platform.startswith("linux"):
        return conclude(outcome, [outcome.why], forced=bool(wanted))
    for way in [wanted] if wanted else WAYS:
        outcome = WAYS[way](arguments)
        if outcome.code is not None:
            break
        say(outcome.why)
        before.append(outcome.why)
    return conclude(outcome, before, forced=bool(wanted))


def handled() -> NoReturn:
    """Run as a command: a signal ends what was booted, too."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, stopped)
    try:
        arguments = sys.argv[1:]
        sys.exit(beside(arguments[1:]) if arguments[:1] == ["--beside"] else main(arguments))
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    handled()
