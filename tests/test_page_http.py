"""The page over HTTP: who may see, who may act, and what nobody may."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
from page_site import KEPT, LEAK, NOW, Run, config, write_config
from starlette.requests import Request
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from user_files import authenticator_of, quick_users

from twin.alarms import writer as keeper_module
from twin.assets.unit import Unit
from twin.audit import records
from twin.errors import ConfigError
from twin.events import Kind
from twin.figures.database import open_store as open_figures
from twin.instants import DAY_NS, clock
from twin.page import app as module
from twin.page.app import COOKIE, STATIC, Access, Page
from twin.page.chart_library import FILES
from twin.page.ejector import Ejector
from twin.page.sessions import SESSION_S, Sessions
from twin.page.settings import REPORTS, folder_of
from twin.users import Role

OURS = "http://127.0.0.1:8420"
WORD = "correct horse"
REPORT = "0123456789abcdef" * 2
ASK = "/api/ejectors/0/requests"


class Site:
    """A page, what its run has left, and a browser."""

    def __init__(self, folder: Path, access: Access) -> None:
        self.config = config(write_config(folder))
        self.users = quick_users(folder / "users.toml")
        self.now, self.seconds = NOW, 0.0
        self.run: Run | None = None
        self.ejector = Ejector(self.config, lambda: self.now)
        sessions = Sessions(self.users, lambda: self.seconds)
        authenticator = authenticator_of(self.users)
        self.page = Page([self.ejector], authenticator, sessions, access)
        self.client = TestClient(self.page.app(), OURS, follow_redirects=False)

    def begin(self) -> Run:
        self.run = Run(self.config)
        return self.run

    def log_in(self, name: str = "ann", password: str = WORD, **headers: str) -> httpx2.Response:
        form = {"name": name, "password": password}
        return self.client.post("/login", data=form, headers={"origin": OURS, **headers})

    def ask(self, alarm: str = LEAK, deed: str = "acknowledged", **how: Any) -> httpx2.Response:
        csrf = self.client.get("/api/me").json().get("csrf", "")
        headers = {"origin": OURS, "x-csrf-token": csrf, **how.pop("headers", {})}
        return self.client.post(ASK, json={"alarm": alarm, "deed": deed, **how}, headers=headers)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keeper_module, "POLL_S", 0.01)
    monkeypatch.setattr(module, "ROWS_S", 0.01)
    monkeypatch.setattr(module, "STATE_S", 0.01)


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[Callable[..., Site]]:
    sites: list[Site] = []

    def make(**access: Any) -> Site:
        site = Site(tmp_path, Access(**access))
        site.users.add("ann", WORD, Role.CONFIGURE)
        site.client.__enter__()
        sites.append(site)
        return site

    yield make
    for site in sites:
        site.client.__exit__(None, None, None)
        if site.run:
            site.run.close()


@pytest.fixture
def site(opened: Callable[..., Site]) -> Site:
    return opened()


@pytest.fixture
def abroad(opened: Callable[..., Site]) -> Site:
    """A page that others than this machine reach."""
    return opened(open_to_see=False, secure=False)


# --- the curve of a range -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "query",
    [
        *("", "from=1", "from=2&to=1", "from=1&to=1", "from=-5&to=1", "from=x&to=2"),
        *("from=nan&to=2", "from=1&to=inf", "from=1&to=9e99", "from=1e6&to=2e6"),
    ],
)
def test_a_range_that_is_none_or_too_long_is_refused(site: Site, query: str) -> None:
    answer = site.client.get(f"/api/ejectors/0/curve?{query}")
    assert answer.status_code == 400
    assert "a range of time" in answer.json()["error"]


def test_a_range_without_logs_is_one_gap(site: Site) -> None:
    found = site.client.get(f"/api/ejectors/0/curve?from={NOW / 1e9 - 60}&to={NOW / 1e9}").json()
    assert found["time"] == found["phases"] == found["alarms"] == []
    assert found["gaps"] == [[NOW / 1e9 - 60, NOW / 1e9]]
    assert (found["share"], found["logged"]) == (1.0, False)
    assert site.client.get("/api/ejectors/1/curve?from=1&to=2").status_code == 404


# --- to see ---------------------------------------------------------------------------------------

SEEN = (
    *(
        "/",
        "/api/me",
        "/api/statistics",
        "/api/ejectors/0/history",
        "/api/ejectors/0/limits",
        "/api/ejectors/0/trends/leakage",
        "/api/ejectors/0/curve?from=1&to=2",
    ),
    *(f"{ASK}/1", f"/reports/0/{REPORT}"),
)


@pytest.mark.parametrize("path", SEEN)
def test_beyond_loopback_nothing_is_seen_without_login(abroad: Site, path: str) -> None:
    answer = abroad.client.get(path)
    if path == "/":
        assert (answer.status_code, answer.headers["location"]) == (303, "/login")
    else:
        assert answer.status_code == 401
    with pytest.raises(WebSocketDisconnect), _socket(abroad):
        pass


def test_beyond_loopback_who_is_logged_in_sees(abroad: Site) -> None:
    assert abroad.log_in().status_code == 303
    assert abroad.client.get("/").status_code == 200
    assert abroad.client.get("/api/me").json()["user"] == "ann"
    with _socket(abroad) as socket:
        assert socket.receive_json()["states"][0]["light"] == "grey"


def test_a_session_that_ends_ends_what_is_told(abroad: Site) -> None:
    abroad.log_in()
    with _socket(abroad) as socket:
        socket.receive_json()
        abroad.seconds = SESSION_S
        with pytest.raises(WebSocketDisconnect):
            _to_the_end(socket)
    assert abroad.client.get("/api/me").status_code == 401


def test_on_loopback_to_see_needs_no_login(site: Site) -> None:
    assert site.client.get("/").status_code == 200
    assert site.client.get("/api/me").json()["user"] == ""


def test_what_the_page_is_made_of_is_here(site: Site) -> None:
    text = site.client.get("/").text + site.client.get("/login").text
    assert "//" not in text.replace("//www.w3.org", "")  # of no other place
    for name, kind in STATIC.items():
        answer = site.client.get(f"/static/{name}")
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith(kind)
    first_view = [site.client.get("/"), *map(site.client.get, ("/api/me", "/api/all"))]
    files = [len(site.client.get(f"/static/{name}").content) for name in STATIC]
    assert sum(files) + sum(len(answer.content) for answer in first_view) < 100_000


def test_the_chart_library_is_served_as_the_page_s_own_files_are(tmp_path: Path) -> None:
    users = quick_users(tmp_path / "users.toml")
    library = dict.fromkeys(FILES, b"uPlot")
    page = Page([], authenticator_of(users), Sessions(users), Access(), library=library)
    client = TestClient(page.app(), OURS)
    own = client.get("/static/chart.js").headers
    for name, kind in FILES.items():
        answer = client.get(f"/static/{name}")
        assert answer.content == b"uPlot"
        assert answer.headers["content-type"].startswith(kind)
        assert answer.headers["cache-control"] == own["cache-control"]


@pytest.mark.parametrize(
    "path",
    [
        *("/static/../users.toml", "/static/%2e%2e/app.py", "/static/..%2fapp.py"),
        *("/static/index.html", "/static//etc/passwd", "/reports/0/..%2f..%2fusers.toml"),
        *("/reports/0/live.ring", f"/reports/1/{REPORT}", "/users.toml", "/reports/0/" + "g" * 32),
    ],
)
def test_no_path_from_outside_reaches_the_disk(site: Site, path: str) -> None:
    assert site.client.get(path).status_code == 404


def test_every_answer_says_what_a_browser_may_do_with_it(site: Site) -> None:
    for path in (
        "/",
        "/login",
        "/api/me",
        "/static/page.js",
        "/nowhere",
        "/api/ejectors/9/history",
    ):
        headers = site.client.get(path).headers
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["x-frame-options"] == "DENY"


@pytest.mark.parametrize("number", ["9" * 5000, "9" * 19, "-1", "1.0", "x", "%C2%B2"])
@pytest.mark.parametrize(
    "path", ["/api/ejectors/{}/history", f"/reports/{{}}/{REPORT}", ASK + "/{}"]
)
def test_what_is_no_number_is_not_found(site: Site, path: str, number: str) -> None:
    assert site.client.get(path.format(number)).status_code == 404


def test_errors_are_plain_pages_and_plain_json(site: Site) -> None:
    page = site.client.get("/<script>")
    assert page.status_code == 404
    assert "<h1>Not Found</h1>" in page.text
    assert site.client.get("/api/ejectors/9/history").json() == {"error": "no such ejector"}
    told = site.page._error_response(
        Request({"type": "http", "path": "/", "headers": [], "language": "en"}), 400, "<b>"
    )
    assert b"<b>" not in told.body
    wrong = site.client.get("/api/ejectors/0/history?days=nan")
    assert (wrong.status_code, "days" in wrong.json()["error"]) == (400, True)
    away = site.client.get("/api/ejectors/0/trends/leakage")
    assert (away.status_code, "no such figure database" in away.json()["error"]) == (503, True)
    assert site.client.get("/api/ejectors/0/trends/nonsense").status_code == 400


def test_a_trend_names_the_cycles_that_are_deleted(site: Site) -> None:
    asset = site.config.asset
    unit = Unit(asset.type, asset.id)
    ages = range(20)  # days, of a cycle each
    cycles = [
        {"cycle": age, "begin_ns": age, "host_ns": NOW - age * DAY_NS, "warnings": []}
        for age in ages
    ]
    path = Path(site.config.document.name).parent / "figures.sqlite"
    with open_figures(path) as store:
        store.add(unit, "a", "live", cycles)
        store.delete(unit, NOW - 9 * DAY_NS, most=100)
    month = site.client.get("/api/ejectors/0/trends/leakage?days=30").json()
    assert month["cycles"] == 10
    deleted = clock(NOW - 10 * DAY_NS, NOW)
    assert f"(cycles up to {deleted} are deleted; only later ones are used)" in month["words"]
    week = site.client.get("/api/ejectors/0/trends/leakage?days=7").json()
    assert "deleted" not in week["words"]


def test_a_report_is_shown_and_nothing_in_it_is_run(site: Site) -> None:
    folder = folder_of(site.config.document, site.config.asset) / REPORTS
    folder.mkdir(parents=True)
    (folder / f"{REPORT}.html").write_text("<h1>Leakage</h1>")
    answer = site.client.get(f"/reports/0/{REPORT}")
    assert answer.text == "<h1>Leakage</h1>"
    assert "sandbox" in answer.headers["content-security-policy"]
    assert "script-src" not in answer.headers["content-security-policy"]
    headers = {"accept-language": "de"}
    assert site.client.get(f"/reports/0/{REPORT}", headers=headers).text == "<h1>Leakage</h1>"
    (folder / f"{REPORT}.de.html").write_text("<h1>Leckage</h1>")
    assert site.client.get(f"/reports/0/{REPORT}", headers=headers).text == "<h1>Leckage</h1>"
    assert site.client.get(f"/reports/0/{REPORT}").text == "<h1>Leakage</h1>"
    (folder / "other.html").write_text("none of ours")
    assert site.client.get("/reports/0/other").status_code == 404
    gone = site.client.get(f"/reports/0/{'f' * 32}")
    assert (gone.status_code, "not kept any more" in gone.text) == (404, True)


# --- whose name this is ---------------------------------------------------------------------------


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example", "", "[x", "a@b"])
def test_a_foreign_name_that_leads_here_gets_nothing(site: Site, host: str) -> None:
    for path in ("/", "/api/me", "/static/page.js"):
        assert site.client.get(path, headers={"host": host}).status_code == 400
    headers = {"host": host, "origin": f"http://{host}"}
    with (
        pytest.raises(WebSocketDisconnect),
        site.client.websocket_connect("/live", headers=headers),
    ):
        pass


@pytest.mark.parametrize("host", ["localhost:8420", "[::1]:8420", "192.168.0.7", "Hall-7:80"])
def test_names_and_addresses_of_this_machine_are_answered(
    opened: Callable[..., Site], host: str
) -> None:
    site = opened(names=frozenset({"hall-7"}))
    assert site.client.get("/", headers={"host": host}).status_code == 200


# --- to log in ------------------------------------------------------------------------------------


def test_the_cookie_is_for_this_page_alone(site: Site) -> None:
    cookie = site.log_in().headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    assert "secure" not in cookie


def test_over_tls_the_cookie_is_never_sent_in_clear(opened: Callable[..., Site]) -> None:
    site = opened(secure=True)
    answer = site.log_in(origin="https://127.0.0.1:8420")
    assert "; secure" in answer.headers["set-cookie"].lower()
    assert site.log_in().status_code == 403  # from a page that is not over TLS


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "", "http://127.0.0.1:8421"])
def test_nobody_is_logged_in_from_another_page(site: Site, origin: str) -> None:
    assert site.log_in(origin=origin).status_code == 403
    assert COOKIE not in site.client.cookies


def test_wrong_passwords_are_refused_and_then_slowed_down(site: Site) -> None:
    said = [site.log_in("ann", "wrong horse") for _ in range(6)]
    assert [answer.status_code for answer in said] == [401] * 5 + [429]
    assert "Name or password is wrong." in said[0].text
    assert "Too many wrong passwords" in said[5].text
    assert site.log_in().status_code == 429  # also with the right one
    assert COOKIE not in site.client.cookies


def test_nobody_learns_which_names_there_are(site: Site) -> None:
    assert site.log_in("bob", WORD).text == site.log_in("ann", "wrong horse").text


def test_what_is_typed_in_is_not_markup(site: Site) -> None:
    assert "<script>" not in site.log_in("<script>", "<script>").text


def test_a_login_ends_the_session_before_it(site: Site) -> None:
    site.log_in()
    first = site.client.cookies[COOKIE]
    site.log_in()
    assert site.page.sessions.get(first) is None
    assert site.client.cookies[COOKIE] != first


def test_logging_out_ends_the_session(site: Site) -> None:
    site.log_in()
    token = site.client.cookies[COOKIE]
    csrf = site.client.get("/api/me").json()["csrf"]
    assert site.client.post("/api/logout", headers={"origin": OURS}).status_code == 403
    answer = site.client.post("/api/logout", headers={"origin": OURS, "x-csrf-token": csrf})
    assert answer.status_code == 200
    assert site.page.sessions.get(token) is None


def test_without_users_the_form_says_how_to_make_one(site: Site) -> None:
    site.users.remove("ann")
    assert "twin users add NAME" in site.client.get("/login").text


# --- to act ---------------------------------------------------------------------------------------


def test_who_is_logged_in_acknowledges(site: Site) -> None:
    run = site.begin()
    run.leak()
    _until(lambda: site.ejector.state()["alarms"])
    assert site.ejector.state()["light"] == "red"
    site.log_in()
    asked = site.ask()
    assert asked.status_code == 202
    number = asked.json()["request"]
    (alarm,) = site.ejector.state()["alarms"]
    assert (alarm["asked"][0]["deed"], alarm["asked"][0]["who"]) == ("acknowledged", "ann")
    assert site.client.get(f"{ASK}/{number}").json() == {"answer": None}

    def granted() -> bool:
        run.rest()
        return site.client.get(f"{ASK}/{number}").json() == {"answer": ""}

    _until(granted)
    state = site.ejector.state()
    assert (state["light"], state["alarms"][0]["seen_by"]) == ("yellow", "ann")
    assert state["alarms"][0]["asked"] == []


@pytest.mark.parametrize(
    ("role", "allowed"),
    [
        (Role.LOOK, []),
        (Role.ACKNOWLEDGE, ["acknowledged", "shelved", "unshelved", "commented"]),
        (
            Role.CONFIGURE,
            [
                "acknowledged",
                "shelved",
                "unshelved",
                "commented",
                "out_of_service",
                "in_service",
                "limit_changed",
            ],
        ),
    ],
)
def test_a_user_may_do_what_the_role_says(site: Site, role: Role, allowed: list[str]) -> None:
    _leaking(site)
    site.log_in()
    site.users.set_role("ann", role)  # holds at once
    assert site.client.get("/api/me").json()["may"] == allowed
    for deed in ("acknowledged", "shelved", "unshelved", "out_of_service", "in_service"):
        answer = site.ask(deed=deed, seconds=60.0)
        assert answer.status_code == (202 if deed in allowed else 403)
        if deed not in allowed:
            assert "it needs the role" in answer.json()["error"]
    asked = [deed for deed in allowed if deed not in ("commented", "limit_changed")]
    assert sorted(record.action.value for record in _asked(site)) == sorted(asked)


def test_a_user_with_a_name_of_any_letters_logs_in(site: Site) -> None:
    site.users.add("Schlüssel", "Grüße aus Ölde", Role.LOOK)
    assert site.log_in("Schlüssel", "Grüße aus Olde").status_code == 401
    assert site.log_in("Schlüssel", "Grüße aus Ölde").status_code == 303
    assert site.client.get("/api/me").json()["user"] == "Schlüssel"


def test_the_trail_says_who_did_what_from_where(site: Site, tmp_path: Path) -> None:
    _leaking(site)
    site.users.set_role("ann", Role.ACKNOWLEDGE)
    site.log_in("ann", "wrong horse")
    site.log_in()
    site.ask()
    site.ask(deed="shelved", seconds=60.0)
    site.ask(deed="shelved", seconds=-1)  # no run would grant it
    site.ask(deed="out_of_service")
    csrf = site.client.get("/api/me").json()["csrf"]
    site.client.post("/api/logout", headers={"origin": OURS, "x-csrf-token": csrf})
    told, _ = records(tmp_path)
    assert {(record["who"], record["through"], record["from"]) for record in told} == {
        ("ann", "page", "testclient")
    }
    alarm = {"unit": "gripper-01", "alarm": LEAK}
    known = ("time", "who", "through", "from")
    assert [{name: record[name] for name in record if name not in known} for record in told] == [
        {"what": "wrong_password"},
        {"what": "logged_in"},
        {"what": "acknowledged", **alarm},
        {"what": "shelved", **alarm},
        {"what": "denied", "wanted": "out_of_service"},
        {"what": "logged_out"},
    ]


def test_nothing_is_written_without_login(site: Site) -> None:
    _leaking(site)
    assert site.ask().status_code == 401
    assert site.ask(headers={"x-csrf-token": "guess"}).status_code == 401
    assert _asked(site) == []


def test_nothing_is_written_without_the_token_or_from_another_page(site: Site) -> None:
    _leaking(site)
    site.log_in()
    assert site.ask(headers={"x-csrf-token": ""}).status_code == 403
    assert site.ask(headers={"x-csrf-token": "guess"}).status_code == 403
    assert site.ask(headers={"x-csrf-token": "ü".encode("latin-1")}).status_code == 403
    for origin in ("http://evil.example", "null", "", "https://127.0.0.1:8420"):
        assert site.ask(headers={"origin": origin}).status_code == 403
    assert _asked(site) == []


def test_nothing_is_written_when_the_session_is_over(site: Site) -> None:
    _leaking(site)
    site.log_in()
    csrf = site.client.get("/api/me").json()["csrf"]
    site.seconds = SESSION_S
    assert site.ask(headers={"x-csrf-token": csrf}).status_code == 401
    assert _asked(site) == []


def test_what_no_run_would_grant_is_refused_at_once(site: Site) -> None:
    _leaking(site)
    site.log_in()
    for how, why in (
        ({"alarm": "leak"}, "no alarm is called leak"),
        ({"deed": "raised"}, "nothing that can be asked"),
        ({"deed": "shelved", "seconds": 1e9}, "cannot be shelved"),
        ({"deed": "shelved", "seconds": -1}, "cannot be shelved"),
        ({"deed": "shelved", "seconds": "nan"}, "cannot be shelved"),
    ):
        answer = site.ask(**how)
        assert answer.status_code == 400
        assert why in answer.json()["error"]
    assert _asked(site) == []


NO_REQUESTS = ("", "[]", "3", "{}", '{"alarm": 1}', "{" * 3000, "[" * 4000, "x" * 5000)
HUGE = f'{{"alarm": "{LEAK}", "deed": "acknowledged", "seconds": 1{"0" * 400}}}'


@pytest.mark.parametrize("body", [*NO_REQUESTS, HUGE])
def test_what_is_no_request_is_refused(site: Site, body: str) -> None:
    _leaking(site)
    site.log_in()
    csrf = site.client.get("/api/me").json()["csrf"]
    headers = {"origin": OURS, "x-csrf-token": csrf}
    answer = site.client.post(ASK, content=body, headers=headers)
    assert answer.status_code == (413 if len(body) > 4096 else 400)
    assert _asked(site) == []


def test_only_what_was_asked_here_is_answered(site: Site) -> None:
    _leaking(site)
    assert site.client.get(f"{ASK}/1").status_code == 400


# --- live -----------------------------------------------------------------------------------------


def test_rows_come_as_they_are_written(site: Site) -> None:
    run = site.begin()
    run.suck(1.0)
    with _socket(site) as socket:
        rows = _rows(socket)
        assert rows["measured_low"][0] == rows["measured_high"][0] == 600.0
        assert rows["expected_low"][0] == 650.0
        assert rows["host"][0] == NOW / 1e9
        assert set(rows["phase"]) == {1}
        run.suck(1.0, vacuum_mbar=700.0)
        later = _rows(socket)
        assert later["next"] > rows["next"]
        assert later["time"][0] > rows["time"][-1]
        assert later["measured_low"][-1] == 700.0


def test_who_comes_late_gets_all_rows_of_the_ring(site: Site) -> None:
    run = site.begin()
    run.suck(30.0)
    _until(lambda: (site.ejector.rows(0) or {"next": 0})["next"] >= 1199)
    rows = site.ejector.rows(0)
    assert rows is not None
    assert len(rows["time"]) >= 1199
    assert site.ejector.rows(rows["next"]) is None


def test_a_socket_from_another_page_is_refused(site: Site) -> None:
    for origin in ("http://evil.example", "null", ""):
        with pytest.raises(WebSocketDisconnect), _socket(site, origin):
            pass


@pytest.mark.parametrize("said", ["1", "-1", "x", "1e3"])
def test_a_browser_that_talks_nonsense_is_left(site: Site, said: str) -> None:
    with _socket(site) as socket:
        socket.send_text(said)
        with pytest.raises(WebSocketDisconnect):
            _to_the_end(socket)


# --- what is shown --------------------------------------------------------------------------------


def test_before_the_first_run_the_page_says_so(site: Site) -> None:
    state = site.ejector.state()
    assert (state["light"], state["last"], state["trouble"]) == ("grey", None, "")


def test_a_run_that_has_ended_is_said_and_its_alarms_stay(site: Site) -> None:
    run = site.begin()
    run.leak()
    run.close()
    site.run = None
    state = site.ejector.state()
    assert (state["light"], state["running"], state["ended"]) == ("grey", False, True)
    assert state["last"] == NOW / 1e9
    assert [alarm["alarm"] for alarm in state["alarms"]] == [LEAK]


def test_a_run_that_hangs_is_not_taken_for_one_that_is_well(site: Site) -> None:
    site.begin()
    _until(lambda: site.ejector.state()["light"] == "green")
    site.now += 6_000_000_000
    assert site.ejector.state()["light"] == "grey"


def test_alarms_that_cannot_be_read_are_never_green(site: Site, tmp_path: Path) -> None:
    site.begin().alarms.close()  # it would make another database
    assert site.ejector.state()["light"] == "green"
    (tmp_path / "alarms.sqlite").rename(tmp_path / "elsewhere")
    state = site.ejector.state()
    assert (state["light"], state["words"]) == ("grey", "Alarms unknown")
    assert "no such alarm database" in state["trouble"]
    assert not (tmp_path / "alarms.sqlite").exists()
    (tmp_path / "elsewhere").rename(tmp_path / "alarms.sqlite")
    assert site.ejector.state()["light"] == "green"


def test_an_alarm_says_what_where_how_sure_and_what_to_do(site: Site) -> None:
    _leaking(site)
    (alarm,) = site.ejector.state()["alarms"]
    assert alarm["what"] == "Leakage"
    assert alarm["where"] == "hoses, fittings and cups"
    assert alarm["action"].startswith("Look at hoses")
    assert dict(alarm["facts"])["how sure"].startswith("a first guess, or porous leakage")
    (episode,) = site.client.get("/api/ejectors/0/history").json()
    assert (episode["what"], episode["cleared"], episode["priority"]) == ("Leakage", None, "medium")


def test_what_another_alarm_explains_is_listed_as_quiet(site: Site) -> None:
    _leaking(site)
    assert site.run is not None
    site.run.say(Kind.PLC_STALE)
    _until(lambda: len(site.ejector.state()["alarms"]) == 2)
    stale, leak = site.ejector.state()["alarms"]
    assert (stale["alarm"], stale["state"]) == ("plc_stale", "unacknowledged")
    assert (leak["alarm"], leak["state"]) == (LEAK, "suppressed")


@pytest.mark.parametrize("missing", ["alarms", "page"])
def test_a_configuration_that_keeps_nothing_is_refused(tmp_path: Path, missing: str) -> None:
    kept = KEPT.replace(f"[{missing}]\nkeep = true", f"[{missing}]\nkeep = false")
    with pytest.raises(ConfigError, match=rf"under \[{missing}\]"):
        Ejector(config(write_config(tmp_path, kept=kept)))


# --- what the tests share -------------------------------------------------------------------------


def _socket(site: Site, origin: str = OURS, **headers: str) -> Any:
    headers |= {"origin": origin}
    return site.client.websocket_connect("ws://127.0.0.1:8420/live", headers=headers)


def _to_the_end(socket: Any) -> None:
    while True:
        socket.receive_json()


def _rows(socket: Any) -> dict[str, Any]:
    while True:
        told = socket.receive_json()
        if "rows" in told:
            rows: dict[str, Any] = told["rows"]
            return rows


def _leaking(site: Site) -> None:
    run = site.begin()
    run.leak()
    _until(lambda: site.ejector.state()["alarms"])


def _asked(site: Site) -> list[Any]:
    with site.ejector._alarms() as store:
        return store.requests(site.ejector._unit)


def _until(true: Callable[[], Any]) -> None:
    """Until a thread has done what it does: the test's own time limit ends it."""
    while not true():
        pass


