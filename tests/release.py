"""``python -m tests.release``: builds the source archive and the wheel of the commit into dist/, and tries both.

What is checked: the changelog has a heading for the version; the wheel that the source archive builds holds, byte for
byte, what the wheel of the checkout holds; in an empty environment and a foreign folder the installed command tells its
version and replays a log. Exit code: 1 where one of these fails, with a line that says which.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import venv
import zipfile
from pathlib import Path

from tests.vcan.run import ROOT, say

__all__ = ["ReleaseError", "contents", "differing", "main"]

DIST = ROOT / "dist"
LOG = "engine_run.blf"


class ReleaseError(Exception):
    """What is wrong with the release."""


def contents(wheel: Path) -> dict[str, str]:
    """Digest of every file in a wheel, by its name."""
    with zipfile.ZipFile(wheel) as archive:
        return {name: hashlib.sha256(archive.read(name)).hexdigest() for name in archive.namelist()}


def differing(a: dict[str, str], b: dict[str, str]) -> list[str]:
    """Names of files that one wheel lacks or has otherwise than the other."""
    return sorted(name for name in a.keys() | b.keys() if a.get(name) != b.get(name))


def run(*command: str | Path, cwd: Path = ROOT, **environment: str) -> str:
    """What a command prints; ReleaseError where it fails."""
    surroundings = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")} | environment
    words = [str(w) for w in command]
    done = subprocess.run(words, cwd=cwd, env=surroundings, capture_output=True, text=True, check=False)
    if done.returncode:
        said = f"{done.stdout[-2000:]}{done.stderr[-2000:]}"
        raise ReleaseError(f"{' '.join(words)}: exit code {done.returncode}\n{said}")
    return done.stdout


def build(folder: Path, version: str) -> tuple[Path, Path]:
    """Source archive and wheel of the commit, the wheel built from the source archive, in ``folder``/dist."""
    checkout = folder / "checkout"
    checkout.mkdir()
    if run("git", "status", "--porcelain"):
        say("the checkout has changes that are not committed; they are not in the release")
    run("git", "archive", "--output", folder / "commit.tar", "HEAD")
    with tarfile.open(folder / "commit.tar") as archive:
        archive.extractall(checkout, filter="data")
    pins = {"PIP_CONSTRAINT": str(ROOT / "constraints.txt")}
    say("building the source archive, and the wheel from it")
    run(sys.executable, "-m", "build", "--outdir", folder / "dist", checkout, **pins)
    say("building the wheel of the checkout, to compare")
    run(sys.executable, "-m", "build", "--wheel", "--outdir", folder / "direct", checkout, **pins)
    name = f"vaneloop-{version}"
    wheel, archive_file = folder / "dist" / f"{name}-py3-none-any.whl", folder / "dist" / f"{name}.tar.gz"
    if differ := differing(contents(wheel), contents(folder / "direct" / wheel.name)):
        raise ReleaseError(f"the source archive builds another wheel than the checkout: {', '.join(differ[:10])}")
    return archive_file, wheel


def try_out(folder: Path, wheel: Path, version: str) -> None:
    """Install the wheel into an empty environment and run it where no sources are."""
    away = folder / "away"
    away.mkdir()
    shutil.copy(ROOT / "examples" / LOG, away)
    say("installing the wheel into an empty environment")
    venv.create(folder / "env", with_pip=True)
    python, command = folder / "env" / "bin" / "python", folder / "env" / "bin" / "vaneloop"
    run(python, "-m", "pip", "install", "--quiet", "--no-compile", wheel, PIP_CONSTRAINT=str(ROOT / "constraints.txt"))
    for told in (run(command, "--version", cwd=away), run(python, "-m", "vaneloop", "--version", cwd=away)):
        if told != f"vaneloop {version}\n":
            raise ReleaseError(f"--version says {told!r}, not 'vaneloop {version}'")
    if (told := run(python, "-c", "import vaneloop; print(vaneloop.__version__)", cwd=away).strip()) != version:
        raise ReleaseError(f"vaneloop.__version__ is {told!r}, not {version!r}")
    say(f"vaneloop replay {LOG}")
    told = run(command, "replay", LOG, "--json", "-", cwd=away, HOME=str(away))
    if '"vigv"' not in told:
        raise ReleaseError(f"vaneloop replay {LOG} tells no vane angle: {told[:500]}")


def main() -> int:
    """Build, check, and leave what passed in dist/; return the exit code."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    try:
        if f"## [{version}]" not in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"):
            raise ReleaseError(f"CHANGELOG.md has no heading '## [{version}]'")
        with tempfile.TemporaryDirectory() as name:
            made = build(Path(name), version)
            try_out(Path(name), made[1], version)
            DIST.mkdir(exist_ok=True)
            for file in made:
                shutil.copy(file, DIST)
                say(f"dist/{file.name}: {file.stat().st_size / 1e6:.1f} MB")
    except ReleaseError as e:
        print(f"release: {e}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
