"""``twin alarms``: standing alarms, their history, and actions on them, during a run or after."""

import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from twin.cli.app import App, audit_of, chosen_unit, not_negative, read_config, user_here
from twin.cli.options import TABLES, Force, JsonAlone
from twin.cli.options import output as output_option
from twin.errors import ConfigError
from twin.files import refuse_existing, write_json
from twin.instants import DAY_NS, instant

if TYPE_CHECKING:
    from collections.abc import Callable

    from twin.alarms.board import Board, Comment, Episode
    from twin.alarms.database import Store
    from twin.alarms.limit_changes import LimitChanges
    from twin.alarms.loop import Alarms
    from twin.alarms.state import Alarm, AlarmAction
    from twin.assets.unit import Unit
    from twin.config import Config
    from twin.settings import Document

ANSWER_S = 5.0  # for a run to answer: it checks for requests every second
LOOK_S = 0.1

alarms_app = App("Alarms: what stands, what was; acknowledge, shelve, take out of service.")

Names = Annotated[list[str], typer.Argument(metavar="ALARM", help="As twin alarms list says.")]
Url = Annotated[
    str, typer.Option("--alarms", metavar="URL", help="Database: sqlite:///FILE, postgresql://...")
]
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", metavar="CONFIG", help="Its unit, rules and [alarms] url."),
]
ConfigFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--config", metavar="CONFIG", help="Its unit, rules and [alarms] url; one for each ejector."
    ),
]
UnitId = Annotated[str, typer.Option("--id", metavar="ID", help="Unit, where there are several.")]
Who = Annotated[str, typer.Option("--by", metavar="NAME", help="Instead of the user's name.")]


@alarms_app.command("list")
def list_(
    configs: ConfigFiles = None, unit: UnitId = "", alarms: Url = "", json_file: JsonAlone = None
) -> None:
    """Standing alarms, the most urgent first; then shelved, suppressed and out-of-service ones.

    Several configurations are as many ejectors, one after the other.
    """
    if unit and configs and len(configs) > 1:
        raise ConfigError(
            f"--id is for one ejector, and here are {len(configs)} configurations",
            "leave it out, and give each configuration its own under [asset]",
        )
    plain: list[dict[str, Any]] = []
    now_ns = time.time_ns()
    for config in configs or (None,):
        with _open(alarms, config) as store:
            chosen = chosen_unit(store, config, unit)
            shown, episodes = _standing(store, chosen, config)
        if configs and len(configs) > 1:
            print(f"{chosen.id or chosen.type}:")
        entries = [_plain_alarm(alarm, episodes.get(alarm.rule.name), chosen) for alarm in shown]
        for entry in entries:
            print(_alarm_in_words(entry, now_ns))
        if not entries:
            print(f"no alarm of {chosen.id or chosen.type}")
        plain += entries
    if json_file is not None:
        write_json(json_file, plain)


@alarms_app.command()
def history(
    config: ConfigFile = None,
    unit: UnitId = "",
    alarms: Url = "",
    days: Annotated[
        float | None, typer.Option(metavar="N", callback=not_negative, help="Only the last N days.")
    ] = None,
    json_file: JsonAlone = None,
) -> None:
    """Every episode of an alarm: since when, how long, who acknowledged it, its evidence.

    The newest comes last.
    """
    since = None if days is None else time.time_ns() - round(days * 86_400e9)
    with _open(alarms, config) as store:
        chosen = chosen_unit(store, config, unit)
        episodes, comments = store.episodes(chosen, since), store.comments(chosen, since or 0)
    plain = []
    for episode in episodes:
        print(_episode_in_words(episode, time.time_ns()))
        remarks = [remark for remark in comments if remark.is_of(episode)]
        for remark in remarks:
            print(
                f"        {remark.who}, {instant(remark.written_ns, time.time_ns())}: {remark.text}"
            )
        plain.append(
            _plain_episode(episode) | {"comments": [_plain_comment(remark) for remark in remarks]}
        )
    if json_file is not None:
        write_json(json_file, plain)


@alarms_app.command()
def statistics(
    configs: ConfigFiles = None,
    unit: UnitId = "",
    alarms: Url = "",
    days: Annotated[
        float, typer.Option(metavar="N", min=0.01, max=3650.0, help="Over the last N days.")
    ] = 30.0,
    json_file: JsonAlone = None,
) -> None:
    """How many alarms people get, after EEMUA 191: rate, floods, standing, chattering, top ten.

    Several configurations are the ejectors that one person looks after, counted together.
    """
    from twin.alarms.statistics import in_words, plain
    from twin.alarms.statistics import statistics as statistics_of

    now_ns = time.time_ns()
    named: list[tuple[str, Episode]] = []
    since_ns = now_ns - round(days * DAY_NS)
    for config in configs or (None,):
        with _open(alarms, config) as store:
            chosen = chosen_unit(store, config, unit)
            episodes = store.episodes_around(chosen, since_ns)
        named += [(chosen.id or chosen.type, episode) for episode in episodes]
    result = statistics_of(named, since_ns, now_ns)
    for label, value in in_words(result, " ".join, now_ns):
        print(f"{label:<32} {value}")
    if json_file is not None:
        write_json(json_file, plain(result))


