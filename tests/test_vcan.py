"""A real vcan0 for the tests: which way is taken, what is said where none leads there, and what a kernel that fails
makes of the run.
"""

from __future__ import annotations

import io
import lzma
import os
import re
import signal
import subprocess
import sys
import tarfile
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.vcan import run
from tests.vcan.run import Kernel, Outcome

Boot = Callable[..., Outcome]

# What a booted kernel does with the folder of its job (init.sh), played by a shell on this machine.
UP = 'echo "collected 3 items" >"$JOB/output"\n'
PASSED = UP + 'echo 0 >"$JOB/part"; mv "$JOB/part" "$JOB/exit"\n'


@pytest.fixture(autouse=True)
def nothing_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("VANELOOP_CAN", "VANELOOP_NEED_VCAN", "VANELOOP_NOT_TESTED"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def boot(tmp_path: Path) -> Boot:
    """Boot a kernel that is this shell script; $JOB is the folder of its job."""

    def boot(script: str, **more: object) -> Outcome:
        job = tmp_path / "job"
        job.mkdir(exist_ok=True)
        settings = {"boot_limit": 60.0, "test_limit": 60.0} | more
        return run.in_guest(Kernel("the kernel", ["env", f"JOB={job}", "sh", "-c", script], **settings), [], job)

    return boot


@pytest.fixture
def ways(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """Give each way the outcome named; the list returned fills with the ways tried."""

    def replace(**outcomes: Outcome) -> list[str]:
        tried: list[str] = []

        def way(name: str) -> Callable[[list[str]], Outcome]:
            return lambda arguments: (tried.append(name), outcomes[name])[1]

        monkeypatch.setattr(run, "WAYS", {name: way(name) for name in run.WAYS})
        return tried

    return replace


def no(name: str) -> Outcome:
    return Outcome(None, f"no {name} here")


# ---- which way -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("outcomes", "tried", "code"),
    [
        ({"host": Outcome(0)}, ["host"], 0),
        ({"host": no("host"), "uml": Outcome(0)}, ["host", "uml"], 0),
        ({"host": no("host"), "uml": no("uml"), "qemu": Outcome(0)}, ["host", "uml", "qemu"], 0),
        ({"host": no("host"), "uml": no("uml"), "qemu": Outcome(1)}, ["host", "uml", "qemu"], 1),
        ({"host": no("host"), "uml": no("uml"), "qemu": no("qemu")}, ["host", "uml", "qemu"], 0),
        ({"host": Outcome(1)}, ["host"], 1),  # a test failed: no other way makes that good
        ({"host": no("host"), "uml": Outcome(1, "died in the midst of the tests")}, ["host", "uml"], 1),
        ({"host": no("host"), "uml": Outcome(5)}, ["host", "uml"], 5),  # no test at all was collected
    ],
)
def test_the_first_way_that_gets_to_the_tests_decides(
    ways, outcomes: dict[str, Outcome], tried: list[str], code: int
) -> None:
    took = ways(**outcomes)
    assert run.main([]) == code
    assert took == tried


@pytest.mark.parametrize("way", ["host", "uml", "qemu"])
def test_a_way_asked_for_is_the_only_one_and_must_lead_there(ways, monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    monkeypatch.setenv("VANELOOP_CAN", way)
    tried = ways(**{way: Outcome(0)})
    assert run.main([]) == 0 and tried == [way]
    ways(**{way: no(way)})
    assert run.main([]) == 1, "who asks for a way wants to know that it failed"


def test_an_unknown_way_is_one_line_and_exit_code_2(
    ways, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("VANELOOP_CAN", "vmware")
    tried = ways()
    assert run.main([]) == 2 and tried == []
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1
    assert "VANELOOP_CAN='vmware'" in said.err and "host, uml, qemu" in said.err


# ---- what is said at the end -----------------------------------------------------------------------------------------


def test_no_vcan0_at_all_is_said_in_the_last_lines_with_every_reason(ways, capsys: pytest.CaptureFixture[str]) -> None:
    ways(host=no("host"), uml=no("uml"), qemu=no("qemu"))
    assert run.main([]) == 0
    said = capsys.readouterr().out.rstrip().splitlines()
    first = next(k for k, line in enumerate(said) if "NOT TESTED ON A REAL vcan0: ANYTHING" in line)
    assert ["no host here" in said[first + 1], "no uml here" in said[first + 2], "no qemu here" in said[first + 3]] == [
        True
    ] * 3
    assert said[-1] == "!" * 100 and first + 3 == len(said) - 2, "nothing stands below"


def test_where_the_run_is_there_for_these_tests_not_running_them_is_a_failure(
    ways, monkeypatch: pytest.MonkeyPatch
) -> None:
    ways(host=no("host"), uml=no("uml"), qemu=no("qemu"))
    monkeypatch.setenv("VANELOOP_NEED_VCAN", "1")
    assert run.main([]) == 1


def test_what_only_the_short_list_leaves_out_is_said_with_the_reason(ways, capsys: pytest.CaptureFixture[str]) -> None:
    ways(host=no("host"), uml=no("uml"), qemu=Outcome(0, untested=("test_socketcan.py::test_a: would judge time",)))
    assert run.main([]) == 0
    said = capsys.readouterr().out.split("!" * 100)[1]
    assert (
        "NOT TESTED ON A REAL vcan0" in said
        and "no uml here" in said
        and "test_socketcan.py::test_a: would judge time" in said
    )


def test_what_pytest_skipped_before_is_said_in_the_last_lines(
    ways, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "skipped").write_text("tests/test_web.py: no Chromium (12 tests)\n")
    monkeypatch.setenv("VANELOOP_NOT_TESTED", str(tmp_path / "skipped"))
    ways(host=Outcome(0))
    assert run.main([]) == 0
    assert (
        "NOT TESTED, TESTS SKIPPED:\n!!   - tests/test_web.py: no Chromium (12 tests)\n!!!" in capsys.readouterr().out
    )


def test_a_whole_run_says_nothing_loud(ways, capsys: pytest.CaptureFixture[str]) -> None:
    ways(host=Outcome(0))
    assert run.main([]) == 0
    assert "NOT TESTED" not in capsys.readouterr().out


@pytest.mark.slow
def test_skipped_and_left_out_tests_are_written_down_by_pytest(tmp_path: Path) -> None:
    """With the project's own conftest.py: what is skipped, and under the short list what is left out."""
    told, tests = tmp_path / "told", tmp_path / "test_it.py"
    tests.write_text(
        "import pytest\n"
        "@pytest.mark.socketcan\n@pytest.mark.any_speed\n@pytest.mark.parametrize('k', [1, 2])\n"
        "def test_short(k): pytest.skip('no oil')\n"
        "@pytest.mark.socketcan\ndef test_long(): pass\n"
        "def test_of_no_bus(): pass\n"
    )
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "tests.conftest"]
    command += [
        "-c",
        str(run.ROOT / "pyproject.toml"),
        "--rootdir",
        str(tmp_path),
        "-m",
        "socketcan and any_speed",
        str(tests),
    ]
    environment = os.environ | {"VANELOOP_NOT_TESTED": str(told), "VANELOOP_NEED_VCAN": "1"}
    done = subprocess.run(
        command, cwd=run.ROOT, env=environment, check=False, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    first, second = told.read_text().splitlines()
    assert first == "test_it.py: no oil (2 tests)"
    assert second.startswith("test_it.py::test_long: would judge time")


def test_the_last_thing_make_test_all_does_is_to_say_what_was_not_tested() -> None:
    words = ["make", "--no-print-directory", "-n", "-o", "lint", "test-all"]
    done = subprocess.run(words, cwd=run.ROOT, check=True, capture_output=True, text=True, timeout=600)
    lines = done.stdout.strip().splitlines()
    before, _, other_tests = lines[-1].partition(" -m tests.vcan.run --beside ")
    assert "-m pytest " in other_tests, "what pytest does is run beside"
    written = before.split("VANELOOP_NOT_TESTED=")[1].split()[0]  # pytest writes what is read there
    assert any(line.startswith("rm -f") and line.endswith(written) for line in lines), (
        "nothing of an earlier run is told again"
    )


def test_what_make_test_leaves_make_test_all_runs() -> None:
    expressions = {}
    for target in ("test", "test-all"):
        words = ["make", "--no-print-directory", "-n", target]
        done = subprocess.run(words, cwd=run.ROOT, check=True, capture_output=True, text=True, timeout=600)
        expressions[target] = re.findall(r"-m pytest .* -m '([^']+)'", done.stdout)
    assert expressions == {"test": ["not slow and not socketcan"],
                           "test-all": ["(slow or hypothesis) and not socketcan"]}  # fmt: skip


INSIDE = """
import sys
from tests.vcan import run
def way(arguments):
    print("in the kernel")
    return run.Outcome({code}, untested=("no oil",))
run.WAYS = {{"host": way}}
sys.exit(run.main([]))
"""


@pytest.mark.parametrize(("other", "code", "ended"), [(0, 0, 0), (1, 0, 1), (0, 3, 3), (1, 3, 1)])
def test_what_ran_beside_a_command_is_shown_after_it_and_told_last(
    other: int,
    code: int,
    ended: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """The command writes what it skipped as its last deed; that stands below all else, and no exit code is lost."""
    told = tmp_path / "told"
    monkeypatch.setenv("VANELOOP_NOT_TESTED", str(told))
    monkeypatch.setattr(run, "may_go_first", lambda: True)
    monkeypatch.setattr(run, "ITSELF", [sys.executable, "-c", INSIDE.format(code=code)])
    command = f"sleep 0.2; echo all other tests; echo a.py: no fuel >{told}; exit {other}"
    assert run.beside(["sh", "-c", command]) == ended
    out = capfd.readouterr().out
    said = [out.index(x) for x in ("all other tests", "in the kernel", "no oil", "a.py: no fuel")]
    assert said == sorted(said)


def test_beside_others_no_kernel_is_booted_that_could_not_go_first(ways, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = ways(host=Outcome(5))
    monkeypatch.setattr(run, "may_go_first", lambda: False)
    assert run.beside(["sh", "-c", "exit 4"]) == 4 and tried == []
    assert run.beside(["true"]) == 5 and tried == ["host"]


@pytest.mark.parametrize(
    ("asked", "up", "user", "first"),
    [
        ("", False, 0, True),
        ("uml", True, 0, True),
        ("", True, 0, False),
        ("qemu", False, 0, False),
        ("", False, 7, False),
    ],
)
def test_only_a_kernel_of_its_own_and_only_root_s_goes_first(
    asked: str, up: bool, user: int, first: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VANELOOP_CAN", asked)
    monkeypatch.setattr(run, "is_up", lambda: up)
    monkeypatch.setattr(os, "geteuid", lambda: user)
    assert run.may_go_first() is first


# ---- a kernel that is booted -----------------------------------------------------------------------------------------


def test_a_failing_test_inside_fails_the_run(boot: Boot, capsys: pytest.CaptureFixture[str]) -> None:
    assert boot(UP + 'echo "1 failed" >>"$JOB/output"\necho 1 >"$JOB/part"; mv "$JOB/part" "$JOB/exit"').code == 1
    assert "1 failed" in capsys.readouterr().out


def test_what_was_skipped_inside_is_brought_back(boot: Boot) -> None:
    outcome = boot('echo "tests/test_socketcan.py: needs root" >"$JOB/not_tested"\n' + PASSED)
    assert outcome == Outcome(0, "", ("tests/test_socketcan.py: needs root",))


def test_a_short_list_is_never_taken_for_the_whole(boot: Boot) -> None:
    assert "ONLY THE SHORT LIST" in boot(PASSED, short=True).untested[0]
    assert boot(PASSED).untested == ()


def test_a_kernel_that_does_not_boot_is_told_with_its_last_words(boot: Boot) -> None:
    outcome = boot("echo 'ptrace set fp regs failed, errno = 14'; exit 1")
    assert outcome == Outcome(None, "the kernel did not come up here: ptrace set fp regs failed, errno = 14")


def test_a_kernel_that_says_why_it_cannot_run_the_tests_is_believed(boot: Boot) -> None:
    outcome = boot('echo "vcan0 could not be made" >"$JOB/failed"')
    assert outcome == Outcome(None, "the kernel did not come up here: vcan0 could not be made")


def test_a_kernel_that_dies_in_the_tests_is_a_failure(boot: Boot) -> None:
    outcome = boot(UP + "echo 'Kernel panic - not syncing'")
    assert outcome.code == 1 and outcome.why == "the kernel died in the midst of the tests: Kernel panic - not syncing"


def alive(pid: int) -> bool:
    """Whether the process runs; one that has ended but was not waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def ends(pid: int) -> bool:
    """Wait until the process is gone."""
    until = time.monotonic() + 60.0
    while alive(pid) and time.monotonic() < until:
        time.sleep(0.05)
    return not alive(pid)


def test_a_kernel_that_hangs_at_boot_is_stopped_and_was_not_a_way(boot: Boot, tmp_path: Path) -> None:
    outcome = boot('echo booting; sleep 600 & echo $! >"$JOB/pid"; wait', boot_limit=1.0)
    assert outcome == Outcome(None, "the kernel did not come up here within 1 s: booting")
    assert ends(int((tmp_path / "job" / "pid").read_text()))


def test_a_kernel_that_hangs_in_the_tests_is_stopped_and_is_a_failure(boot: Boot, tmp_path: Path) -> None:
    outcome = boot(UP + 'sleep 600 & echo $! >"$JOB/pid"; wait', test_limit=1.0)
    assert outcome.code == 1 and "was stopped: the tests took longer than 1 s" in outcome.why
    assert ends(int((tmp_path / "job" / "pid").read_text()))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_kernel_outlives_a_run_that_is_interrupted(tmp_path: Path, number: signal.Signals) -> None:
    if number == signal.SIGKILL and run.find("setpriv") is None:
        pytest.skip("setpriv (util-linux) is not installed")
    kernel = tmp_path / "linux.uml"
    kernel.write_text(
        f"#!/bin/sh\necho $$ >{tmp_path}/pid.part\nmv {tmp_path}/pid.part {tmp_path}/pid\nexec sleep 600\n"
    )
    kernel.chmod(0o755)
    code = (
        "import signal\nfrom tests.vcan import run\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a shell's job in the background ignores it
        "run.install = lambda wanted: None\nrun.warm_up = lambda *a, **k: None\n"
        f"run.find = lambda program: {str(kernel)!r} if program == 'linux.uml' else "
        f"__import__('shutil').which(program)\n"
        "run.handled()\n"
    )
    environment = os.environ | {"VANELOOP_CAN": "uml"}
    with subprocess.Popen(
        [sys.executable, "-c", code], cwd=run.ROOT, env=environment, stdout=subprocess.DEVNULL
    ) as runner:
        until = time.monotonic() + 120.0
        while not (tmp_path / "pid").exists():
            assert runner.poll() is None and time.monotonic() < until
            time.sleep(0.05)
        runner.send_signal(number)
        ended = runner.wait(timeout=600)
    assert ended == {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -9}[number]
    assert ends(int((tmp_path / "pid").read_text()))


# ---- what is needed for it -------------------------------------------------------------------------------------------


def test_what_cannot_be_installed_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(run, "is_up", lambda: False)
    monkeypatch.setattr(run, "find", lambda program: None)
    assert run.main([]) == 0
    said = capsys.readouterr().out
    for words in (
        "this machine's kernel has no vcan0",
        "user-mode Linux needs the Debian packages",
        "user-mode-linux",
        "qemu-system-x86",
    ):
        assert words in said.split("!" * 100)[1]


def test_another_processor_has_no_use_for_the_kernel_of_qemu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run.platform, "machine", lambda: "aarch64")
    outcome = run.in_qemu([])
    assert outcome.code is None and "aarch64" in outcome.why


def test_a_kernel_that_cannot_be_downloaded_is_a_reason_not_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused() -> Path:
        raise ValueError("apt-get download failed (E: Could not resolve 'deb.debian.org')")

    monkeypatch.setattr(run.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(run, "install", lambda wanted: None)
    monkeypatch.setattr(run, "kernel_parts", refused)
    outcome = run.in_qemu([])
    assert outcome.code is None and "could not be had: apt-get download failed" in outcome.why


def test_modules_of_the_kernel_are_taken_in_order_packed_or_not(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Debian 13 packs its modules with xz; busybox there reads them unpacked."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as archive:
        for name, data in (
            ("./boot/vmlinuz-6.12", b"kernel"),
            ("./bin/busybox", b"busybox"),
            ("./usr/lib/modules/6.12/kernel/drivers/net/can/vcan.ko.xz", lzma.compress(b"vcan")),
            ("./usr/lib/modules/6.12/kernel/fs/9p/9p.ko", b"9p"),
            ("./usr/lib/modules/6.12/kernel/fs/ext4/ext4.ko", b"ext4"),
        ):
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    (tmp_path / "package.deb").write_bytes(packed.getvalue())
    tools, parts = tmp_path / "bin", tmp_path / "parts"
    tools.mkdir()
    parts.mkdir()
    (tools / "dpkg-deb").write_text('#!/bin/sh\nexec cat "$2"\n')
    (tools / "dpkg-deb").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}{os.pathsep}{os.environ['PATH']}")
    run.take_apart(tmp_path / "package.deb", parts)
    held = {f.relative_to(parts).as_posix(): f.read_bytes() for f in parts.rglob("*") if f.is_file()}
    assert held == {
        "vmlinuz": b"kernel",
        "busybox": b"busybox",
        "modules/6.12/kernel/drivers/net/can/vcan.ko": b"vcan",
        "modules/6.12/kernel/fs/9p/9p.ko": b"9p",
    }
    (parts / "busybox").write_text("#!/bin/sh\nexec cat\n")  # prints the names it is given to pack
    (tmp_path / "job").mkdir()
    listed = run.initramfs(parts, tmp_path / "job").read_text().split()
    assert {"init", "bin/busybox", "modules/9p.ko", "modules/order"} <= set(listed)
    assert (tmp_path / "job" / "initramfs" / "modules" / "order").read_text() == "9p.ko"


def test_what_is_compiled_for_the_short_list_is_there() -> None:
    """A test that was renamed would compile nothing, in silence, and QEMU would not get going."""
    for test in run.EMBEDDED:
        file, name = test.split("::")
        assert f" {name}(" in (run.ROOT / file).read_text(encoding="utf-8"), test


def test_the_short_list_asks_for_its_marker_only() -> None:
    assert "socketcan and any_speed" in run.command([], short=True)
    assert "socketcan" in run.command([]) and "socketcan and any_speed" not in run.command([])
    assert "tests/test_socketcan.py" in run.command([]) and "tests/test_bus.py" in run.command([])
