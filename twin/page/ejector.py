"""One ejector as the page sees it: what its run and its databases have left, read anew each time.

Everything here may wait for a disk or a database; the page calls it in a thread.
"""

import math
import re
import time
from collections.abc import Callable
from typing import Any

from twin.alarms.board import Board, Comment, Episode
from twin.alarms.database import Store as AlarmStore
from twin.alarms.database_url import open_chosen as open_alarms
from twin.alarms.requests import ASKABLE
from twin.alarms.settings import AlarmSettings, board_rules
from twin.alarms.state import Deed
from twin.assets.unit import Unit
from twin.config import Config
from twin.errors import ConfigError, TwinError
from twin.figures.database import SIDES
from twin.figures.database_url import open_chosen as open_figures
from twin.figures.settings import limits_of
from twin.figures.table import FIGURES, Figure
from twin.figures.text import course_in_words, title_of, trend_of_figure
from twin.figures.trend import DAY_NS, Trend
from twin.instants import zone
from twin.language import tr
from twin.page import ring
from twin.page.ejector_status import (
    S_NS,
    WORDS,
    Light,
    light_of,
    listed,
    named,
    priority_words,
    said,
    told,
)
from twin.page.settings import REPORTS, RING, PageSettings, folder_of
from twin.signals import BREAK, MBAR

SHOWN_S = 10.0  # of live rows, at first
MOST_EPISODES = 500
MOST_POINTS = 600  # of a trend's cycles
AHEAD = 0.25  # of the record, drawn after its end where nothing is reached
REPORT = re.compile(r"[0-9a-f]{32}")


