"""The page over HTTP: access rights, and the answers to the browser.

Nothing from outside becomes part of a path. Served files are in tables that are built at the start,
and a report is found by the name that the run gave it.
"""

import asyncio
import hmac
import html
import ipaddress
import json
import re
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from importlib import resources
from string import Template
from typing import Any
from urllib.parse import parse_qs, urlsplit

from anyio.to_thread import run_sync
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection, Request
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from twin.alarms.state import AlarmAction
from twin.alarms.statistics import in_words, statistics
from twin.audit import Act
from twin.errors import TwinError
from twin.instants import DAY_NS
from twin.languages.catalogues import Catalogues
from twin.languages.texts import speaking, tr
from twin.login import Authenticator
from twin.page.chart_library import FILES
from twin.page.ejector import Ejector
from twin.page.plant_overview import PlantOverview
from twin.page.plant_overview_app import ALL, AllEjectors
from twin.page.sessions import SESSION_S, Session, Sessions
from twin.users import Role

COOKIE = "ejector-twin"
LANGUAGE = "ejector-twin-language"  # the cookie with a chosen language
LANGUAGE_S = 365 * 86_400
MARKED = re.compile(r"\{\{(.+?)\}\}")  # a text of a page to be translated
TOKEN = "x-csrf-token"  # noqa: S105  # a header's name
LONGEST_COMMENT = 500  # letters
LONGEST_REASON = 200  # letters, of a change of a limit
MOST_BODY = 4096  # bytes of a request's body
MOST_DAYS = 400.0
LONGEST_S = 48 * 3600.0  # range of a curve: its bins fit into what is kept of them
LATEST_S = 9e9  # its nanoseconds fit into 64 bits
ROWS_S = 0.03  # interval of batches of live rows: a block of the loop, about 20 batches a second
STATE_S = 1.0  # interval at which alarms are read
MOST_DIGITS = 18  # of a number, so that it fits into a database
# What reading an invalid body raises, also for endless nesting.
NO_REQUEST = (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError)
SLOWEST_S = 20.0  # limit for a browser to take one message, or to send a request's body
NEEDED: dict[str, Role] = {  # role that a request to an alarm needs
    AlarmAction.ACKNOWLEDGED: Role.ACKNOWLEDGE,
    AlarmAction.SHELVED: Role.ACKNOWLEDGE,
    AlarmAction.UNSHELVED: Role.ACKNOWLEDGE,
    Act.COMMENTED: Role.ACKNOWLEDGE,
    AlarmAction.OUT_OF_SERVICE: Role.CONFIGURE,  # without a time limit, and for every shift
    AlarmAction.IN_SERVICE: Role.CONFIGURE,
    Act.LIMIT_CHANGED: Role.CONFIGURE,
}

STATIC = {
    "icon.svg": "image/svg+xml",
    "chart.js": "text/javascript",
    "common.js": "text/javascript",
    "all.js": "text/javascript",
    "page.js": "text/javascript",
    "page.css": "text/css",
}
CSP = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self';"
    " frame-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
# A report contains its style. Nothing in it is executed.
REPORT_CSP = (
    "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none';"
    " frame-ancestors 'self'; sandbox allow-popups"
)
REPORT_HEADERS = {"content-security-policy": REPORT_CSP, "x-frame-options": "SAMEORIGIN"}
HEADERS = {
    "content-security-policy": CSP,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}


@dataclass(frozen=True)
class Access:
    """How the page is reached, and the access rules that follow."""

    names: frozenset[str] = frozenset()  # of this machine, besides its addresses and localhost
    secure: bool = False  # over TLS
    open_to_see: bool = True  # on loopback only: reading needs no login, acting does

    def is_ours(self, host: str) -> bool:
        """Whether a Host header names this machine: a foreign name may point here by its DNS."""
        try:
            name = (urlsplit(f"//{host}").hostname or "").lower()
        except ValueError:
            return False
        if name == "localhost" or name in self.names:
            return True
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True

    def is_own_origin(self, headers: Headers) -> bool:
        """Whether a request comes from this program's own page."""
        scheme = "https" if self.secure else "http"
        return headers.get("origin") == f"{scheme}://{headers.get('host', '')}"


