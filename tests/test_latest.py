"""What the search does not do twice, and what a diagnosis does not import."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from tests.conftest import ROOT
from vaneloop.identification.least_squares import residuals as latest


def test_a_set_that_was_simulated_is_not_simulated_again(monkeypatch):
    """Repeated within one call, and from one call to the next, until others have taken its place."""
    asked: list[list[float]] = []

    def simulate(thetas: np.ndarray) -> np.ndarray:
        asked.append(thetas[:, 0].tolist())
        return np.repeat(thetas[:, :1, None], 5, axis=2)

    monkeypatch.setattr(latest, "KEPT_ERRORS", 15)  # three sets
    kept = latest.ResidualCache()

    def errors(*sets: float) -> None:
        out = kept.errors(np.array(sets)[:, None], simulate)
        assert out.shape == (len(sets), 1, 5) and np.array_equal(out[:, 0, 4], sets)
        out[:] = np.nan  # it is the caller's

    errors(1.0, 2.0)
    errors(2.0, 3.0, 3.0, 1.0)
    errors(3.0)
    assert asked == [[1.0, 2.0], [3.0]]
    errors(4.0, 5.0, 6.0, 7.0)
    errors(4.0, 7.0)
    assert asked[2:] == [[4.0, 5.0, 6.0, 7.0], [4.0]]
    assert kept.errors(np.empty((0, 1)), simulate).shape == (0, 1, 5)


@pytest.mark.slow
def test_a_diagnosis_does_not_import_what_it_does_not_use():
    """Each of them takes up to half a second of processor time."""
    code = (
        "import sys\nfrom hil.logs import read_log\nimport vaneloop.verbs.search\n"
        "from vaneloop.identification.vane_chain.chain import build_chain\n"
        "build_chain(read_log('examples/hidden_effect.parquet', require=()))\n"
        "print([m for m in ('pandas', 'scipy.signal', 'scipy.stats', 'scipy.optimize', 'scipy.interpolate')\n"
        "       if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
