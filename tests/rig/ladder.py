"""How visible each effect is: every stage's error against the nominal equations, rung by rung.

``python -m tests.rig.ladder [effect ...]`` prints the table of docs/rig.md.
"""

from __future__ import annotations

import sys

from .controller import stand_in
from .effects import CATALOGUE, Hidden
from .manoeuvre import manoeuvre
from .reference import STAGES, stage_errors
from .simulate import simulate


def ladder(name: str, duration: float = 100.0, seed: int = 1) -> list[dict[str, float]]:
    """Return the stages' errors for the five rungs of one effect."""
    effect, controller = CATALOGUE[name], stand_in()
    out = []
    for value in effect.ladder:
        run = simulate(
            manoeuvre(seed, duration),
            controller,
            [Hidden(name, {effect.main: value, **effect.others})],
            seed=seed,
            rate=1000,
        )
        out.append(stage_errors(run, controller))
    return out


def main(names: list[str]) -> None:
    """Print error over clean error, per effect, rung and stage."""
    controller = stand_in()
    clean = stage_errors(simulate(manoeuvre(1, 100.0), controller, seed=1, rate=1000), controller)
    print("clean: " + ", ".join(f"{s} {clean[s]:.4g}" for s in STAGES))
    for name in names or list(CATALOGUE):
        effect = CATALOGUE[name]
        for value, errors in zip(effect.ladder, ladder(name), strict=True):
            print(
                f"{name:26s} {value:9.5g} " + " ".join(f"{s} {errors[s] / clean[s]:8.3f}" for s in STAGES), flush=True
            )


if __name__ == "__main__":
    main(sys.argv[1:])