@alarms_app.command()
def comment(
    name: Annotated[str, typer.Argument(metavar="ALARM", help="As twin alarms list says.")],
    text: Annotated[str, typer.Argument(metavar="TEXT", help="What others should know.")],
    config: ConfigFile = None,
    unit: UnitId = "",
    alarms: Url = "",
    by: Who = "",
) -> None:
    """Write a comment to an alarm that stands; needs no run. The page and history show it."""
    from twin.alarms.board import Comment
    from twin.audit import Act

    with _open(alarms, config) as store:
        chosen = chosen_unit(store, config, unit)
        standing = [
            candidate
            for candidate in store.episodes(chosen, only_going_on=True)
            if candidate.alarm == name
        ]
        if not standing:
            hint = "twin alarms list says which ones do"
            raise ConfigError(f"{name} does not stand, so there is nothing to comment", hint)
        author, episode = by or user_here(), standing[-1]
        remark = Comment(episode.raised_ns, episode.raised_as, time.time_ns(), author, text)
        store.comment(chosen, remark)
    if config is not None:
        details = {"unit": chosen.id or chosen.type, "alarm": name} | ({"by": by} if by else {})
        audit_of(config.parent).record(Act.COMMENTED, user_here(), **details)
    print(f"{name}: commented")


@alarms_app.command()
def export(
    output: Annotated[Path, output_option(*TABLES)],
    config: ConfigFile = None,
    unit: UnitId = "",
    alarms: Url = "",
    days: Annotated[
        float | None, typer.Option(metavar="N", callback=not_negative, help="Only the last N days.")
    ] = None,
    standing: Annotated[
        bool, typer.Option("--standing", help="What stands now, instead of the history.")
    ] = False,
    force: Force = False,
) -> None:
    """Write the history of a unit's alarms, or what stands, as a table for other programs."""
    from twin.alarms.export import history_table, standing_table
    from twin.tables.sheet import export as export_table

    refuse_existing(output, force=force)
    since = None if days is None else time.time_ns() - round(days * 86_400e9)
    with _open(alarms, config) as store:
        chosen = chosen_unit(store, config, unit)
        if standing:
            shown, going_on = _standing(store, chosen, config)
            table = standing_table(shown, going_on, chosen)
        else:
            rules = {name: alarm.rule for name, alarm in _board(config).alarms.items()}
            table = history_table(store.episodes(chosen, since), rules, chosen)
    export_table(table, output, force=force)
    print(f"{table.num_rows} alarms in {output}")


@alarms_app.command()
def acknowledge(
    names: Names, config: ConfigFile = None, unit: UnitId = "", alarms: Url = "", by: Who = ""
) -> None:
    """Acknowledge an alarm: somebody has seen it and takes care."""
    from twin.alarms.state import AlarmAction

    _ask(names, AlarmAction.ACKNOWLEDGED, by, _Selection(config, unit, alarms))


@alarms_app.command()
def shelve(
    names: Names,
    hours: Annotated[
        float, typer.Option(metavar="H", callback=not_negative, help="For how long.")
    ] = 1.0,
    config: ConfigFile = None,
    unit: UnitId = "",
    alarms: Url = "",
    by: Who = "",
) -> None:
    """Shelve an alarm: do not announce it for a time."""
    from twin.alarms.state import AlarmAction

    _ask(names, AlarmAction.SHELVED, by, _Selection(config, unit, alarms), hours * 3600.0)


@alarms_app.command()
def unshelve(
    names: Names, config: ConfigFile = None, unit: UnitId = "", alarms: Url = "", by: Who = ""
) -> None:
    """End the shelving of an alarm before its time is over."""
    from twin.alarms.state import AlarmAction

    _ask(names, AlarmAction.UNSHELVED, by, _Selection(config, unit, alarms))


@alarms_app.command()
def out_of_service(
    names: Names, config: ConfigFile = None, unit: UnitId = "", alarms: Url = "", by: Who = ""
) -> None:
    """Take an alarm out of service: do not announce it until ``in-service``."""
    from twin.alarms.state import AlarmAction

    _ask(names, AlarmAction.OUT_OF_SERVICE, by, _Selection(config, unit, alarms))


