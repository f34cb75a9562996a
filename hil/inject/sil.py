"""Pytest plugin: the fixture ``sil`` runs a scenario of frame and fault injection in a user's own test suite.

Installed with VaneLoop; nothing has to be imported or configured::

    def test_a_short_silence_is_ridden_through(sil):
        outcome = sil("demand_gap_200ms")        # a shipped scenario or a TOML file; a broken claim fails the test,
                                                 with all claims shown
        assert "demand_rejected" not in outcome.faults_seen()

    def test_my_own_bad_day(sil):
        outcome = sil.run(sil.Drop(start=2.0, duration=0.1), duration=4.0)
        assert outcome.mode_at(2.06) == "DEGRADED" and outcome.mode == "RUN"

``pytest --vaneloop-controller PATH.so`` runs a controller of the user's own in its place (docs/own_controller.md);
shipped scenarios are then judged by what must be seen of any controller, ``--vaneloop-reactions F.toml``.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from hil import inject

if TYPE_CHECKING:
    from hil.inject import Outcome
    from hil.inject.actions import AnyAction
    from hil.inject.scenario import Expect, Scenario

__all__ = ["Sil", "pytest_addoption", "sil"]


class Sil:
    """Software in the loop: controller, plant, ECU and bus in simulated time. The actions of `hil.inject` are
    attributes (``sil.Drop``).
    """

    def __init__(self, folder: Path, controller: str | None = None, reactions: str | None = None):
        self.folder, self.controller, self.reactions = folder, controller, reactions

    def __getattr__(self, name: str) -> Any:
        """Give an action or `Expect` by its name in `hil.inject`."""
        if name in ("Expect", "Scenario", *(c.__name__ for c in inject.ACTIONS.values())):
            return getattr(inject, name)
        raise AttributeError(
            f"sil.{name} is not known; allowed: run, Expect, Scenario, "
            f"{', '.join(c.__name__ for c in inject.ACTIONS.values())}"
        )

    def __call__(self, scenario: Scenario | str | Path, **changes: Any) -> Outcome:
        """Run a scenario; the test fails where a claim of it is broken, or what is always demanded (safe limits,
        documented mode changes).

        scenario  the name of a shipped one, a TOML file (also relative to the test's folder), or a `Scenario`
        changes   keys of the scenario to replace, for example ``seed=7``
        """
        __tracebackhide__ = True
        if not isinstance(scenario, inject.Scenario):
            beside = self.folder / scenario
            source = beside if beside.is_file() else scenario
            name, scenario = Path(source).stem, inject.load_scenario(source)
        else:
            name = "scenario"
        if changes:
            scenario = inject.Scenario.model_validate({**scenario.model_dump(), **changes})
        outcome = inject.run(scenario, name=name, **self._of_own_controller())
        if not outcome.held:
            pytest.fail(outcome.text(), pytrace=False)
        return outcome

    def _of_own_controller(self) -> dict[str, Any]:
        """What `hil.inject.run` takes for a controller of the user's own."""
        if self.controller is None:
            return {}
        from controller import load_calibration
        from hil.inject.any_controller import SHIPPED, load_reactions
        from hil.native import Program

        calibration = load_calibration()._replace(program=Program(self.controller))
        return {"calibration": calibration, "reactions": load_reactions(self.reactions or SHIPPED)}

    def run(self, *actions: AnyAction, duration: float, expect: list[Expect] | None = None, **keys: Any) -> Outcome:
        """Run actions as a scenario of ``duration`` s; ``keys`` are others of `Scenario` (``demand``, ``seed``). Fails
        as a call does.
        """
        __tracebackhide__ = True
        return self(
            inject.Scenario(
                title="scenario of a test", inject=list(actions), expect=expect or [], duration=duration, **keys
            )
        )


@pytest.fixture
def sil(request: pytest.FixtureRequest) -> Sil:
    """Software in the loop: run a scenario of frame and fault injection and fail where the controller did not react as
    it must.
    """
    option = request.config.getoption
    return Sil(request.path.parent, option("--vaneloop-controller"), option("--vaneloop-reactions"))


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the options of the plugin."""
    group = parser.getgroup("vaneloop", "VaneLoop: software in the loop")
    group.addoption("--vaneloop-controller", metavar="PATH.so", help="controller that the fixture sil runs")
    group.addoption("--vaneloop-reactions", metavar="F.toml", help="limits and reactions by which it is judged")
