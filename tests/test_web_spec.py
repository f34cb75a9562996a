"""The workbench without a browser: who may ask, what is heard on the bus, what happened when, and the calibration of
the loop that runs, each by what it promises.
"""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from controller.records import FAULTS, MODES
from hil.bus import frames
from vaneloop.web import moments
from vaneloop.web.charts import Mark
from vaneloop.web.choice import Choice, LogFile, safe_name
from vaneloop.web.guard import Guard, is_loopback
from vaneloop.web.jobs import COLUMNS, Cancelled, WorkError
from vaneloop.web.loop import MOST_TRACE, Heard
from vaneloop.web.run import _dial, _in_words
from vaneloop.web.session import Session
from vaneloop.web.tuning import Tuning, shown

TOKEN = "the-token-of-this-test"


# ---- who may ask -----------------------------------------------------------------------------------------------------


class Asked:
    """One request to a guard, and what came back."""

    def __init__(
        self, guard: Guard, path: str = "/", query: str = "", method: str = "GET", kind: str = "http",
        body: tuple[bytes, ...] = (b"",), **headers: str,
    ):  # fmt: skip
        named = {"host": "127.0.0.1:8080", "accept": "text/html"} | {k.replace("_", "-"): v for k, v in headers.items()}
        scope = {
            "type": kind, "method": method, "path": path, "query_string": query.encode(),
            "headers": [(k.encode(), v.encode()) for k, v in named.items()],
        }  # fmt: skip
        chunks = [{"type": "http.request", "body": b, "more_body": True} for b in body]
        self.sent: list[dict[str, Any]] = []

        async def receive() -> Any:
            return chunks.pop(0) if chunks else {"type": "http.disconnect"}

        async def send(message: Any) -> None:
            self.sent.append(message)

        asyncio.run(guard(scope, receive, send))
        self.status = next((m["status"] for m in self.sent if "status" in m), None)
        self.text = b"".join(m.get("body", b"") for m in self.sent).decode()
        self.headers = dict(next((m["headers"] for m in self.sent if "headers" in m), ()))


async def echo(scope: Any, receive: Any, send: Any) -> None:
    """An application that reads a body and answers with its length."""
    if scope["type"] != "http":
        await send({"type": "websocket.accept"})
        return
    length = 0
    while (message := await receive())["type"] == "http.request":
        length += len(message["body"])
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": str(length).encode()})


@pytest.fixture
def guard() -> Guard:
    return Guard(echo, TOKEN, 8080, 1000, loopback=True, pages=["/", "/run"])


KNOWN: dict[str, Any] = {"cookie": f"other=1; vaneloop_token_8080={TOKEN}"}


def test_who_knows_the_token_may_ask_and_nobody_else(guard: Guard) -> None:
    assert Asked(guard).status == 403 and "needs its token" in Asked(guard).text
    for cookie in (f"vaneloop_token_8081={TOKEN}", "vaneloop_token_8080=x", f"vaneloop_token_8080={TOKEN}x"):
        assert Asked(guard, cookie=cookie).status == 403
    good = Asked(guard, **KNOWN)
    assert (good.status, good.text) == (200, "0")
    assert good.headers[b"x-frame-options"] == b"DENY" and b"content-security-policy" in good.headers
    entered = Asked(guard, "/run", f"token={TOKEN}")
    assert entered.status == 303 and entered.headers[b"location"] == b"/run"
    cookie = f"vaneloop_token_8080={TOKEN}; HttpOnly; SameSite=Strict; Path=/"
    assert entered.headers[b"set-cookie"] == cookie.encode() and entered.headers[b"cache-control"] == b"no-store"
    assert Asked(guard, "/no/page", f"token={TOKEN}").headers[b"location"] == b"/"
    assert Asked(guard, "/", "token=x").status == 403 and Asked(guard, "/", f"token={TOKEN}", "POST").status == 403
    elsewhere = Asked(guard, "/run", f"token={TOKEN}", sec_fetch_site="cross-site")
    assert elsewhere.status == 200 and 'url=/run"' in elsewhere.text
    word = guard.ticket()
    assert Asked(guard, "/", f"token={word}").status == 303 and Asked(guard, "/", f"token={word}").status == 403


