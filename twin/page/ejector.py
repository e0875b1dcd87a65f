"""One ejector for the page: reads what its run and its databases have stored, anew each time.

All methods may wait for a disk or a database, so the page calls them in a thread.
"""

import math
import re
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from twin.alarms.board import Board, Comment, Episode
from twin.alarms.database import Store as AlarmStore
from twin.alarms.database_url import open_chosen as open_alarms
from twin.alarms.limits import UnitLimits
from twin.alarms.requests import ASKABLE
from twin.alarms.settings import AlarmSettings, board_rules
from twin.alarms.state import AlarmAction
from twin.assets.unit import Unit
from twin.config import Config
from twin.errors import ConfigError, TwinError
from twin.figures.database import SIDES
from twin.figures.database_url import open_chosen as open_figures
from twin.figures.key_figures import FIGURES, Figure
from twin.figures.settings import Limits
from twin.figures.text import course_in_words, deleted_in_words, title_of, trend_of_figure
from twin.figures.trend import Trend
from twin.instants import DAY_NS, zone
from twin.languages.choice import translation_of
from twin.languages.texts import tr
from twin.page import ring
from twin.page.bins import json_numbers
from twin.page.curve import Curves, document_of
from twin.page.ejector_status import (
    S_NS,
    WORDS,
    Light,
    alarm_cards,
    describe_alarm,
    episode_details,
    instant_text,
    light_of,
    priority_words,
)
from twin.page.limits import limits_document
from twin.page.settings import REPORTS, RING, PageSettings, folder_of
from twin.quality import BREAK
from twin.signals import MBAR

MOST_EPISODES = 500
MOST_POINTS = 600  # cycles in a trend
AHEAD = 0.25  # extrapolation over the record's length if no limit is reached
REPORT = re.compile(r"[0-9a-f]{32}")


