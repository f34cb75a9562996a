"""``make demo``: the main job from end to end, with the commands a user would type."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from vaneloop.base import terminal
from vaneloop.cli.main import main as vaneloop

__all__ = ["main"]

ROOT = Path(__file__).resolve().parents[2]
OUT = Path("demo")


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


def main() -> int:
    """Run the demonstration; pages go to ./demo."""
    OUT.mkdir(exist_ok=True)
    example = os.path.relpath(ROOT / "examples" / "engine_run.blf")
    _step(
        "A recorded engine run (CAN log, from an independent rig) through firmware and plant",
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
    hidden = os.path.relpath(ROOT / "examples" / "hidden_effect.parquet")
    model = str(OUT / "extended.toml")
    _step("Another log does not fit: by how much, stage by stage?", "compare", hidden, allowed=(0, 1))
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
    print("\npages to open in a browser:")
    for written in sorted(OUT.glob("*.html")):
        print(f"  {written}")
    return 0


if __name__ == "__main__":
    sys.exit(terminal.run(main))