@pytest.mark.parametrize(
    ("more", "status"),
    [
        ({}, 200), ({"host": "localhost"}, 200), ({"host": "[::1]:8080"}, 200),
        ({"host": "vane.example:8080"}, 421),
        ({"host": "127.0.0.1.example.com"}, 421), ({"host": "a b"}, 400), ({"host": ""}, 400),
        ({"origin": "http://127.0.0.1:8080"}, 200), ({"origin": "http://127.0.0.1:8081"}, 403),
        ({"origin": "null"}, 403),
        ({"sec_fetch_site": "same-origin"}, 200), ({"sec_fetch_site": "same-site"}, 403),
        ({"sec_fetch_mode": "cors"}, 406), ({"sec_fetch_dest": "iframe"}, 406), ({"accept": "*/*"}, 406),
        ({"content_length": "1000"}, 200), ({"content_length": "1001"}, 413), ({"content_length": "-1"}, 400),
        ({"content_length": "1" * 19}, 400),
        ({"path": "/data", "accept": "*/*"}, 200), ({"path": "/a\n"}, 400),
        ({"body": (b"x" * 600, b"x" * 400)}, 200), ({"body": (b"x" * 600, b"x" * 401)}, 413),
    ],
)  # fmt: skip
def test_a_request_is_from_here_and_no_larger_than_may_be(guard: Guard, more: dict[str, Any], status: int) -> None:
    assert Asked(guard, **KNOWN | more).status == status


def test_elsewhere_any_name_is_answered_and_a_websocket_is_closed(guard: Guard) -> None:
    open_to_all = Guard(echo, TOKEN, 8080, 1000, loopback=False)
    assert Asked(open_to_all, host="vane.example:8080", **KNOWN).status == 200
    assert Asked(guard, kind="websocket", **KNOWN).sent == [{"type": "websocket.accept"}]
    assert Asked(guard, kind="websocket").sent == [{"type": "websocket.close", "code": 1008}]
    for host, here in (("127.0.0.1", True), ("127.9.9.9", True), ("[::1]", True), ("LOCALHOST.", True), ("::2", False)):
        assert is_loopback(host) == here


# ---- what was heard --------------------------------------------------------------------------------------------------


def test_what_is_heard_is_decoded_where_its_crc_is_right() -> None:
    heard = Heard()
    servo = next(i for i, n in frames.NAMES.items() if n == "VGV_SERVO")
    angles = next(i for i, n in frames.NAMES.items() if n == "VGV_ANGLES")
    length = frames.LENGTH << 32

    def data_of(ident: int, body: int) -> int:
        body &= ~0xFF
        return body | frames.crc(ident, body)

    faults = data_of(servo, 0)
    heard.hear(0.1, servo | length, faults)
    heard.hear(0.2, angles | length, data_of(angles, 0))
    wrong = faults ^ 1
    heard.hear(0.3, servo | length, wrong)
    heard.hear(0.4, 0x7FF | length, 5)
    heard.hear(0.5, servo | (1 << 32), faults)  # too short
    news = heard.news()
    assert (news["frames"], news["refused"]) == (5, 1) and news["rows"].shape == (1, len(COLUMNS))
    assert news["rows"][0, COLUMNS.index("t")] == 0.2
    assert news["rows"][0, COLUMNS.index("faults")] == frames.decode_servo(faults)[1]
    assert [bool(values) for *_, values in news["trace"]] == [True, True, False, False, False]
    assert heard.news()["trace"] == [] and len(heard.news()["rows"]) == 0
    for k in range(MOST_TRACE + 5):
        heard.hear(float(k), 0x7FF | length, 5)
    assert len(heard.trace) == MOST_TRACE and heard.frames == 5 + MOST_TRACE + 5


def test_a_frame_in_words() -> None:
    servo = next(i for i, n in frames.NAMES.items() if n == "VGV_SERVO")
    head = servo | 8 << 32
    text = _in_words(1.5, head, 0x0807060504030201, {"x": 1.25, "y": 2.0})
    assert text == f"     1.500  {servo:03X}  VGV_SERVO   01 02 03 04 05 06 07 08  x 1.25  y 2"
    assert _in_words(0.0, head, 0, {}).endswith("WRONG CRC") and not _in_words(
        0.0, 0x7FF | 8 << 32, 0, {}
    ).strip().endswith("CRC")
    kinds = {1 << 29: "error frame", 1 << 30: "remote", 1 << 31: "extended"}
    for bit, name in kinds.items():
        assert name in _in_words(0.0, 0x123 | bit | 2 << 32, 0x0201, {}) and "01 02 " in _in_words(
            0.0, bit | 2 << 32, 0x0201, {}
        )