# --- languages ------------------------------------------------------------------------------------

GERMAN = {"accept-language": "de"}


@pytest.mark.parametrize(
    ("headers", "language", "log_in", "alarm"),
    [({}, "en", "Log in", "Leakage"), (GERMAN, "de", "Anmelden", "Leckage")],
)
def test_pages_and_alarms_are_in_the_language_of_each_browser(
    site: Site, headers: dict[str, str], language: str, log_in: str, alarm: str
) -> None:
    _leaking(site)
    page = site.client.get("/login", headers=headers).text
    assert f'<html lang="{language}">' in page
    assert f"<h1>{log_in}</h1>" in page
    with _socket(site, **headers) as socket:
        (state,) = socket.receive_json()["states"]
    assert state["alarms"][0]["what"] == alarm
    texts = site.client.get("/static/texts.js", headers=headers).text
    assert f'const LANGUAGE = "{language}";' in texts
    assert ('"Shelve": "Zurückstellen"' in texts) is (language == "de")


def test_errors_are_in_the_language_of_each_browser(site: Site) -> None:
    answer = site.client.get("/api/ejectors/9/history", headers=GERMAN)
    assert answer.json() == {"error": "Diesen Ejektor gibt es nicht"}
    assert "<h1>Nicht gefunden</h1>" in site.client.get("/nothing", headers=GERMAN).text