@alarms_app.command()
def in_service(
    names: Names, config: ConfigFile = None, unit: UnitId = "", alarms: Url = "", by: Who = ""
) -> None:
    """Put an alarm back into service."""
    from twin.alarms.state import AlarmAction

    _ask(names, AlarmAction.IN_SERVICE, by, _Selection(config, unit, alarms))


@alarms_app.command()
def outbox(
    config: ConfigFile = None,
    unit: UnitId = "",
    alarms: Url = "",
    again: Annotated[
        bool, typer.Option("--again", help="Send once more what was refused, when a run is there.")
    ] = False,
) -> None:
    """Messages about alarms that are still to be sent, and those that were refused."""
    from twin.alarms.database_url import place_of
    from twin.notifications.outbox import open_outbox

    with _open(alarms, config) as store:
        chosen = chosen_unit(store, config, unit)
    with open_outbox(alarms or place_of(_document(config)), chosen) as box:
        if again:
            print(f"{box.again()} that were refused wait again")
        for name in box.destinations():
            refused = box.refused(name)
            print(f"{name}: {box.count(name)} wait, {len(refused)} were refused")
            for message, reason in refused:
                print(f"        {message.alarm}  {message.id}  {reason}")
        if not box.destinations():
            print("the outbox is empty")


@alarms_app.command()
def rules(config: ConfigFile = None) -> None:
    """Print the rules in use, as a file that [alarms] rules can name."""
    from twin.alarms.rules import write_rules
    from twin.alarms.settings import chosen_rules

    print(write_rules(chosen_rules(_document(config))), end="")


# --- for the loop -------------------------------------------------------------------------------


def alarms_of(
    settings: "Config", say: "Callable[[str], None] | None" = None
) -> "Callable[[], Alarms]":
    """A function that starts the alarms of a configuration's unit.

    ConfigError names a wrong rule or key. Alarms are stored if ``[alarms]`` asks for it and ``say``
    is there for reports of trouble; a replay has no ``say``, and no clock.
    """
    from twin.alarms.loop import Alarms
    from twin.alarms.settings import AlarmSettings, board_rules

    document = settings.document
    by_cause, alarm_settings = board_rules(document), document.section(AlarmSettings, "alarms")
    if say is None:
        return lambda: Alarms(by_cause, None)
    if not alarm_settings.keep:
        return lambda: Alarms(by_cause, time.time_ns, steady=time.monotonic_ns)

    from twin.alarms.database import ALARM_DATABASE
    from twin.alarms.database_url import open_chosen
    from twin.alarms.writer import AlarmWriter  # loads SQLAlchemy only if alarms are stored
    from twin.assets.engine import parse_url
    from twin.assets.unit import Unit

    parse_url(alarm_settings.url, ALARM_DATABASE)
    open_database = partial(open_chosen, "", document, create=True)
    alarm_writer = AlarmWriter(open_database, Unit(settings.asset.type, settings.asset.id), say)
    return lambda: Alarms(
        by_cause, time.time_ns, alarm_writer.begin(), alarm_writer, time.monotonic_ns
    )


def limit_changes_of(settings: "Config", alarms: "Alarms") -> "LimitChanges | None":
    """What applies people's changes of limits to a run; None if its alarms are not stored."""
    from twin.alarms.limit_changes import LimitChanges
    from twin.alarms.limits import UnitLimits

    if alarms.storage is None:
        return None
    return LimitChanges(UnitLimits.of(settings), alarms.storage, time.time_ns)


def asker_of(settings: "Config") -> "Callable[[str, str], None] | None":
    """A function that asks the run to acknowledge an alarm; None if alarms are not stored."""
    from twin.alarms.database_url import open_chosen
    from twin.alarms.settings import AlarmSettings
    from twin.alarms.state import AlarmAction
    from twin.assets.unit import Unit

    if not settings.document.section(AlarmSettings, "alarms").keep:
        return None
    unit = Unit(settings.asset.type, settings.asset.id)

    def acknowledge(alarm: str, user: str) -> None:
        with open_chosen("", settings.document, create=True) as store:
            store.ask(unit, alarm, AlarmAction.ACKNOWLEDGED, user)

    return acknowledge


# --- what the commands share --------------------------------------------------------------------


class _Selection:
    """The choice of a unit and its alarm database."""

    def __init__(self, config: Path | None, unit: str, url: str) -> None:
        self.config, self.unit, self.url = config, unit, url


def _document(config: Path | None) -> "Document | None":
    return read_config(config) if config else None