def test_a_dial_has_eleven_ticks_between_its_ends() -> None:
    face = _dial(-5.0, 120.0)
    assert face.count("<path") == 12 and ">-5</text>" in face and ">120</text>" in face
    ticks = [p.split('"')[0] for p in face.split('<path d="M')[2:13]]
    middle = ticks[5].split("L")[0].split()
    assert float(middle[0]) == pytest.approx(50.0) and float(middle[1]) == pytest.approx(6.0)
    long, short = (
        np.array([[float(v) for v in end.split()] for end in ticks[k].rstrip("/>").split("L")]) for k in (5, 4)
    )
    assert np.linalg.norm(long[0] - long[1]) == pytest.approx(10.0, abs=0.2)
    assert np.linalg.norm(short[0] - short[1]) == pytest.approx(6.0, abs=0.2)


# ---- what happened when ----------------------------------------------------------------------------------------------


def test_moments_are_changes_of_mode_faults_and_what_was_injected() -> None:
    new = moments.told(2.5, 2, 0b101, (1, 0b110))
    assert [m.text for m in new] == [f"mode {MODES[2]}", f"{FAULTS[0]} set", f"{FAULTS[1]} cleared"]
    assert [m.fault for m in new] == ["", FAULTS[0], ""] and new[0].line == f"2.50 s  mode {MODES[2]}"
    assert moments.told(1.0, 2, 1, (2, 1)) == [] and moments.told(1.0, -1, 1, (2, 1)) == []
    assert moments.told(1.0, len(MODES), 1, (2, 1)) == [] and moments.Moment(None, "far").line == "far"
    t = np.arange(6.0)
    state = np.array([0.0, 0.0, 1.0, np.nan, 1.0, 2.0])
    on = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 0.0])
    got = moments.of_log({"state": ("-", t, state)}, {FAULTS[1]: (t, on)}, [Mark(3.5, "gust")])
    assert [(m.t, m.text) for m in got] == [
        (0.0, f"mode {MODES[0]}"), (2.0, f"mode {MODES[1]}"), (3.0, f"{FAULTS[1]} set"), (3.5, "injected: gust"),
        (4.0, f"mode {MODES[1]}"), (5.0, f"mode {MODES[2]}"), (5.0, f"{FAULTS[1]} cleared"),
    ]  # fmt: skip
    bands = moments.bit_bands(t, np.array([0.0, 0b11, 0b11, 0.0, 0b10, np.nan]))
    assert [b.text for b in bands] == [f"{FAULTS[0]}, {FAULTS[1]}", FAULTS[1]]
    (band,) = moments.fault_bands({FAULTS[2]: (t, on)})
    assert band.text == FAULTS[2] and band.start == 3.0


# ---- a session -------------------------------------------------------------------------------------------------------


def file_of(folder: Path, name: str, text: str = "") -> LogFile:
    (folder / name).write_text(text)
    return LogFile(folder / name, name, f"logs/{name}")


@pytest.fixture
def session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr("vaneloop.web.session.Session.read", lambda self: self.reads.append(self.choice.file))
    s: Any = Session("1", tmp_path / "private", [])
    s.reads = []
    yield s
    s.close()
    assert not (tmp_path / "private").exists()


def test_what_is_chosen_is_what_a_command_would_say(tmp_path: Path, session: Any) -> None:
    assert (tmp_path / "private").stat().st_mode & 0o777 == 0o700
    log, dbc = file_of(tmp_path, "a.csv"), file_of(tmp_path, "b.dbc")
    model, bench = file_of(tmp_path, "m.toml", "[effects]\n"), file_of(tmp_path, "n.toml", "x = 1\n[names]\n")
    for f in (dbc, model, bench):
        session.choose(f)
    assert session.reads == [] and session.choice.beside() == ["b.dbc", "m.toml", "n.toml"]
    session.choose(log)
    assert session.reads == [log] and session.choice.beside() == ["m.toml", "n.toml"]  # no database of a table
    session.choice.mapping, session.choice.units = {"n_dem": "N"}, {"n_dem": "rpm"}
    said = session.command("compare", "--json", "a b")
    assert said.startswith("vaneloop compare logs/a.csv --map N=n_dem --unit n_dem=rpm")
    assert (
        "--model logs/m.toml" in said and said.endswith("--json 'a b'") and str(tmp_path) in " ".join(session.words())
    )
    other = file_of(tmp_path, "c.csv")
    session.choose(other)
    assert session.choice.beside() == [] and session.choice.mapping == {}
    assert session.clean(f"{tmp_path}/c.csv and {tmp_path}/private/x") == f"{tmp_path}/c.csv and x"