def test_who_chooses_a_language_keeps_it(site: Site) -> None:
    answer = site.client.get("/language/de", headers={"referer": f"{OURS}/login"})
    assert (answer.status_code, answer.headers["location"]) == (303, "/login")
    assert "Anmelden" in site.client.get("/login", headers={"accept-language": "en"}).text
    elsewhere = {"referer": "http://evil.example//evil.example/"}
    assert site.client.get("/language/en", headers=elsewhere).headers["location"] == "/"
    assert site.client.get("/language/xx").status_code == 404


# --- statistics -----------------------------------------------------------------------------------


def test_statistics_are_of_what_was_raised(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.time, "time_ns", lambda: NOW + 60 * 10**9)
    _leaking(site)
    figures = dict(site.client.get("/api/statistics?days=1").json())
    assert figures["most frequent"] == "gripper-01: Leakage (100 %)"
    german = dict(site.client.get("/api/statistics?days=1", headers=GERMAN).json())
    assert german["am häufigsten"] == "gripper-01: Leckage (100 %)"
    assert site.client.get("/api/statistics?days=0").status_code == 400


# --- comments -------------------------------------------------------------------------------------


def _comment(site: Site, text: str, episode: Any = None, **headers: str) -> httpx2.Response:
    (alarm,) = site.ejector.state()["alarms"]
    csrf = site.client.get("/api/me").json().get("csrf", "")
    return site.client.post(
        "/api/ejectors/0/comments",
        json={"episode": episode or alarm["episode"], "text": text},
        headers={"origin": OURS, "x-csrf-token": csrf, **headers},
    )