class Page:
    """The routes of the page and their handlers."""

    def __init__(
        self,
        ejectors: Sequence[Ejector],
        authenticator: Authenticator,
        sessions: Sessions,
        access: Access,
        plant: PlantOverview | None = None,
        library: Mapping[str, bytes] | None = None,
    ) -> None:
        """``library`` are the files of the chart library; without it no curve is drawn."""
        self.plant = plant
        self.ejectors, self.sessions, self.access = ejectors, sessions, access
        self._authenticator, self.users = authenticator, authenticator.users
        self._catalogues = Catalogues()
        self._states = [
            {code: _CachedState(ejector.state) for code in self._catalogues.languages}
            for ejector in ejectors
        ]
        self._login_lock = asyncio.Lock()  # one at a time: its hash takes memory and time
        self._trend_lock = asyncio.Lock()
        self._curve_lock = asyncio.Lock()
        files = resources.files("twin.page").joinpath("static")
        self._static = {name: files.joinpath(name).read_bytes() for name in STATIC}
        self._static |= library or {}
        self._pages = {
            name: files.joinpath(name).read_text(encoding="utf-8")
            for name in ("index.html", "all.html", "login.html", "error.html")
        }

    def app(self) -> ASGIApp:
        """The ASGI application for uvicorn."""
        ejector_path = "/api/ejectors/{number}"
        routes: list[BaseRoute] = [
            Route("/", self.index),
            Route("/login", self.login_page),
            Route("/login", self.login, methods=["POST"]),
            Route("/api/logout", self.logout, methods=["POST"]),
            Route("/static/texts.js", self.texts),
            Route("/static/{name}", self.static),
            Route("/language/{code}", self.choose_language),
            Route("/api/me", self.me),
            Route("/api/statistics", self.statistics),
            Route(f"{ejector_path}/history", self.history),
            Route(f"{ejector_path}/trends/{{name}}", self.trend),
            Route(f"{ejector_path}/curve", self.curve),
            Route(f"{ejector_path}/requests", self.ask, methods=["POST"]),
            Route(f"{ejector_path}/comments", self.comment, methods=["POST"]),
            Route(f"{ejector_path}/requests/{{request_number}}", self.answer),
            Route(f"{ejector_path}/limits", self.limits),
            Route(f"{ejector_path}/limits", self.change_limit, methods=["POST"]),
            Route(f"{ejector_path}/limits/{{request_number}}", self.limit_answer),
            Route("/reports/{number}/{name}", self.report),
            WebSocketRoute("/live", self.live),
        ]
        if self.plant is not None:
            routes += AllEjectors(self.plant, self._require_sight).routes()
            routes.append(Route(ALL, self.all_page))
        handlers: dict[Any, Any] = {HTTPException: self.refused, TwinError: self.trouble}

        app = Starlette(routes=routes, exception_handlers=handlers)
        return _Guard(app, self.access, self._catalogues)

    # --- languages ------------------------------------------------------------------------------

    def _page(self, connection: HTTPConnection, name: str, **values: str) -> str:
        """A page in the reader's language; ``values`` are HTML already."""
        markup = MARKED.sub(lambda match: html.escape(tr(match[1])), self._pages[name])
        return Template(markup).substitute(values, language=connection.scope["language"])

    async def texts(self, request: Request) -> Response:
        """The texts of scripts in the reader's language."""
        code = request.scope["language"]
        language = self._catalogues.languages[code]
        constants = {
            "LANGUAGE": code,
            "TEXTS": self._catalogues.of_scripts(code),
            "DECIMAL": language.decimal,
            "GROUP": language.group,
        }
        script = "".join(
            f"const {name} = {json.dumps(value, ensure_ascii=False)};\n"
            for name, value in constants.items()
        )
        # gettext writes the index of a plural form in C, which JavaScript reads as well.
        script += f"const pluralForm = (n) => Number({self._catalogues.plural_expression(code)});\n"
        return Response(script, media_type="text/javascript")

    async def choose_language(self, request: Request) -> Response:
        """Store a chosen language in a cookie, and redirect to the previous page."""
        code = request.path_params["code"]
        if code not in self._catalogues.languages:
            raise HTTPException(HTTPStatus.NOT_FOUND)
        previous = urlsplit(request.headers.get("referer", "")).path
        target = previous if previous in (ALL, "/login") else "/"
        answer = RedirectResponse(target, HTTPStatus.SEE_OTHER)
        answer.set_cookie(
            LANGUAGE,
            code,
            max_age=LANGUAGE_S,
            httponly=True,
            samesite="strict",
            secure=self.access.secure,
        )
        return answer

    # --- authentication -------------------------------------------------------------------------

    def _session(self, connection: HTTPConnection) -> Session | None:
        return self.sessions.get(connection.cookies.get(COOKIE))

    def _may_see(self, connection: HTTPConnection) -> bool:
        return self.access.open_to_see or self._session(connection) is not None

    def _require_sight(self, request: Request) -> None:
        if not self._may_see(request):
            raise HTTPException(HTTPStatus.UNAUTHORIZED, tr("log in first"))

    def _require_session(self, request: Request) -> Session:
        """The session of a request for a change: own origin, logged in, with the CSRF token."""
        if not self.access.is_own_origin(request.headers):
            raise HTTPException(HTTPStatus.FORBIDDEN, tr("this was not asked from the page itself"))
        session = self._session(request)
        if session is None:
            raise HTTPException(HTTPStatus.UNAUTHORIZED, tr("log in first"))
        if not _same(request.headers.get(TOKEN, ""), session.csrf):
            missing = tr("the token is missing: load the page again")
            raise HTTPException(HTTPStatus.FORBIDDEN, missing)
        return session

    async def _require_role(self, request: Request, session: Session, action: str) -> None:
        """Require the role for a request, by the users' present roles, not those at the login."""
        role, needed = self.users.role(session.user), NEEDED.get(action, Role.CONFIGURE)
        if role is None or not role.covers(needed):
            await self._record(request, Act.DENIED, session.user, wanted=action)
            raise HTTPException(
                HTTPStatus.FORBIDDEN,
                tr(
                    "{user} may not do this: it needs the role {role}; who looks after the users"
                    " gives it with twin users role",
                    user=session.user,
                    role=needed,
                ),
            )

    async def _record(self, request: Request, act: str, user: str, **details: str) -> None:
        record = partial(self._authenticator.audit.record, **details)
        await run_sync(record, act, user, _address(request))

    async def login_page(self, request: Request) -> Response:
        """The login form."""
        return self._login_form(request)

    def _login_form(self, request: Request, message: str = "", status: int = 200) -> Response:
        if not message and not self.users.names:
            message = tr("There are no users yet. On the machine of the page: twin users add NAME")
        role = ' role="alert"' if message else ""
        languages = " ".join(
            f'<a href="/language/{language["code"]}" lang="{language["code"]}">'
            f"{html.escape(language['name'])}</a>"
            for language in self._catalogues.names
        )
        values = {"said": html.escape(message), "role": role, "languages": languages}
        return HTMLResponse(self._page(request, "login.html", **values), status)

    async def login(self, request: Request) -> Response:
        """Log in with name and password; after wrong ones there is a wait."""
        if not self.access.is_own_origin(request.headers):
            raise HTTPException(HTTPStatus.FORBIDDEN, tr("this was not asked from the page itself"))
        form = parse_qs((await _body(request)).decode(errors="replace"), max_num_fields=5)
        name, password = (form.get(key, [""])[0] for key in ("name", "password"))
        async with self._login_lock:
            log_in = self._authenticator.log_in
            login = await run_sync(log_in, name, password, _address(request))
        if login.role is None:
            message, status = tr("Name or password is wrong."), HTTPStatus.UNAUTHORIZED
            if login.wait_s > 0.0:
                wait = f"{login.wait_s:.0f}"
                message = tr("Too many wrong passwords. Try again in {wait} s.", wait=wait)
                status = HTTPStatus.TOO_MANY_REQUESTS
            return self._login_form(request, message, status)
        self.sessions.end(request.cookies.get(COOKIE))
        answer = RedirectResponse("/", HTTPStatus.SEE_OTHER)
        answer.set_cookie(
            COOKIE,
            self.sessions.begin(login.user),
            max_age=round(SESSION_S),
            httponly=True,
            samesite="strict",
            secure=self.access.secure,
        )
        return answer

    async def logout(self, request: Request) -> Response:
        """End the session."""
        session = self._require_session(request)
        await self._record(request, Act.LOGGED_OUT, session.user)
        self.sessions.end(request.cookies.get(COOKIE))
        answer = JSONResponse({})
        answer.delete_cookie(COOKIE, httponly=True, samesite="strict", secure=self.access.secure)
        return answer

    async def me(self, request: Request) -> Response:
        """The logged-in user with the CSRF token, and the ejectors and figures to show."""
        self._require_sight(request)
        session = self._session(request)
        user: dict[str, Any] = {"user": "", "may": []}
        if session is not None:
            role = self.users.role(session.user)
            may = [action for action, needed in NEEDED.items() if role and role.covers(needed)]
            user = {"user": session.user, "csrf": session.csrf, "may": may}
        ejectors = [
            {"name": ejector.name, "type": ejector.config.asset.type} for ejector in self.ejectors
        ]
        figures = self.ejectors[0].figures() if self.ejectors else []
        common = {"ejectors": ejectors, "figures": figures, "all": self.plant is not None}
        common["languages"] = self._catalogues.names
        return JSONResponse({**user, **common})

    # --- pages ----------------------------------------------------------------------------------

    async def index(self, request: Request) -> Response:
        """The page itself; it requests the rest."""
        if not self._may_see(request):
            return RedirectResponse("/login", HTTPStatus.SEE_OTHER)
        if not self.ejectors:
            return RedirectResponse(ALL, HTTPStatus.SEE_OTHER)
        return HTMLResponse(self._page(request, "index.html"))

    async def all_page(self, request: Request) -> Response:
        """The page over all ejectors of a broker."""
        if not self._may_see(request):
            return RedirectResponse("/login", HTTPStatus.SEE_OTHER)
        return HTMLResponse(self._page(request, "all.html"))

    async def static(self, request: Request) -> Response:
        """A static file of the page."""
        name = request.path_params["name"]
        if name not in self._static:
            raise HTTPException(HTTPStatus.NOT_FOUND)
        headers = {"cache-control": "no-cache"}
        return Response(self._static[name], headers=headers, media_type=(STATIC | FILES)[name])

    async def report(self, request: Request) -> Response:
        """The HTML report of a diagnosis."""
        self._require_sight(request)
        name, code = request.path_params["name"], request.scope["language"]
        content = await run_sync(self._ejector(request).report, name, code)
        if content is None:
            raise HTTPException(HTTPStatus.NOT_FOUND, tr("this report is not kept any more"))
        return HTMLResponse(content, headers=REPORT_HEADERS)

    # --- data -----------------------------------------------------------------------------------

    def _ejector(self, request: Request) -> Ejector:
        number = _number(request, "number")
        if number >= len(self.ejectors):
            raise HTTPException(HTTPStatus.NOT_FOUND, tr("no such ejector"))
        return self.ejectors[number]

    async def history(self, request: Request) -> Response:
        """The episodes of all alarms."""
        self._require_sight(request)
        return JSONResponse(await run_sync(self._ejector(request).history, _days(request)))

    async def statistics(self, request: Request) -> Response:
        """The alarm load of all ejectors of the page together."""
        self._require_sight(request)
        now_ns = time.time_ns()
        since_ns = now_ns - round(_days(request) * DAY_NS)
        return JSONResponse(await run_sync(self._statistics, since_ns, now_ns))

    def _statistics(self, since_ns: int, now_ns: int) -> list[tuple[str, str]]:
        episodes = [episode for ejector in self.ejectors for episode in ejector.episodes(since_ns)]
        of_name = {ejector.name: ejector for ejector in self.ejectors}

        def title(key: tuple[str, str]) -> str:
            name, alarm = key
            return f"{name}: {of_name[name].title(alarm)}"

        return in_words(statistics(episodes, since_ns, now_ns), title, now_ns)

    async def trend(self, request: Request) -> Response:
        """The trend of a figure over days; one request at a time."""
        self._require_sight(request)
        ejector, name = self._ejector(request), request.path_params["name"]
        async with self._trend_lock:
            return JSONResponse(await run_sync(ejector.trend, name, _days(request)))

    async def curve(self, request: Request) -> Response:
        """The curve of a range of time; one request at a time, for about a second at most."""
        self._require_sight(request)
        ejector, (from_ns, to_ns) = self._ejector(request), _range(request)
        async with self._curve_lock:
            return JSONResponse(await run_sync(ejector.curve, from_ns, to_ns))

    async def ask(self, request: Request) -> Response:
        """Send a request about an alarm to the run; returns the number to get its answer by."""
        session = self._require_session(request)
        ejector = self._ejector(request)
        try:
            body = json.loads(await _body(request))
            alarm, action = str(body["alarm"]), str(body["deed"])
            seconds = float(body.get("seconds", 0.0))
        except NO_REQUEST as error:
            raise HTTPException(HTTPStatus.BAD_REQUEST, "not a request") from error
        await self._require_role(request, session, action)
        number = await run_sync(ejector.ask, alarm, action, session.user, seconds)
        await self._record(request, action, session.user, unit=ejector.name, alarm=alarm)
        return JSONResponse({"request": number}, HTTPStatus.ACCEPTED)

    async def comment(self, request: Request) -> Response:
        """Store a comment on an alarm."""
        session = self._require_session(request)
        ejector = self._ejector(request)
        try:
            body = json.loads(await _body(request))
            (name, raised), text = body["episode"], str(body["text"]).strip()
            alarm, raised_ns = str(name), _instant(str(raised))
        except NO_REQUEST as error:
            raise HTTPException(HTTPStatus.BAD_REQUEST, "not a comment") from error
        if not 0 < len(text) <= LONGEST_COMMENT:
            hint = tr("a comment has 1 to {most} letters", most=LONGEST_COMMENT)
            raise HTTPException(HTTPStatus.BAD_REQUEST, hint)
        await self._require_role(request, session, Act.COMMENTED)
        await run_sync(ejector.comment, alarm, raised_ns, session.user, text)
        await self._record(request, Act.COMMENTED, session.user, unit=ejector.name, alarm=alarm)
        return JSONResponse({}, HTTPStatus.CREATED)

    async def answer(self, request: Request) -> Response:
        """The answer to a request: null while there is none, empty if it was done."""
        self._require_sight(request)
        number = _number(request, "request_number")
        return JSONResponse({"answer": await run_sync(self._ejector(request).answer, number)})

    # --- limits ---------------------------------------------------------------------------------

    async def limits(self, request: Request) -> Response:
        """The limits of an ejector, and who has changed them."""
        self._require_sight(request)
        return JSONResponse(await run_sync(self._ejector(request).limits))

    async def change_limit(self, request: Request) -> Response:
        """Ask the run to change a limit; returns the number to get its answer by."""
        session = self._require_session(request)
        ejector = self._ejector(request)
        try:
            body = json.loads(await _body(request))
            limit, reason = str(body["limit"]), str(body["reason"]).strip()
            value = None if body["value"] is None else float(body["value"])
        except NO_REQUEST as error:
            raise HTTPException(HTTPStatus.BAD_REQUEST, "not a change of a limit") from error
        await self._require_role(request, session, Act.LIMIT_CHANGED)
        if not 0 < len(reason) <= LONGEST_REASON:
            hint = tr("a reason has 1 to {most} letters", most=LONGEST_REASON)
            raise HTTPException(HTTPStatus.BAD_REQUEST, hint)
        number = await run_sync(ejector.change_limit, limit, value, session.user, reason)
        details = {"unit": ejector.name, "limit": limit, "reason": reason}
        details["value"] = "configured" if value is None else f"{value:g}"
        await self._record(request, Act.LIMIT_CHANGED, session.user, **details)
        return JSONResponse({"request": number}, HTTPStatus.ACCEPTED)

    async def limit_answer(self, request: Request) -> Response:
        """The answer to a change: null while there is none, empty if it was applied."""
        self._require_sight(request)
        number = _number(request, "request_number")
        return JSONResponse({"answer": await run_sync(self._ejector(request).limit_answer, number)})

    # --- live -----------------------------------------------------------------------------------

    async def live(self, socket: WebSocket) -> None:
        """Send all ejectors' states every second, and rows of the one that the browser watches.

        A slow browser gets only the newest data; the server does not wait for it.
        """
        allowed = self.access.is_own_origin(socket.headers) and self._may_see(socket)
        if not (allowed and self.ejectors):
            await socket.close(1008)
            return
        await socket.accept()
        watched = _Watched()
        updates = asyncio.create_task(self._send_updates(socket, watched))
        try:
            while True:
                watched.take(await socket.receive_text(), len(self.ejectors))
        except (WebSocketDisconnect, ValueError):
            pass
        finally:
            updates.cancel()
            with suppress(asyncio.CancelledError, WebSocketDisconnect, TimeoutError):
                await updates

    async def _send_updates(self, socket: WebSocket, watched: "_Watched") -> None:
        """Send updates until the browser is gone or too slow, or its session has ended."""
        loop = asyncio.get_running_loop()
        next_state = 0.0
        try:
            while self._may_see(socket):
                if loop.time() >= next_state:
                    next_state = loop.time() + STATE_S
                    code = socket.scope["language"]
                    states = [
                        await states_by_language[code].get() for states_by_language in self._states
                    ]
                    await _send(socket, {"states": states})
                await self._send_rows(socket, watched)
                await asyncio.sleep(ROWS_S)
        finally:
            with suppress(RuntimeError, WebSocketDisconnect):  # it is closed already
                await socket.close(1008)

    async def _send_rows(self, socket: WebSocket, watched: "_Watched") -> None:
        """Send new rows of the watched ejector."""
        number, since = watched.number, watched.since
        rows = await run_sync(self.ejectors[number].rows, since)
        if rows is None or (number, since) != (watched.number, watched.since):
            return
        watched.since = rows["next"]
        await _send(socket, {"rows": rows, "of": number})

    # --- errors ---------------------------------------------------------------------------------

    async def refused(self, request: Request, error: HTTPException) -> Response:
        """A refused request, as a plain page or as JSON."""
        return self._error_response(request, error.status_code, error.detail)

    async def trouble(self, request: Request, error: TwinError) -> Response:
        """An error that a person can correct."""
        status = HTTPStatus.BAD_REQUEST if error.exit_code == 2 else HTTPStatus.SERVICE_UNAVAILABLE
        return self._error_response(request, status, str(error))

    def _error_response(self, request: Request, status: int, message: str) -> Response:
        if request.url.path.startswith("/api/"):
            return JSONResponse({"error": message}, status)
        title, message = tr(HTTPStatus(status).phrase), tr(message)  # maybe both the status phrase
        values = {"title": html.escape(title), "what": html.escape(message)}
        return HTMLResponse(self._page(request, "error.html", **values), status)