def test_code_runs_only_once_it_is_allowed_as_it_stands(tmp_path: Path, session: Any) -> None:
    code = file_of(tmp_path, "mine.py", "a = 1")
    session.choose(code)
    assert session.asked == code and session.choice.system is None and not session.runs(code)
    session.refuse()
    assert session.asked is None and session.choice.system is None
    session.choose(code)
    session.allow()
    assert session.asked is None and session.choice.system == code and session.runs(code)
    session.choose(file_of(tmp_path, "a.csv"))
    assert session.words() and session.choice.system == code
    code.path.write_text("a = 2")
    with pytest.raises(WorkError, match=r"^mine\.py: has changed since its code was allowed to run; choose it again$"):
        session.words()
    assert session.runs(LogFile(code.path, "x", "x", shipped=True))
    session.hold_against(None)
    assert session.choice.system is None and session.words()


def test_what_is_done_beside_the_page_ends_in_a_line_or_none(session: Any) -> None:
    async def fails(e: Exception) -> None:
        raise e

    async def all_of_it() -> None:
        session.do("a", fails(WorkError("no")))
        session.do("b", fails(Cancelled()))
        session.do("c", asyncio.sleep(0))
        assert sum(session.working.values()) == 3 and len(session.tasks) == 3
        await asyncio.sleep(0.01)
        assert sum(session.working.values()) == 0 and not session.tasks
        assert session.errors["a"] == "no" and "b" in session.errors and "c" not in session.errors
        session.do("a", asyncio.sleep(0))
        assert "a" not in session.errors
        await asyncio.sleep(0.01)

    woken: list[int] = []
    session.lookers.append(lambda: woken.append(1))
    asyncio.run(all_of_it())
    assert session.versions["a"] == 4 and woken


def test_a_name_of_a_file_is_safe() -> None:
    assert "/" not in safe_name("../../etc/passwd") and safe_name("a.csv") == "a.csv"
    assert Choice(file=LogFile(Path("/x/a.csv"), "a.csv", "a.csv"), tables="t").words(real=False) == [
        "a.csv", "--tables", "t",
    ]  # fmt: skip


# ---- calibration -----------------------------------------------------------------------------------------------------


@pytest.fixture
def tuning() -> Any:
    works: list[Any] = []
    session = SimpleNamespace(
        touch=lambda *_: None, do=lambda section, work: works.append(work), folder=Path("/f"), saved={}
    )
    sent: list[Any] = []
    told: list[str] = []
    out: Any = Tuning(session, lambda number, commands: sent.append((number, commands)), told.append)  # type: ignore[arg-type]
    out.works, out.sent, out.told = works, sent, told
    return out


def element(name: str, **more: Any) -> Any:
    given = {"border": "mA", "factor": 1e-3, "low": 0.0, "high": 0.04, "fixed": False, "table": "calibration",
             "of_curve": False, "section": "current_limit"}  # fmt: skip
    return SimpleNamespace(name=name, **given | more)


def test_a_number_is_changed_in_the_unit_of_its_table(tuning: Any) -> None:
    tuning.began(
        (element("current_limit"), element("knee", fixed=True), element("s1", table="stroke_tables", of_curve=True))
    )
    tuning.pages = np.array([[0.03, 1.0, 2.0], [0.03, 1.0, 2.0]])
    assert tuning.groups() == {"current limit": [0], "stroke tables": [2]}
    tuning.change(0, "30")
    assert tuning.works == []  # as it is

    async def work(change: str, answer: Any) -> None:
        tuning.change(0, change)
        assert (tuning.asked == {0}) == change.replace(".", "").isdigit()
        task = asyncio.ensure_future(tuning.works.pop())
        await asyncio.sleep(0)
        if tuning._waiting:
            number = tuning.sent[-1][0]
            tuning.answered([(number, answer)])
        await task
        assert tuning.asked == set()

    asyncio.run(work("25", [b"connected", np.array([0.025]).tobytes()]))
    assert tuning.pages[0, 0] == 0.025 and tuning.told == ["current_limit 25 mA"] and len(tuning.sent[0][1]) > 1
    for change, answer, said in (
        ("50", "out of range", r"current_limit \(=50 mA\), in \[0, 40\] mA: out of range"),
        ("much", None, r"current_limit \(='much'\) must be a number, in mA"),
    ):
        with pytest.raises(WorkError, match=f"^{said}$"):
            asyncio.run(work(change, answer))
    tuning.page = 1
    asyncio.run(work("20", [b"connected", np.array([0.02]).tobytes()]))
    assert tuning.told == ["current_limit 25 mA"]  # the firmware uses the other page
    tuning.ended()
    assert tuning.elements == () and tuning.pages.size == 0 and tuning.page == 0
    with pytest.raises(WorkError, match="^reading the calibration: no loop runs$"):
        asyncio.run(tuning._read())
    assert shown(1.0 / 3.0) == "0.3333333"