def test_a_comment_stays_with_its_alarm_and_needs_no_run(site: Site, tmp_path: Path) -> None:
    _leaking(site)
    site.log_in()
    assert site.run
    site.run.close()
    site.run = None
    assert _comment(site, " new hose ordered ").status_code == 201
    said = [{"who": "ann", "when": "22:13:20, 0 s ago", "text": "new hose ordered"}]
    (alarm,), (episode,) = site.ejector.state()["alarms"], site.ejector.history(1.0)
    assert alarm["comments"] == episode["comments"] == said
    (record,) = [entry for entry in records(tmp_path)[0] if entry["what"] == "commented"]
    assert (record["who"], record["alarm"]) == ("ann", LEAK)


@pytest.mark.parametrize(
    ("text", "episode"),
    [
        ("", None),
        ("x" * 501, None),
        ("what", [LEAK, "1"]),
        ("what", ["no_alarm", str(NOW)]),
        ("what", [LEAK, "9" * 30]),
        ("what", [LEAK, -1]),
        ("what", [LEAK]),
        ("what", 7),
    ],
)
def test_a_comment_that_belongs_to_nothing_is_refused(site: Site, text: str, episode: Any) -> None:
    _leaking(site)
    site.log_in()
    assert _comment(site, text, episode).status_code == 400
    assert site.ejector.state()["alarms"][0]["comments"] == []