class _CachedState:
    """A state that several browsers request; it is read at most once a second."""

    def __init__(self, read_state: Callable[[], dict[str, Any]]) -> None:
        self._read_state = read_state
        self._lock = asyncio.Lock()
        self._read_s = float("-inf")
        self._state: dict[str, Any] = {}

    async def get(self) -> dict[str, Any]:
        loop = asyncio.get_running_loop()
        async with self._lock:
            if loop.time() >= self._read_s + 0.9 * STATE_S:
                self._state, self._read_s = await run_sync(self._read_state), loop.time()
            return self._state


class _Watched:
    """The ejector that a browser shows, and the next row to send."""

    def __init__(self) -> None:
        self.number = self.since = 0

    def take(self, text: str, ejectors: int) -> None:
        """Take the browser's choice; ValueError unless it is the number of an ejector."""
        number = int(text)
        if not 0 <= number < ejectors:
            raise ValueError
        self.number, self.since = number, 0


class _Guard:
    """Checks the host and sets the reader's language before each request.

    It adds the common headers to every answer.
    """

    def __init__(self, app: ASGIApp, access: Access, catalogues: Catalogues) -> None:
        self._app, self._access, self._catalogues = app, access, catalogues

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        if not self._access.is_ours(Headers(scope=scope).get("host", "")):
            if scope["type"] == "websocket":
                await send({"type": "websocket.close", "code": 1008})
                return
            refusal = Response("This page has another name.\n", HTTPStatus.BAD_REQUEST)
            await refusal(scope, receive, _with_headers(send))
            return
        connection = HTTPConnection(scope)
        accepted = connection.headers.get("accept-language", "")
        code = self._catalogues.choose(connection.cookies.get(LANGUAGE, ""), accepted)
        scope["language"] = code
        with speaking(self._catalogues.languages[code]):
            await self._app(scope, receive, _with_headers(send))


