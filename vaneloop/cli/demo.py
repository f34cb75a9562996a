"""``make demo``: the main job from end to end, with the commands a user would type."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

from vaneloop.base import terminal
from vaneloop.base.child import python_module
from vaneloop.cli.main import main as vaneloop

__all__ = ["main"]

ROOT = Path(__file__).resolve().parents[2]
OUT = Path("demo")
# what is made in OUT, and what it shows
MADE = {
    "engine_run.html": "a recorded run beside the same run through firmware and plant, signal by signal",
    "real_engine.html": "how the controller moves the vanes where a car's engine gives the demand",
    "engine_test.html": "the paper's engine test: errors of the vane angles under one mean curve and under dual curves",
    "diagnosis.html": "the search on the log that does not fit: which effects were tried, and which explain it",
    "extended.html": "the error before and after these effects are added",
    "extended.toml": "the model with these effects: vaneloop compare LOG --model demo/extended.toml",
}


def _shared_data() -> Path | None:
    """Folder of real logs, where there is one."""
    for place in (os.environ.get("VANELOOP_DATA"), ROOT.parent / "shared" / "data"):
        if place and (Path(place) / "can_honda" / "revlog.log").is_file():
            return Path(place)
    return None


def _step(text: str, *argv: str, allowed: tuple[int, ...] = (0,)) -> None:
    print(f"\n== {text}\n$ vaneloop {' '.join(argv)}", flush=True)
    sys.argv = ["vaneloop", *argv]
    code = vaneloop(list(argv))
    if code not in allowed:
        print(f"stopped: exit code {code}", file=sys.stderr)
        sys.exit(code)


def _simulate(example: str) -> None:
    """Runs through firmware and plant."""
    _step(
        "A recorded engine run (CAN log, from an independent simulator) through firmware and plant",
        "replay", example, "--report", str(OUT / "engine_run.html"),
    )  # fmt: skip
    data = _shared_data()
    if data is not None:
        folder = os.path.relpath(data / "can_honda")
        _step(
            "A real engine being revved (candump of a car), its speed as the demand",
            "replay", f"{folder}/revlog.log", "--dbc", f"{folder}/honda_pilot_2017.dbc", "--map", "ENGINE_RPM=n_dem",
            "--unit", "n_dem=rpm", "--design-rpm", "6000", "--report", str(OUT / "real_engine.html"),
        )  # fmt: skip
    _step(
        "The paper's engine test, 3,000 s under one mean curve and under dual curves",
        "engine-test", "--report", str(OUT / "engine_test.html"),
    )  # fmt: skip


def _search(hidden: str) -> None:
    """From a log that does not fit to the model that does."""
    model = str(OUT / "extended.toml")
    _step("Another log does not fit: by how much, in each subsystem?", "compare", hidden, allowed=(0, 1))
    _step("Where does it fail?", "locate", hidden, allowed=(0, 1))
    page, answer = str(OUT / "diagnosis.html"), str(OUT / "diagnosis.json")
    _step("What is missing?", "diagnose", hidden, "--report", page, "--json", answer, allowed=(0, 1))
    found = [e["effect"] for e in json.loads((OUT / "diagnosis.json").read_text())["effects"]]
    if found:
        effects = [a for e in found for a in ("--effect", e)]
        _step(
            "Add it, and watch the error fall on data that was not fitted",
            "extend", hidden, *effects, "--out", model, "--report", str(OUT / "extended.html"), allowed=(0, 1),
        )  # fmt: skip
        _step("The extended model against the log", "compare", hidden, "--model", model, allowed=(0, 1))


def main(words: list[str]) -> int:
    """Run the demonstration; what it makes goes to ./demo. The search runs beside the simulations, in a process of its
    own (``words``: the log that it searches), and what it says is shown after theirs.
    """
    if words:
        _search(*words)
        return 0
    OUT.mkdir(exist_ok=True)
    for name in MADE:
        (OUT / name).unlink(missing_ok=True)
    example, hidden = (os.path.relpath(ROOT / "examples" / f) for f in ("engine_run.blf", "hidden_effect.parquet"))
    search = subprocess.Popen(
        python_module("vaneloop.cli.demo", hidden), stdout=subprocess.PIPE, text=True, encoding="utf-8"
    )
    try:
        _simulate(example)
        assert search.stdout is not None
        for line in search.stdout:
            print(line, end="", flush=True)
        if code := search.wait():
            return code
    finally:
        search.terminate()
        search.wait()
    print("\nmade, the pages to be opened in a browser:")
    for name, shows in MADE.items():
        if (OUT / name).exists():
            print(f"  {OUT / name!s:<24}{shows}")
    return 0


if __name__ == "__main__":
    sys.exit(terminal.run(lambda: main(sys.argv[1:])))