def test_only_who_may_acknowledge_comments(site: Site) -> None:
    _leaking(site)
    assert _comment(site, "what").status_code == 401
    site.log_in()
    assert _comment(site, "what", origin="http://evil.example").status_code == 403
    site.users.set_role("ann", Role.LOOK)
    assert _comment(site, "what").status_code == 403
    assert site.ejector.state()["alarms"][0]["comments"] == []


# --- limits ---------------------------------------------------------------------------------------

LIMITS = "/api/ejectors/0/limits"
CHANGE = {"limit": "permitted_t1_ms", "value": 700.0, "reason": "shorter cycle"}


def _change(site: Site, change: Any = CHANGE, **headers: str) -> httpx2.Response:
    csrf = site.client.get("/api/me").json().get("csrf", "")
    headers = {"origin": OURS, "x-csrf-token": csrf, **headers}
    return site.client.post(LIMITS, json=change, headers=headers)


def _limit(site: Site, key: str = "permitted_t1_ms") -> dict[str, Any]:
    limits = site.client.get(LIMITS).json()["limits"]
    return next(limit for limit in limits if limit["key"] == key)


def _applied(site: Site, number: int) -> None:
    run = site.run or site.begin()

    def answered() -> bool:
        run.rest()
        return site.client.get(f"{LIMITS}/{number}").json() == {"answer": ""}

    _until(answered)


