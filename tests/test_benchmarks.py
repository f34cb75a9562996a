"""What the benchmarks print and write: each row when it is measured, also where a later measurement fails."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from hil.inject.margin import Margin
from tests.conftest import ROOT
from vaneloop.base.errors import InputError
from vaneloop.fleet.together import Ran

pytest.importorskip("psutil", reason="the extra `fleet` is not installed")

import benchmarks.__main__ as bench
from benchmarks import campaign
from benchmarks.measure import Row


@pytest.fixture
def result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(bench, "machine", lambda: {"cpu": "one"})
    monkeypatch.setattr(campaign, "machine", lambda: {"cpu": "one"})
    return tmp_path / "results" / "r.json"


def measured(monkeypatch: pytest.MonkeyPatch, **of: Callable[[], Iterator[Row]]) -> None:
    monkeypatch.setattr(bench, "MEASUREMENTS", of)
    monkeypatch.setattr(bench, "QUICK", tuple(n for n in of if "slow" not in n))


def test_each_row_is_printed_and_written_when_it_is_measured(
    result: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[tuple[str, Any]] = []

    def looked() -> None:
        seen.append((capsys.readouterr().out, json.loads(result.read_text()) if result.exists() else None))

    def one() -> Iterator[Row]:
        looked()
        yield Row("a", "1 s", "2 s", 2.0, ">= 1", True)
        looked()
        yield Row("b", "3 s")
        looked()
        raise OSError("no\nmore")

    def two() -> Iterator[Row]:
        looked()
        yield Row("c", "4 s", held=False)

    measured(monkeypatch, first=one, second=two)
    bench.main([], result)
    assert seen[0][1] is None
    (printed, said), (more, then), (failed, last) = seen[1:]
    assert "a: 1 s, peer 2 s, ratio 2.00, target >= 1, held yes" in printed and "b: 3 s" in more
    assert [r["what"] for r in said["rows"]] == ["a"] and [r["what"] for r in then["rows"]] == ["a", "b"]
    assert said["left"] == ["second"] and said["machine"] == {"cpu": "one"}
    assert (
        "first: not measured (OSError: no)" in failed
        and last["rows"][2]["note"] == "OSError: no"
        and len(last["rows"]) == 3
    )
    whole = json.loads(result.read_text())
    assert [r["what"] for r in whole["rows"]] == ["a", "b", "first", "c"] and whole["left"] == []
    assert re.search(r"c +4 s +NO", capsys.readouterr().out), "the table of all stands at the end"


@pytest.mark.parametrize(
    ("words", "run"), [([], "ab"), (["--all"], "abc"), (["slow"], "c"), (["b", "slow"], "bc"), (["--all", "slow"], "c")]
)
def test_the_short_set_all_or_words_choose(
    result: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], run: str
) -> None:
    measured(monkeypatch, **{n: lambda n=n: iter([Row(n[0], "1")]) for n in ("a", "b", "c slow")})
    bench.main(words, result)
    assert "".join(r["what"] for r in json.loads(result.read_text())["rows"]) == run


def test_a_word_in_no_name_is_bad_input(
    result: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    measured(monkeypatch, a=lambda: iter([]), b=lambda: iter([]))
    with pytest.raises(SystemExit) as e:
        bench.main(["nothing"], result)
    assert e.value.code == 2 and "nothing is in no name; names: a, b" in capsys.readouterr().err


def test_a_result_that_cannot_be_written_ends_no_measurement(
    result: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result.parent.write_text("a file")
    measured(monkeypatch, a=lambda: iter([Row("a", "1")]), b=lambda: iter([Row("b", "2")]))
    bench.main([], result)
    said = capsys.readouterr().out
    assert said.count("r.json cannot be written") == 2 and re.search("b +2", said)


def test_the_short_set_is_of_measurements_and_make_names_both() -> None:
    assert set(bench.QUICK) < set(bench.MEASUREMENTS) and len(set(bench.QUICK)) == len(bench.QUICK)
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.search(r"^bench:.*\n.*\n\t@\$\(PY\) -m benchmarks$", text, re.M)
    assert re.search(r"^bench-all:.*\n.*\n\t@\$\(PY\) -m benchmarks --all$", text, re.M)


# ---- scenarios both ways ---------------------------------------------------------------------------------------------


def test_a_scenario_both_ways_counts_what_differs(monkeypatch: pytest.MonkeyPatch) -> None:
    held, broken = Margin("m", True, 0.5, "s", 0.5), Margin("m", False, -0.5, "s", -0.5)
    rows = {
        True: [{"expected": "m", "held": True, "value": 0.5}],
        False: [{"expected": "m", "held": False, "value": -0.5}],
    }
    lanes = [Ran([m]) for m in (held, held, broken, Margin("m", True, 0.5 + 2e-9, "s", 0.5), held)]
    bus = iter([True, False, False, True])
    monkeypatch.setattr(campaign, "side_by_side", lambda files, g, varied, points: lanes)
    monkeypatch.setattr(campaign, "trial_once", lambda *of: {"held": (h := next(bus)), "margins": rows[h]})
    found = campaign.compare("s", Path("s.toml"), [], [[0.0]] * 5, 4)
    assert (found.engines, found.compared, found.failed, found.verdicts, found.margins) == (5, 4, 2, 1, 2)
    both = [Ran([held]), campaign.Alone("why")]
    monkeypatch.setattr(campaign, "side_by_side", lambda files, g, varied, points: both)
    assert campaign.compare("s", Path("s.toml"), [], [[0.0]] * 2, 2).alone == "why"


def test_scenarios_both_ways_are_printed_and_written_one_by_one(
    result: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[Any] = []
    rows = [campaign.Compared("a", "", 9, 5, 2, 1, 1, 0.5, 0.01), campaign.Compared("b", "why")]

    def measure(*of: Any) -> Iterator[campaign.Compared]:
        asked.append(of)
        yield rows[0]
        assert "50 times; 2 of 5 machines fail; verdicts of 1 differ" in capsys.readouterr().out
        assert [r["scenario"] for r in json.loads(result.read_text())["rows"]] == ["a"]
        yield rows[1]

    monkeypatch.setattr(campaign, "measure", measure)
    campaign.main(["9", "5", "word"], result)
    said = capsys.readouterr().out
    assert "b " in said and "on the bus: why" in said and "1 of 2 scenarios in lanes, 9 machines each" in said
    assert [r["alone"] for r in json.loads(result.read_text())["rows"]] == ["", "why"]
    monkeypatch.setattr(campaign, "measure", lambda *of: asked.append(of) or iter([]))
    for words, of in ((["word"], (1000, 500, ["word"])), (["7"], (7, 7, [])), ([], (1000, 500, []))):
        campaign.main(words, result)
        assert asked[-1] == of and "no scenario with these words" in capsys.readouterr().out
    assert asked[0] == (9, 5, ["word"])
    with pytest.raises(InputError, match=r"COMPARED \(=0\) must be in \[1, 1000000\]"):
        campaign.main(["5", "0"], result)


def test_machines_both_ways_are_of_every_tolerance_and_of_wide_effects() -> None:
    varied = {q.name: q for q in campaign.quantities()}
    assert set(campaign.WIDE) < set(varied) and varied["lvdt_bias.bias"].effect and not varied["engine.lag"].effect
    tolerance = {n.name for n in campaign.Machine().plant.nominal if n.tolerance > 0.0}
    assert tolerance < set(varied) and varied["engine.lag"].high == pytest.approx(1.32)