class Ejector:
    """What is known of one ejector, for its page; ConfigError where a run keeps nothing for it."""

    def __init__(self, config: Config, clock: Callable[[], int] = time.time_ns) -> None:
        document = config.document
        kept = {
            "alarms": document.section(AlarmSettings, "alarms").keep,
            "page": document.section(PageSettings, "page").keep,
        }
        for name, is_kept in kept.items():
            if not is_kept:
                raise ConfigError(
                    f"{document.name}: twin run keeps nothing for its page under [{name}]",
                    f"put keep = true under [{name}] and start twin run again",
                )
        self.config, self._clock = config, clock
        self.name = config.asset.id or config.asset.type
        self._rules = board_rules(document)
        self._limits = limits_of(config)
        self._folder = folder_of(document, config.asset)
        self._unit = Unit(config.asset.type, config.asset.id)
        self._asked: set[int] = set()  # through this page

    # --- what stands ----------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Traffic light, alarms and how the run is; a database that is away is said in it."""
        now = self._clock()
        live = ring.read(self._folder / RING, since=2**62)
        running = live is not None and live.is_running(now)
        own = {"name": self.name, "type": self.config.asset.type, "now": now / S_NS}
        own |= {"running": running, "last": live and live.last_ns / S_NS, "trouble": ""}
        own |= {"ended": bool(live and live.ended_ns), "zone": zone(now)}
        own |= {"last_seen": said(None if live is None else live.last_ns, now)}
        try:
            with self._alarms() as store:
                board = self._board(store, now)
                episodes = store.episodes(self._unit, only_going_on=True)
                waiting = store.requests(self._unit)
                first = min((one.raised_ns for one in episodes), default=now)
                comments = store.comments(self._unit, first)
        except TwinError as error:
            grey = {"light": Light.GREY.value, "words": tr(WORDS[Light.GREY]), "alarms": []}
            if live is None:  # before the first run there is none
                return own | grey
            return own | grey | {"words": tr("Alarms unknown"), "trouble": _with_hint(error)}
        light = light_of(board, running=running)
        found = {"light": light.value, "words": tr(WORDS[light])}
        return own | found | {"alarms": listed(board, episodes, waiting, now, comments)}

    def history(self, days: float) -> list[dict[str, Any]]:
        """Every time an alarm was active, the newest first."""
        values = {rule.name: rule.value for rule in self._rules}
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
                "alarm": one.alarm,
                "priority": priorities.get(one.alarm, ""),
                "priority_words": priority_words(priorities.get(one.alarm, "")),
                **told(one, values.get(one.alarm, ""), now, comments),
            }
            for one in reversed(episodes[-MOST_EPISODES:])
        ]

    def episodes(self, since_ns: int) -> list[tuple[str, Episode]]:
        """Every time an alarm was active since then, and what stood before and goes on."""
        with self._alarms() as store:
            return [(self.name, one) for one in store.episodes_around(self._unit, since_ns)]

    def title(self, alarm: str) -> str:
        """An alarm as people say it."""
        values = {rule.name: rule.value for rule in self._rules}
        return str(named(alarm, values.get(alarm, ""))["what"])

    # --- what people ask ------------------------------------------------------------------------

    def ask(self, alarm: str, deed: str, who: str, seconds: float) -> int:
        """Ask the run something of an alarm, as ``twin alarms`` does; gives the request's number.

        ConfigError for what no run would grant.
        """
        if deed not in {one.value for one in ASKABLE}:
            raise ConfigError(f"{deed!r} is nothing that can be asked of an alarm")
        wanted = Board(self._rules)[alarm]
        if deed == Deed.SHELVED:
            list(wanted.shelve(0, seconds, who))  # refuses what a run would refuse
        with self._alarms() as store:
            number = store.ask(self._unit, alarm, Deed(deed), who, seconds)
        self._asked.add(number)
        return number

    def answer(self, number: int) -> str | None:
        """Why a request was refused, empty if it was done; None while no run has answered."""
        if number not in self._asked:
            raise ConfigError(f"nothing was asked here with the number {number}")
        with self._alarms() as store:
            return store.answer(number)

    def comment(self, raised_as: str, raised_ns: int, who: str, text: str) -> None:
        """Keep what somebody writes to an alarm; no run is needed for it."""
        with self._alarms() as store:
            store.comment(self._unit, Comment(raised_ns, raised_as, self._clock(), who, text))

    # --- live -----------------------------------------------------------------------------------

    def rows(self, since: int) -> dict[str, Any] | None:
        """What is new since a row's number, vacuum in mbar; None where nothing is.

        Who is far behind gets the last SHOWN_S and no more.
        """
        live = ring.read(self._folder / RING, since)
        if live is None or live.next == since:
            return None
        rows = live.rows[-round(SHOWN_S * S_NS / ring.ROW_NS) :]
        pressure = {"low": "high", "high": "low"}  # the lowest vacuum is the highest pressure
        vacuum = {
            f"{side}_{end}": _plain((live.ambient - rows[f"{side}_{pressure[end]}"]) / MBAR)
            for side in SIDES
            for end in pressure
        }
        broken = (rows["quality"] & BREAK) != 0
        return {
            "next": live.next,
            "time": (rows["time_ns"] / S_NS).round(3).tolist(),
            "host": (rows["host_ns"] / S_NS).round(3).tolist(),  # as the alarms have it
            "phase": rows["phase"].tolist(),
            "commands": rows["commands"].tolist(),
            "broken": broken.astype(int).tolist(),
            **vacuum,
        }

    # --- trends ---------------------------------------------------------------------------------

    def figures(self) -> list[dict[str, str]]:
        """What there are trends of."""
        return [figure_words(one) for one in FIGURES.values()]

    def trend(self, name: str, days: float) -> dict[str, Any]:
        """How a figure runs over days: cycles, line, band, limit, and when it comes to it."""
        if name not in FIGURES:
            raise ConfigError(f"no figure is called {name!r}")
        figure = FIGURES[name]
        columns = [f"{name}_{side}" for side in SIDES]
        since = self._clock() - round(days * DAY_NS)
        with open_figures("", self.config.document, write=False) as store:
            history = store.history(self._unit, since, columns)
        found: dict[str, Any] = {
            **figure_words(figure),
            "cycles": len(history.cycle),
        }
        if not len(history.cycle):
            return found | {"words": tr("no cycles in that time")}
        trend = trend_of_figure(history, figure, self._limits)
        every = max(1, math.ceil(len(history.cycle) / MOST_POINTS))
        words = f"{title_of(name)}: {course_in_words(figure, trend, self._clock())}"
        found |= {"words": words, "limit": trend.limit, "every": every}
        found |= {"time": (history.host_ns[::every] / S_NS).tolist()}
        found |= {side: _plain(history.values[f"{name}_{side}"][::every]) for side in SIDES}
        return found | _drawn(trend)

    # --- reports --------------------------------------------------------------------------------

    def report(self, name: str) -> bytes | None:
        """The page of a diagnosis; None where there is none of that name."""
        if not REPORT.fullmatch(name):
            return None
        try:
            return (self._folder / REPORTS / f"{name}.html").read_bytes()
        except OSError:
            return None

    # --- the database ---------------------------------------------------------------------------

    def _alarms(self) -> AlarmStore:
        """The alarm database, opened anew each time: one that was taken away is none any more."""
        return open_alarms("", self.config.document, write=False)

    def _board(self, store: AlarmStore, now: int) -> Board:
        board = Board(self._rules)
        board.resume(store.states(self._unit))
        board.see(now, {})
        return board


def figure_words(figure: Figure) -> dict[str, str]:
    """A key figure as people read it."""
    unit, what = figure.unit, tr(figure.what)
    return {"name": figure.name, "title": title_of(figure.name), "unit": unit, "what": what}


def _with_hint(error: TwinError) -> str:
    return f"{error}: {error.hint}" if error.hint else str(error)


def _plain(values: Any) -> list[float | None]:
    """Numbers as JSON has them, to five digits; null where there is none."""
    return [float(f"{one:.5g}") if math.isfinite(one) else None for one in values.tolist()]


def _drawn(trend: Trend) -> dict[str, Any]:
    """The course with its band as one draws it, as far ahead as it may come to its limit."""
    if trend.step is None and trend.line is None:
        return {}
    days, middle, half = trend.shape(trend.ahead(AHEAD))
    at = trend.end_ns / S_NS + days * 86_400.0
    step = trend.step and {
        "at": trend.step.host_ns / S_NS,
        "from": trend.step.earliest_ns / S_NS,
        "to": trend.step.latest_ns / S_NS,
    }
    return {
        "step": step,
        "line": {
            "time": at.tolist(),
            "middle": _plain(middle),
            "low": _plain(middle - half),
            "high": _plain(middle + half),
            "is_trend": trend.line is not None and trend.line.is_trend,
        },
    }