def test_who_may_configure_changes_a_limit_and_everybody_sees_who_and_why(site: Site) -> None:
    site.begin()
    site.log_in()
    usual = _limit(site)
    changed = _change(site)
    assert changed.status_code == 202
    waiting = _limit(site)
    assert (waiting["value"], waiting["is_changed"]) == (usual["value"], False)
    assert waiting["asked"][0]["words"] == "to 700 ms"
    _applied(site, changed.json()["request"])
    limit = _limit(site)
    assert (limit["value_words"], limit["asked"], limit["is_changed"]) == ("700 ms", [], True)
    assert limit["configured_words"] == usual["value_words"]
    words = f"changed from {usual['value_words']} to 700 ms"
    newest = {name: limit["newest"][name] for name in ("words", "who", "reason")}
    assert newest == {"words": words, "who": "ann", "reason": "shorter cycle"}
    assert limit["newest"]["when"].endswith("0 s ago")
    assert site.ejector._limits().t1 == 700.0  # of trends
    reset = _change(site, CHANGE | {"value": None, "reason": "as it was"})
    _applied(site, reset.json()["request"])
    assert _limit(site)["is_changed"] is False
    back, first = site.client.get(LIMITS).json()["changes"]
    assert back["words"] == f"changed from 700 ms to {usual['value_words']}"
    assert (back["reason"], first["words"]) == ("as it was", words)


