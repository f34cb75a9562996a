"""Where the tests on a real vcan0 cannot be run, that is said, not hidden."""

from __future__ import annotations

import os

import pytest

from tests.uml import run


def test_what_cannot_be_installed_is_named_loudly(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delenv("VANELOOP_NEED_VCAN", raising=False)
    monkeypatch.setattr(run, "is_up", lambda: False)
    monkeypatch.setattr(run, "find", lambda program: None)
    assert run.main([]) == 0
    said = capsys.readouterr().out
    assert "!! SOCKETCAN TESTS NOT RUN: this kernel has no vcan0, and user-mode Linux needs the Debian packages" in said
    assert "user-mode-linux" in said and "can-utils" in said


def test_a_kernel_that_does_not_boot_is_told_with_its_last_words(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path
) -> None:
    broken = tmp_path / "linux.uml"
    broken.write_text("#!/bin/sh\necho 'Kernel panic - not syncing'\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("VANELOOP_NEED_VCAN", "1")
    monkeypatch.setattr(run, "find", lambda program: str(broken))
    assert run.in_user_mode_linux([]) == 1, "where the run is there for these tests, not running them is a failure"
    assert "did not come up here: Kernel panic - not syncing" in capsys.readouterr().out


def test_a_guest_that_hangs_is_stopped(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path) -> None:
    hanging = tmp_path / "linux.uml"
    hanging.write_text(f"#!/bin/sh\necho $$ >{tmp_path}/pid\necho booting\nsleep 60 & wait\n")
    hanging.chmod(0o755)
    monkeypatch.delenv("VANELOOP_NEED_VCAN", raising=False)
    monkeypatch.setattr(run, "find", lambda program: str(hanging))
    monkeypatch.setattr(run, "BOOT_LIMIT", 0.5)
    assert run.in_user_mode_linux([]) == 0
    assert "did not come up here: booting" in capsys.readouterr().out
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)