def _with_headers(send: Send) -> Send:
    async def with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            existing = {name for name, _ in message["headers"]}
            message["headers"] = [
                *message["headers"],
                *(
                    (name.encode(), value.encode())
                    for name, value in HEADERS.items()
                    if name.encode() not in existing
                ),
            ]
        await send(message)

    return with_headers


async def _send(socket: WebSocket, document: Any) -> None:
    async with asyncio.timeout(SLOWEST_S):
        await socket.send_text(json.dumps(document, ensure_ascii=False, allow_nan=False))


async def _body(request: Request) -> bytes:
    """The body of a request, up to MOST_BODY bytes."""
    body = b""
    try:
        async with asyncio.timeout(SLOWEST_S):
            async for part in request.stream():
                body += part
                if len(body) > MOST_BODY:
                    raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "that is too much")
    except TimeoutError as error:
        raise HTTPException(HTTPStatus.REQUEST_TIMEOUT, "that takes too long") from error
    return body


def _address(request: Request) -> str:
    return request.client.host if request.client else ""


def _number(request: Request, name: str) -> int:
    """A number in the path; NOT_FOUND for anything else, and for a number that is too long."""
    text = str(request.path_params[name])
    if not (text.isascii() and text.isdigit() and len(text) <= MOST_DIGITS):
        raise HTTPException(HTTPStatus.NOT_FOUND)
    return int(text)


