"""Numbers that no fit can square: whatever a log holds, the answer is one, or one clear line."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vaneloop
from hil.logs import Channel, read_log, write_log
from tests.conftest import ROOT, examples
from vaneloop import System, unknown
from vaneloop.base.errors import InputError
from vaneloop.base.sizes import LARGEST, SMALLEST, beyond, no_smaller
from vaneloop.cli.main import main
from vaneloop.identification.least_squares.problem import covariance
from vaneloop.identification.user_models.system import Record

T = np.arange(600) * 0.01
WAVE = np.sin(2.0 * T)


def spring(start: float = 1.0) -> System:
    """A spring whose friction is not in the model."""
    return System(
        "spring", "static", lambda u, p: p.stiffness * u.stretch, inputs={"stretch": "mm"}, outputs={"force": "N"},
        parameters=[unknown("stiffness", start, "N/mm")],
    )  # fmt: skip


def record(stretch: float, force: float, time: float = 1.0) -> Record:
    """A spring's log in other units."""
    noise = np.random.default_rng(1).normal(0.0, 0.01, T.size)
    return Record(
        "a", time * T, {"stretch": stretch * WAVE, "force": force * (2.0 * WAVE + 0.3 * np.sign(np.cos(2 * T)) + noise)}
    )


SIZES = st.integers(-320, 307).map(lambda k: 10.0**k)


@settings(max_examples=examples(60))
@given(stretch=SIZES, force=SIZES)
def test_a_fit_at_any_scale_is_an_answer_or_one_line(stretch: float, force: float) -> None:
    try:
        answer = vaneloop.compare([record(stretch, force)], spring(force / stretch if stretch else 1.0))
    except np.linalg.LinAlgError as e:
        raise AssertionError(f"{stretch:g}, {force:g}: {e}") from e
    except InputError as e:
        assert "\n" not in str(e)
    else:
        assert answer


@pytest.mark.slow
@pytest.mark.parametrize("force", [1e-55, 1.0])
@pytest.mark.parametrize("stretch", [0.0, 1e-300, 1e-58, 1e-55, 1e55])
@pytest.mark.parametrize("time", [1.0, 1e300])
def test_a_search_at_any_scale_is_an_answer_or_one_line(stretch: float, force: float, time: float) -> None:
    start = force / stretch if stretch else 1.0
    try:
        vaneloop.diagnose([record(stretch, force, time)], spring(start if math.isfinite(start) else 1.0))
    except np.linalg.LinAlgError as e:
        raise AssertionError(f"{stretch:g}, {force:g}, {time:g}: {e}") from e
    except InputError as e:
        assert "\n" not in str(e)


def changed(kind: str, v: np.ndarray) -> np.ndarray:
    """A channel with other numbers."""
    if kind == "constant":
        return np.full_like(v, v[0])
    if kind == "one huge":
        return np.where(np.arange(v.size) == 5, 1e300, v)
    return v * float(kind)


def cut(path: Path, kind: str, signals: tuple[str, ...] = ()) -> Path:
    """Twelve seconds of the example with some signals changed (all of them where none is named)."""
    whole = read_log(ROOT / "examples" / "hidden_effect.parquet").channels
    out = {}
    for name, c in whole.items():
        v = c.values[c.t < 12.0]
        out[name] = Channel(c.t[c.t < 12.0], changed(kind, v) if name in signals or not signals else v)
    write_log(path, out)
    return path


CASES = [
    ("1e-300", ("i_cmd",)), ("5e-324", ("i_cmd",)), ("1e-59", ("i_cmd",)), ("1e-30", ("i_cmd",)), ("0", ("i_cmd",)),
    ("constant", ("i_cmd",)), ("one huge", ("i_cmd",)), ("constant", ("x_lvdt",)), ("constant", ()),
    ("1e-300", ("vigv", "vgv1", "vgv2")), ("1e-300", ("p_s",)), ("constant", ("n_r", "n_dem")),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "kind", "signals"),
    [("learn", *CASES[0]), *((verb, *case) for case in CASES for verb in ("replay", "compare", "diagnose"))],
)
def test_the_vane_chain_answers_at_any_scale(
    verb: str, kind: str, signals: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = cut(tmp_path / "a.parquet", kind, signals)
    code = main([verb, str(path), "--quiet", *(["--workers", "1"] if verb == "diagnose" else [])])
    said = capsys.readouterr().err
    assert code in (0, 1) or (code == 2 and said.count("\n") == 1), said


def test_currents_of_next_to_nothing_are_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = cut(tmp_path / "a.parquet", "1e-300", ("i_cmd",))
    assert main(["diagnose", str(path), "--quiet", "--workers", "1"]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and "too little for a machine that moves, in A too" in said[0], said
    assert main(["diagnose", str(path), "--unit", "i_cmd=mA", "--quiet", "--workers", "1"]) in (0, 1)  # if it must be
    assert "LinAlgError" not in capsys.readouterr().err


def test_what_is_smaller_is_nothing_and_what_is_larger_is_refused() -> None:
    values = np.array([0.0, -SMALLEST, SMALLEST, -0.5 * SMALLEST, 5e-324, np.nan, np.inf, LARGEST, -1e61])
    assert no_smaller(values)[:5].tolist() == [0.0, -SMALLEST, SMALLEST, 0.0, 0.0]
    assert no_smaller(values[:3]) is not None and no_smaller(v := np.ones(3)) is v
    assert beyond(values).tolist() == [False] * 6 + [True, False, True]
    with pytest.raises(InputError, match=r"a: channel 'force' reaches -?[0-9.]+e\+60; allowed: 1e\+60"):
        vaneloop.compare([record(1.0, 1e60)], spring())


def test_a_parameter_of_which_nothing_is_known_has_no_interval() -> None:
    assert np.allclose(covariance(np.array([[4.0, 0.0], [0.0, 2.0]])), [[0.25, 0.0], [0.0, 0.5]])
    some = covariance(np.array([[4.0, 0.0, 0.0], [0.0, np.inf, 0.0], [0.0, 0.0, np.nan]]))
    assert np.diag(some).tolist() == [0.25, np.inf, np.inf]