class Ejector:
    """The data of one ejector for its page; ConfigError if a run stores nothing for it."""

    def __init__(self, config: Config, clock: Callable[[], int] = time.time_ns) -> None:
        document = config.document
        settings = {
            "alarms": document.section(AlarmSettings, "alarms").keep,
            "page": document.section(PageSettings, "page").keep,
        }
        lacking = [f"[{name}]" for name, is_kept in settings.items() if not is_kept]
        if lacking:
            tables = " and ".join(lacking)
            raise ConfigError(
                f"{document.name}: twin run keeps nothing for its page under {tables}",
                f"put keep = true under {tables} and start twin run again",
            )
        self.config, self._clock = config, clock
        self.name = config.asset.id or config.asset.type
        self._rules = board_rules(document)
        self._configured = UnitLimits.of(config)
        self._folder = folder_of(document, config.asset)
        self._unit = Unit(config.asset.type, config.asset.id)
        self._curves = Curves(self._folder, (self._unit.type, self._unit.id))
        self._asked: set[int] = set()  # numbers of requests made through this page
        self._changes: set[int] = set()  # numbers of changes of limits made through this page

    # --- status ---------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Status, alarms and state of the run; it also reports an unreachable database."""
        now = self._clock()
        live = ring.read(self._folder / RING, since=2**62)
        running = live is not None and live.is_running(now)
        document = {"name": self.name, "type": self.config.asset.type, "now": now / S_NS}
        document |= {"running": running, "last": live and live.last_ns / S_NS, "trouble": ""}
        document |= {"ended": bool(live and live.ended_ns), "zone": zone(now)}
        document["logged"] = self._curves.logged
        document |= {"last_seen": instant_text(None if live is None else live.last_ns, now)}
        try:
            with self._alarms() as store:
                board = self._board(store, now)
                episodes = store.episodes(self._unit, only_going_on=True)
                waiting = store.requests(self._unit)
                first = min((episode.raised_ns for episode in episodes), default=now)
                comments = store.comments(self._unit, first)
        except TwinError as error:
            grey = {"light": Light.GREY.value, "words": tr(WORDS[Light.GREY]), "alarms": []}
            if live is None:  # before the first run there is none
                return document | grey
            return document | grey | {"words": tr("Alarms unknown"), "trouble": _with_hint(error)}
        light = light_of(board, running=running)
        shown = {"light": light.value, "words": tr(WORDS[light])}
        return document | shown | {"alarms": alarm_cards(board, episodes, waiting, now, comments)}

    def history(self, days: float) -> list[dict[str, Any]]:
        """Episodes of the last days, the newest first."""
        values = self._values()
        priorities = {rule.name: rule.priority.value for rule in self._rules}
        now = self._clock()
        since = now - round(days * DAY_NS)
        with self._alarms() as store:
            episodes, comments = (
                store.episodes(self._unit, since),
                store.comments(self._unit, since),
            )
        return [
            {
                "alarm": episode.alarm,
                "priority": priorities.get(episode.alarm, ""),
                "priority_words": priority_words(priorities.get(episode.alarm, "")),
                **episode_details(episode, values.get(episode.alarm, ""), now, comments),
            }
            for episode in reversed(episodes[-MOST_EPISODES:])
        ]

    def episodes(self, since_ns: int) -> list[tuple[str, Episode]]:
        """Episodes since a time, and earlier ones that are not over."""
        with self._alarms() as store:
            return [(self.name, episode) for episode in store.episodes_around(self._unit, since_ns)]

    def title(self, alarm: str) -> str:
        """The title of an alarm for people."""
        values = self._values()
        return str(describe_alarm(alarm, values.get(alarm, ""))["what"])

    # --- requests -------------------------------------------------------------------------------

    def ask(self, alarm: str, action: str, who: str, seconds: float) -> int:
        """Send a request about an alarm to the run, like ``twin alarms``; returns its number.

        ConfigError for a request that no run would grant.
        """
        if action not in {deed_kind.value for deed_kind in ASKABLE}:
            raise ConfigError(f"{action!r} is nothing that can be asked of an alarm")
        alarm_to_ask = Board(self._rules)[alarm]
        if action == AlarmAction.SHELVED:
            list(alarm_to_ask.shelve(0, seconds, who))  # raises where a run would refuse
        with self._alarms() as store:
            number = store.ask(self._unit, alarm, AlarmAction(action), who, seconds)
        self._asked.add(number)
        return number

    def answer(self, number: int) -> str | None:
        """Why a request was refused, empty if it was done; None while it is unanswered."""
        if number not in self._asked:
            raise ConfigError(f"nothing was asked here with the number {number}")
        with self._alarms() as store:
            return store.answer(number)

    def comment(self, raised_as: str, raised_ns: int, who: str, text: str) -> None:
        """Store a comment on an alarm; this needs no run."""
        with self._alarms() as store:
            store.comment(self._unit, Comment(raised_ns, raised_as, self._clock(), who, text))

    # --- limits ---------------------------------------------------------------------------------

    def limits(self) -> dict[str, Any]:
        """The limits that people may change, with their changes and authors."""
        now = self._clock()
        with self._alarms() as store:
            changes = store.limit_changes(self._unit)
        return limits_document(self._configured, changes, now)

    def change_limit(self, limit: str, value: float | None, who: str, reason: str) -> int:
        """Ask the run to change a limit, without ``value`` back to the configured one.

        Returns the request's number; ConfigError for a change that no run would apply.
        """
        with self._alarms() as store:
            in_force = self._configured.after(store.limit_changes(self._unit))
            in_force.changed_to(limit, value)
            number = store.change_limit(self._unit, limit, value, who, reason)
        self._changes.add(number)
        return number

    def limit_answer(self, number: int) -> str | None:
        """Why a change was refused, empty if it was applied; None while it waits."""
        if number not in self._changes:
            raise ConfigError(f"no limit was changed here with the number {number}")
        with self._alarms() as store:
            (change,) = store.limit_changes(self._unit, after=number - 1)[:1]
        return None if change.is_waiting else change.refusal

    def _limits(self) -> Limits:
        """The limits of key figures in force, with people's changes where they can be read."""
        try:
            with self._alarms() as store:
                return self._configured.after(store.limit_changes(self._unit)).limits
        except TwinError:
            return self._configured.limits

    # --- live -----------------------------------------------------------------------------------

    def rows(self, since: int) -> dict[str, Any] | None:
        """Stored rows since a row's number, vacuum in mbar; None if there are none."""
        live = ring.read(self._folder / RING, since)
        if live is None or live.next == since:
            return None
        rows = live.rows
        pressure = {"low": "high", "high": "low"}  # the lowest vacuum is the highest pressure
        vacuum = {
            f"{side}_{end}": json_numbers((live.ambient - rows[f"{side}_{pressure[end]}"]) / MBAR)
            for side in SIDES
            for end in pressure
        }
        broken = (rows["quality"] & BREAK) != 0
        return {
            "next": live.next,
            "time": (rows["time_ns"] / S_NS).round(3).tolist(),
            "host": (rows["host_ns"] / S_NS).round(3).tolist(),  # the time base of alarms
            "phase": rows["phase"].tolist(),
            "commands": rows["commands"].tolist(),
            "broken": broken.astype(int).tolist(),
            **vacuum,
        }

    # --- any time -------------------------------------------------------------------------------

    def curve(self, from_ns: int, to_ns: int) -> dict[str, Any]:
        """The curve of a range of time, with the alarms that fall into it."""
        now = self._clock()
        document = document_of(self._curves.read(from_ns, to_ns, now))
        try:
            with self._alarms() as store:
                episodes = store.episodes_within(self._unit, from_ns, to_ns)
        except TwinError as error:  # the curve is there without it
            return document | {"alarms": [], "trouble": _with_hint(error)}
        return document | {"alarms": [self._mark(one) for one in episodes[-MOST_EPISODES:]]}

    def _mark(self, episode: Episode) -> dict[str, Any]:
        """Title and times (Unix seconds) of an episode in a curve."""
        entry = episode.evidence.get("taken_in")
        times = {"raised": episode.raised_ns, "cleared": episode.cleared_ns}
        times["seen"] = episode.acknowledged_ns
        return {
            "what": describe_alarm(episode.alarm, self._values().get(episode.alarm, ""), entry)[
                "what"
            ],
            **{name: time_ns and time_ns / S_NS for name, time_ns in times.items()},
        }

    def _values(self) -> dict[str, str]:
        """The value that each alarm's rule looks for, by alarm."""
        return {rule.name: rule.value for rule in self._rules}

    # --- trends ---------------------------------------------------------------------------------

    def figures(self) -> list[dict[str, str]]:
        """The figures that have trends."""
        return [figure_labels(figure) for figure in FIGURES.values()]

    def trend(self, name: str, days: float) -> dict[str, Any]:
        """The trend of a figure over days: cycles, line, band, limit, and when it is reached."""
        if name not in FIGURES:
            raise ConfigError(f"no figure is called {name!r}")
        figure = FIGURES[name]
        columns = [f"{name}_{side}" for side in SIDES]
        since = self._clock() - round(days * DAY_NS)
        with open_figures("", self.config.document, create=False) as store:
            history = store.history(self._unit, since, columns)
            deleted = store.deleted_until(self._unit)
        document: dict[str, Any] = {
            **figure_labels(figure),
            "cycles": len(history.cycle),
        }
        if not len(history.cycle):
            return document | {"words": tr("no cycles in that time")}
        trend = trend_of_figure(history, figure, self._limits())
        stride = max(1, math.ceil(len(history.cycle) / MOST_POINTS))
        words = f"{title_of(name)}: {course_in_words(figure, trend, self._clock())}"
        if deleted is not None and since <= deleted:
            words += f" ({deleted_in_words(deleted, self._clock())})"
        document |= {"words": words, "limit": trend.limit, "every": stride}
        document |= {"time": (history.host_ns[::stride] / S_NS).tolist()}
        document |= {
            side: json_numbers(history.values[f"{name}_{side}"][::stride]) for side in SIDES
        }
        return document | _trend_curve(trend)

    # --- reports --------------------------------------------------------------------------------

    def report(self, name: str, code: str) -> bytes | None:
        """The HTML report of a diagnosis in a language, else in English; None without a report."""
        if not REPORT.fullmatch(name):
            return None
        report = self._folder / REPORTS / f"{name}.html"
        for file in (translation_of(report, code), report):
            with suppress(OSError):
                return file.read_bytes()
        return None

    # --- the database ---------------------------------------------------------------------------

    def _alarms(self) -> AlarmStore:
        """The alarm database, opened anew each time, since it may have been removed."""
        return open_alarms("", self.config.document, create=False)

    def _board(self, store: AlarmStore, now: int) -> Board:
        board = Board(self._rules)
        board.resume(store.states(self._unit))
        board.see(now, {})
        return board


def figure_labels(figure: Figure) -> dict[str, str]:
    """Name, title, unit and meaning of a key figure for people."""
    unit, meaning = figure.unit, tr(figure.what)
    return {"name": figure.name, "title": title_of(figure.name), "unit": unit, "what": meaning}


def _with_hint(error: TwinError) -> str:
    return f"{error}: {error.hint}" if error.hint else str(error)


def _trend_curve(trend: Trend) -> dict[str, Any]:
    """The trend with its band for drawing, extrapolated to the time when it may reach its limit."""
    if trend.step is None and trend.line is None:
        return {}
    days, middle, half = trend.shape(trend.ahead(AHEAD))
    time = trend.end_ns / S_NS + days * 86_400.0
    step = trend.step and {
        "at": trend.step.host_ns / S_NS,
        "from": trend.step.earliest_ns / S_NS,
        "to": trend.step.latest_ns / S_NS,
    }
    return {
        "step": step,
        "line": {
            "time": time.tolist(),
            "middle": json_numbers(middle),
            "low": json_numbers(middle - half),
            "high": json_numbers(middle + half),
            "is_trend": trend.line is not None and trend.line.is_trend,
        },
    }