def _instant(digits: str) -> int:
    """Nanoseconds that fit into a database; ValueError for anything else."""
    if not (digits.isascii() and digits.isdigit() and len(digits) <= MOST_DIGITS + 1):
        raise ValueError
    return min(int(digits), 2**63 - 1)


def _days(request: Request) -> float:
    try:
        days = float(request.query_params.get("days", "7"))
    except ValueError:
        days = -1.0
    if not 0.0 < days <= MOST_DAYS:
        raise HTTPException(HTTPStatus.BAD_REQUEST, f"days: up to {MOST_DAYS:g}")
    return days


def _range(request: Request) -> tuple[int, int]:
    """The range of time (ns) that a request names by Unix seconds."""
    try:
        begin, end = (float(request.query_params.get(name, "")) for name in ("from", "to"))
    except ValueError:
        begin = end = -1.0
    if not 0.0 <= begin < end <= LATEST_S:
        hint = tr("a range of time has a beginning and, later, an end")
        raise HTTPException(HTTPStatus.BAD_REQUEST, hint)
    if end - begin > LONGEST_S:
        hint = tr("a range of time is at most {hours} h", hours=round(LONGEST_S / 3600))
        raise HTTPException(HTTPStatus.BAD_REQUEST, hint)
    return round(begin * 1e9), round(end * 1e9)


def _same(first: str, second: str) -> bool:
    return hmac.compare_digest(first.encode(), second.encode())