def _open(url: str, config: Path | None) -> "Store":
    from twin.alarms.database_url import open_chosen

    store = open_chosen(url, _document(config), create=False)
    print(f"alarm database: {store.name}", file=sys.stderr)
    return store


def _board(config: Path | None) -> "Board":
    from twin.alarms.board import Board
    from twin.alarms.settings import board_rules

    return Board(board_rules(_document(config)))


def _standing(
    store: "Store", unit: "Unit", config: Path | None
) -> "tuple[list[Alarm], dict[str, Episode]]":
    """Standing alarms, the most urgent first, then silenced ones; and their episodes."""
    board = _board(config)
    board.resume(store.states(unit))
    board.see(time.time_ns(), {})
    episodes = {episode.alarm: episode for episode in store.episodes(unit, only_going_on=True)}
    return [*board.standing(), *board.quiet()], episodes


def _ask(
    names: list[str], action: "AlarmAction", by: str, selection: _Selection, seconds: float = 0.0
) -> None:
    """Send a request to the run, and wait briefly for its answer; ConfigError if it refuses."""
    board = _board(selection.config)
    for name in names:
        if action.value == "shelved":
            list(board[name].shelve(0, seconds, by))  # refuses what a run would refuse
        board[name]
    with _open(selection.url, selection.config) as store:
        chosen = chosen_unit(store, selection.config, selection.unit)
        requests = dict[int, str]()
        for name in names:
            requests[store.ask(chosen, name, action, by or user_here(), seconds)] = name
            if selection.config is not None:
                details = {"unit": chosen.id or chosen.type, "alarm": name}
                details |= {"by": by} if by else {}
                audit_of(selection.config.parent).record(action, user_here(), **details)
        refused = [
            refusal
            for number, name in requests.items()
            if (refusal := _await_answer(store, number, name, action))
        ]
    if refused:
        raise ConfigError("\n".join(refused))


def _await_answer(store: "Store", number: int, name: str, action: "AlarmAction") -> str:
    """Print that the request is done; return the reason if it is refused."""
    end = time.monotonic() + ANSWER_S
    while (answer := store.answer(number)) is None:
        if time.monotonic() > end:
            print(f"{name}: requested; waits for the next twin run")
            return ""
        time.sleep(LOOK_S)
    if not answer:
        print(f"{name}: {action.value.replace('_', ' ')}")
    return answer


# --- in words -----------------------------------------------------------------------------------


def _plain_alarm(alarm: "Alarm", episode: "Episode | None", unit: "Unit") -> dict[str, Any]:
    from twin.alarms.advice import action_of

    rule = alarm.rule
    return {
        "asset": {"type": unit.type, "id": unit.id},
        "alarm": rule.name,
        "state": alarm.state.value,
        "priority": rule.priority.value,
        "consequence": rule.consequence,
        "action": action_of(rule, episode.evidence if episode else {}),
        "shelved_until_ns": alarm.shelved_until,
        "episode": _plain_episode(episode) if episode else None,
    }


def _plain_episode(episode: "Episode") -> dict[str, Any]:
    return {
        "alarm": episode.alarm,
        "raised_ns": episode.raised_ns,
        "cleared_ns": episode.cleared_ns,
        "seconds": episode.seconds,
        "acknowledged_ns": episode.acknowledged_ns,
        "acknowledged_by": episode.acknowledged_by,
        "evidence": dict(episode.evidence),
    }


def _plain_comment(comment: "Comment") -> dict[str, Any]:
    return {"written_ns": comment.written_ns, "who": comment.who, "text": comment.text}


def _alarm_in_words(plain: dict[str, Any], now_ns: int) -> str:
    """An alarm in a few lines: state, since when, evidence, consequence and action."""
    head = f"{plain['priority']:<7} {plain['alarm']}  {plain['state'].replace('_', ' ')}"
    if plain["shelved_until_ns"] is not None:
        head += f" until {instant(plain['shelved_until_ns'], now_ns)}"
    lines = [head]
    if episode := plain["episode"]:
        lines[0] += f", since {instant(episode['raised_ns'], now_ns)}"
        lines.append(episode["evidence"].get("words", ""))
    lines += [plain["consequence"], plain["action"]]
    return "\n        ".join(line for line in lines if line)


def _episode_in_words(episode: "Episode", now_ns: int) -> str:
    lasted = "still active" if episode.seconds is None else f"{episode.seconds:.1f} s"
    seen = f"seen by {episode.acknowledged_by}" if episode.acknowledged_ns else "not acknowledged"
    words = episode.evidence.get("words", "")
    return (
        f"{instant(episode.raised_ns, now_ns)}  {episode.alarm}  {lasted}  {seen}  {words}".rstrip()
    )