def test_the_trail_says_who_asked_for_which_limit(site: Site, tmp_path: Path) -> None:
    site.begin()
    site.log_in()
    _change(site)
    _change(site, CHANGE | {"value": None})
    told = [record for record in records(tmp_path)[0] if record["what"] == "limit_changed"]
    assert [
        (record["who"], record["limit"], record["value"], record["reason"]) for record in told
    ] == [
        ("ann", "permitted_t1_ms", "700", "shorter cycle"),
        ("ann", "permitted_t1_ms", "configured", "shorter cycle"),
    ]


@pytest.mark.parametrize("role", [Role.LOOK, Role.ACKNOWLEDGE])
def test_a_limit_is_changed_by_nobody_else(site: Site, role: Role) -> None:
    site.begin()
    assert _change(site).status_code == 401  # not logged in
    site.log_in()
    site.users.set_role("ann", role)
    denied = _change(site)
    assert denied.status_code == 403
    assert "it needs the role configure" in denied.json()["error"]
    assert site.client.get(LIMITS).json()["changes"] == []


def test_a_limit_is_changed_from_the_page_alone(site: Site) -> None:
    site.begin()
    site.log_in()
    for header in ({"x-csrf-token": "guess"}, {"origin": "http://evil.example"}):
        assert _change(site, **header).status_code == 403
    assert site.client.get(LIMITS).json()["changes"] == []


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (CHANGE | {"limit": "t1"}, "no limit is called"),
        (CHANGE | {"value": 1.0}, "must be 10 ms to 60000 ms"),
        (CHANGE | {"value": "nan"}, "must be 10 ms to 60000 ms"),
        (CHANGE | {"value": "high"}, "not a change of a limit"),
        (CHANGE | {"reason": "  "}, "a reason has 1 to 200 letters"),
        (CHANGE | {"reason": "x" * 201}, "a reason has 1 to 200 letters"),
        ({"limit": "permitted_t1_ms", "reason": "no value"}, "not a change of a limit"),
        (CHANGE | {"limit": "supply_low_bar", "value": 16.0}, "must be below the highest"),
        ([], "not a change of a limit"),
    ],
)
def test_a_limit_that_cannot_be_is_refused_at_once(site: Site, change: Any, why: str) -> None:
    site.begin()
    site.log_in()
    answer = _change(site, change)
    assert answer.status_code == 400
    assert why in answer.json()["error"]
    assert site.client.get(LIMITS).json()["changes"] == []


def test_beyond_loopback_limits_are_seen_after_the_login_only(abroad: Site) -> None:
    abroad.begin()
    assert abroad.client.get(LIMITS).status_code == 401
    assert abroad.client.get(f"{LIMITS}/1").status_code == 401
    abroad.log_in()
    assert abroad.client.get(LIMITS).status_code == 200
    assert abroad.client.get(f"{LIMITS}/1").status_code == 400  # nobody has asked for it here
