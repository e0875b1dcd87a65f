"""``twin alarms`` beside a run, and without one."""

import json
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import rigs
from command_line import twin
from test_alarms_loop import APART, LEAK, NONE, UNIT, S, deviation, rows

from twin.alarms import writer as module
from twin.alarms.database import open_store
from twin.alarms.loop import Alarms
from twin.alarms.rules import Rule, default_rules, read_rules, write_rules
from twin.alarms.settings import board_rules
from twin.alarms.writer import AlarmWriter
from twin.assets.unit import Unit
from twin.audit import records
from twin.cli import alarms as cli_alarms
from twin.cli.alarms import alarms_app
from twin.errors import ConfigError, SourceError
from twin.settings import Document

Run = Callable[..., str]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command in an empty folder; gives what it printed."""
    monkeypatch.chdir(tmp_path)

    def command(*arguments: str | Path) -> str:
        alarms_app([str(argument) for argument in arguments], standalone_mode=False)
        return capsys.readouterr().out

    return command


def begun(path: Path) -> Alarms:
    """Alarms of the gripper, one of them raised, kept in a database."""
    alarm_writer = AlarmWriter(lambda: open_store(path), UNIT, pytest.fail)
    alarms = Alarms(board_rules(None), lambda: APART + 6 * S, alarm_writer.begin(), alarm_writer)
    alarms.follow(rows(5), [deviation(5)])
    return alarms


@pytest.fixture
def beside(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    """The commands beside a run whose loop goes on in a thread."""
    monkeypatch.setattr(module, "POLL_S", 0.01)
    monkeypatch.setattr(cli_alarms, "LOOK_S", 0.01)
    alarms, ended = begun(tmp_path / "alarms.sqlite"), threading.Event()

    def loop() -> None:
        while not ended.wait(0.01):
            alarms.follow(NONE, [])
        alarms.close()

    thread = threading.Thread(target=loop)
    thread.start()
    yield run
    ended.set()
    thread.join()


def test_a_comment_and_statistics_need_no_run(run: Run, tmp_path: Path) -> None:
    begun(tmp_path / "alarms.sqlite").close()
    assert run("comment", LEAK, "new hose ordered", "--by", "ann") == f"{LEAK}: commented\n"
    assert re.search(r"\n {8}ann, .* ago: new hose ordered\n", run("history", "--json", "h.json"))
    (episode,) = json.loads(Path("h.json").read_text())
    assert [(comment["who"], comment["text"]) for comment in episode["comments"]] == [
        ("ann", "new hose ordered")
    ]
    with pytest.raises(ConfigError, match="plc_stale does not stand"):
        run("comment", "plc_stale", "why")
    shown = run("statistics", "--days", "1", "--json", "s.json")
    assert re.search(rf"standing for over 24 h +gripper-01 {LEAK} \(2001-09-09", shown)
    plain = json.loads(Path("s.json").read_text())
    assert (plain["alarms"], plain["standing"][0]["alarm"]) == (0, LEAK)


def test_an_alarm_is_acknowledged_beside_a_run(beside: Run) -> None:
    assert beside("acknowledge", LEAK, "--by", "ann") == f"{LEAK}: acknowledged\n"
    shown = beside("list", "--json", "l.json")
    assert re.match(
        rf"medium  {LEAK}  acknowledged, since 2001-09-09 01:46:45, \d+ days ago\n", shown
    )
    assert "Look at hoses" in shown
    (plain,) = json.loads(Path("l.json").read_text())
    assert (plain["state"], plain["episode"]["acknowledged_by"]) == ("acknowledged", "ann")
    line = beside("history", "--json", "h.json")
    assert re.fullmatch(
        rf"2001-09-09 01:46:45, \d+ days ago  {LEAK}  still active  seen by ann  deviation\n", line
    )
    (plain,) = json.loads(Path("h.json").read_text())
    assert plain["evidence"]["guess"] == "leakage"


def test_alarms_are_taken_out_of_service_and_back(beside: Run) -> None:
    assert beside("out-of-service", LEAK, "plc_stale").splitlines() == [
        f"{LEAK}: out of service",
        "plc_stale: out of service",
    ]
    (line,) = (line for line in beside("list").splitlines() if LEAK in line)
    assert f"{LEAK}  out of service, since 2001-09-09 01:46:45, " in line
    assert beside("in-service", LEAK) == f"{LEAK}: in service\n"
    assert "unacknowledged" in beside("list")


def test_the_trail_beside_the_configuration_says_who_asked(
    beside: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LOGNAME", "technician")
    (tmp_path / "cell.toml").write_text("[alarms]\nkeep = true\n")
    beside("shelve", LEAK, "--hours", "1", "--config", "cell.toml", "--by", "ann")
    beside("unshelve", LEAK, "--config", "cell.toml")
    shelved, unshelved = records(tmp_path)[0]
    assert (shelved["what"], shelved["alarm"], shelved["unit"]) == ("shelved", LEAK, UNIT.id)
    assert (shelved["who"], shelved["by"], shelved["through"]) == ("technician", "ann", "command")
    assert (unshelved["what"], unshelved["who"]) == ("unshelved", "technician")


def test_a_refusal_is_an_error(beside: Run, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(
        write_rules([Rule(name="our_own", value="plc_stale", above=0.5)])
    )
    (tmp_path / "cell.toml").write_text('[alarms]\nrules = "mine.toml"\n')
    with pytest.raises(ConfigError, match="no alarm is called our_own"):  # says the run
        beside("acknowledge", "our_own", "--config", "cell.toml")
    with pytest.raises(ConfigError, match="cannot be shelved for 36000 s"):
        beside("shelve", LEAK, "--hours", "10")
    with pytest.raises(ConfigError, match="no alarm is called leak"):
        beside("acknowledge", "leak")


def test_without_a_run_the_next_one_does_it(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli_alarms, "ANSWER_S", 0.0)
    monkeypatch.setattr(module, "POLL_S", 0.01)
    begun(tmp_path / "alarms.sqlite").close()
    assert "unacknowledged" in run("list")
    said = run("acknowledge", LEAK)
    assert said == f"{LEAK}: requested; waits for the next twin run\n"
    run("unshelve", "plc_stale")
    alarm_writer = AlarmWriter(lambda: open_store("alarms.sqlite"), UNIT, pytest.fail)
    alarms = Alarms(board_rules(None), lambda: APART + 9 * S, alarm_writer.begin(), alarm_writer)
    said_there = [event.data["deed"] for _ in range(500) for event in _later(alarms)]
    alarms.close()
    assert said_there == ["acknowledged"]
    assert f"{LEAK}  acknowledged" in run("list")


def _later(alarms: Alarms) -> list[object]:
    threading.Event().wait(0.002)
    return list(alarms.follow(NONE, []))


def test_the_unit_is_found_or_named(run: Run, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"alarms\.sqlite: no such alarm database"):
        run("list")
    assert not (tmp_path / "alarms.sqlite").exists()
    with open_store("alarms.sqlite") as store:
        for name in ("gripper-01", "rig-01"):
            store.before(Unit(UNIT.type, name))
    with pytest.raises(ConfigError, match="2 units") as caught:
        run("list")
    assert caught.value.hint == "choose with --id; known: gripper-01, rig-01"
    assert run("list", "--id", "rig-01") == "no alarm of rig-01\n"
    where = ("--alarms", tmp_path / "alarms.sqlite", "--config", rigs.path_of("gripper"))
    assert run("list", *where) == "no alarm of gripper-01\n"
    assert run("history", *where, "--days", "3") == ""


def test_several_configurations_are_as_many_ejectors(run: Run, tmp_path: Path) -> None:
    begun(tmp_path / "alarms.sqlite").close()
    with open_store("alarms.sqlite") as store:
        store.before(Unit(UNIT.type, "rig-01"))
    for name in (UNIT.id, "rig-01"):
        Path(f"{name}.toml").write_text(f'[asset]\nid = "{name}"\n')
    both = ("--config", f"{UNIT.id}.toml", "--config", "rig-01.toml")
    said = run("list", *both, "--json", "l.json").splitlines()
    assert said[0] == f"{UNIT.id}:"
    assert said[1].startswith(f"medium  {LEAK}  ")
    assert said[-2:] == ["rig-01:", "no alarm of rig-01"]
    (plain,) = json.loads(Path("l.json").read_text())
    assert plain["asset"] == {"type": UNIT.type, "id": UNIT.id}
    with pytest.raises(ConfigError, match="--id is for one ejector"):
        run("list", *both, "--id", "rig-01")


def test_the_rules_in_use_are_printed_as_they_can_be_named(run: Run, tmp_path: Path) -> None:
    text = run("rules")
    assert read_rules(Document.parse(text, "rules")) == default_rules()
    (tmp_path / "mine.toml").write_text(text.replace('"medium"', '"high"'))
    (tmp_path / "cell.toml").write_text('[alarms]\nrules = "mine.toml"\n')
    assert run("rules", "--config", "cell.toml") == text.replace('"medium"', '"high"')


def test_the_whole_command_line_knows_them(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert twin(monkeypatch, "alarms", "rules", "--config", rigs.path_of("gripper")) == 0
    assert 'name = "plc_stale"' in capsys.readouterr().out
