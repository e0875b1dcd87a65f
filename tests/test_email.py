"""E-mail through a real SMTP server over real sockets: protected, stored, sent again, readable."""

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from independent import free_port
from smtp_server import SmtpServer, certificate
from test_alarms_loop import LEAK, NONE, UNIT, Stream, deviation, diagnosis
from test_notifications import NO_TICKS, wait_until

from twin.alarms.database import open_store
from twin.alarms.loop import News
from twin.alarms.settings import board_rules
from twin.cli.notifications import outlets_of
from twin.config import Config
from twin.errors import ConfigError
from twin.languages.catalogues import Catalogues
from twin.languages.texts import ENGLISH
from twin.notifications import email, sender
from twin.notifications.dispatch import Outlets
from twin.notifications.email import EMAIL, MAIL
from twin.notifications.mail_server import Letter, MailServer
from twin.notifications.message import Message, of_event
from twin.notifications.outbox import open_outbox
from twin.notifications.sender import LostError, box_of
from twin.notifications.settings import EmailSettings
from twin.page.alarm_mail import writer
from twin.settings import Document

ANN = "ann@plant.example"
PASSWORD = "s3cret"


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sender, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(sender, "LONGEST_PAUSE_S", 0.05)
    monkeypatch.setattr(email, "LOOK_S", 0.01)


@pytest.fixture
def server() -> Iterator[SmtpServer]:
    running = SmtpServer()
    yield running
    running.close()


@pytest.fixture(scope="module")
def pem(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return certificate(tmp_path_factory.mktemp("tls"))


def configuration(folder: Path, port: int, people: Any = (), **table: Any) -> Config:
    """A cell with e-mail, without encryption unless the table says so."""
    values = {"host": "127.0.0.1", "port": port, "sender": "twin@plant.example"}
    values |= {"encryption": "none", "recipients": [ANN]} | table
    tables = {
        "asset": {"type": "compact-ejector-35", "id": "gripper-01"},
        "alarms": {"keep": True},
        "notifications": {"people": list(people), "email": values},
    }
    path = folder / "cell.toml"
    path.write_text(tomli_w.dumps(tables), encoding="utf-8")
    return Config.of(Document.read(path))


def begun(settings: Config, said: list[str]) -> Outlets:
    begin = outlets_of(settings, said.append)
    assert begin is not None
    return begin([])


def leak() -> Stream:
    stream = Stream()
    stream.at(5, deviation(5))
    return stream


def tell(settings: Config, said: list[str]) -> None:
    """A run with a leak, from begin to end."""
    outlets = begun(settings, said)
    outlets.write(NONE, NO_TICKS, leak().said)
    outlets.close()


def waiting(folder: Path) -> int:
    with open_outbox(folder / "alarms.sqlite", UNIT) as outbox:
        return outbox.count(EMAIL) + outbox.count(box_of(EMAIL, MAIL))


# --- what is read -------------------------------------------------------------------------------


def test_a_mail_says_what_where_since_when_and_what_to_do(
    tmp_path: Path, server: SmtpServer
) -> None:
    said = list[str]()
    tell(configuration(tmp_path, server.port), said)
    (mail,) = server.mails
    assert server.envelopes == [("twin@plant.example", ANN)]
    assert mail["Subject"] == "gripper-01: medium priority, Leakage"
    assert mail["From"] == "ejector-twin <twin@plant.example>"
    assert mail["To"] == ANN
    assert mail["Auto-Submitted"] == "auto-generated"
    text = mail.get_content()
    for part in (
        "Air leaks in through an opening on the vacuum side.",
        "Ejector: gripper-01 (compact-ejector-35)",
        "Where: hoses, fittings and cups",
        "Since: 2001-09-0",
        "State: unacknowledged",
        "How sure: a first guess",
        "If nobody acts: The ejector does not do what it should",
        "What to do: Look at hoses, fittings and cups",
        f"twin alarms acknowledge {LEAK}",
    ):
        assert part in text
    assert said == []


def test_a_german_mail_is_german(tmp_path: Path, server: SmtpServer) -> None:
    tell(configuration(tmp_path, server.port, language="de"), [])
    (mail,) = server.mails
    assert mail["Subject"] == "gripper-01: Priorität mittel, Leckage"
    text = mail.get_content()
    for part in ("Ejektor: gripper-01", "Ort: ", "Seit: ", "Was zu tun ist: ", "Quittieren: "):
        assert part in text
    assert "What to do" not in text
    assert "Wenn niemand handelt: " in text


def written(reason: str, *, time_zone: str = "", count: int = 1, code: str = "en") -> Letter:
    stream = leak()
    (message,) = of_event(UNIT, stream.said[0])
    document = json.loads(message.body)
    mail = {"name": "Ann", "address": ANN, "time_zone": time_zone, "reason": reason}
    write = writer(board_rules(None), Catalogues().languages[code])
    return write({**mail, "count": count, "document": document})


def test_the_subject_says_that_nobody_has_acknowledged() -> None:
    letter = written("escalated")
    assert letter.subject == "Not acknowledged: gripper-01: medium priority, Leakage"
    assert "nobody has acknowledged" in letter.text


def test_the_subject_says_how_often() -> None:
    letter = written("repeated", count=15)
    assert letter.subject.startswith("15 times: gripper-01")
    assert "raised 15 times" in letter.text
    assert written("repeated", count=15, code="de").subject.startswith("15-mal: gripper-01")


def test_instants_are_in_the_zone_of_who_reads() -> None:
    text = written("raised", time_zone="Europe/Berlin").text
    assert "Since: 2001-09-09 03:46:45 (UTC+02:00)" in text
    german = written("raised", time_zone="Europe/Berlin", code="de").text
    assert "Seit: 09.09.2001 03:46:45 (UTC+02:00)" in german


def test_a_diagnosed_cause_says_how_sure() -> None:
    stream = leak()
    stream.at(9, diagnosis(9, 5, "suction_loss"))
    document = json.loads([*of_event(UNIT, stream.said[-1])][-1].body)
    document["evidence"] |= {"probability": 0.93, "not_separable_from": ["end_vacuum_loss"]}
    mail = {"name": "Ann", "address": ANN, "time_zone": "", "reason": "raised", "count": 1}
    letter = writer(board_rules(None), ENGLISH)({**mail, "document": document})
    assert letter.subject == "gripper-01: medium priority, Suction loss"
    assert "How sure: diagnosed: 93 %; this log cannot tell it from" in letter.text


@pytest.mark.parametrize(
    ("code", "line"),
    [
        ("en", "Cost: this suction loss costs about 38 € a year (95 %: 34 to 41), 4000 h of"),
        ("de", "Kosten: Saugleistungsverlust kostet etwa 38 € im Jahr (95 %: 34 bis 41), 4000 "),
    ],
)
def test_a_diagnosed_cause_says_what_it_costs(code: str, line: str) -> None:
    """The cost goes from the diagnosis into the message that all outlets send, and the mail."""
    stream = leak()
    found = diagnosis(9, 5, "suction_loss")
    cost = {
        "money_per_year": {"value": 38.0, "low95": 34.0, "high95": 41.0},
        "currency": "€",
        "operating_hours": 4000.0,
        "differs_from_zero": True,
    }
    found.data["answer"]["causes"][0] |= {"cost": cost, "not_separable_from": []}
    stream.at(9, found)
    document = json.loads([*of_event(UNIT, stream.said[-1])][-1].body)
    assert document["evidence"]["cost"] == cost
    mail = {"name": "Ann", "address": ANN, "time_zone": "", "reason": "raised", "count": 1}
    write = writer(board_rules(None), Catalogues().languages[code])
    assert line in write({**mail, "document": document}).text


def test_an_alarm_whose_rule_is_gone_is_told_in_its_own_words() -> None:
    document = json.loads(next(of_event(UNIT, leak().said[0])).body)
    mail = {"name": "Ann", "address": ANN, "time_zone": "", "reason": "raised", "count": 1}
    letter = writer((), ENGLISH)({**mail, "document": document})
    assert "Deviation leakage" in letter.subject
    assert "What to do: Look at hoses" in letter.text


# --- nothing gets into a header -----------------------------------------------------------------


def test_no_line_break_gets_into_a_header(server: SmtpServer) -> None:
    """A name from a rule or an asset is text of others."""
    wanted = EmailSettings(
        host="127.0.0.1", port=server.port, encryption="none", sender="twin@plant.example"
    )
    subject = "alarm\r\nBcc: all@elsewhere.example\r\n\r\nbody\x00\u2028x"
    letter = Letter("Ann\nX: y", ANN, subject, "text\r\n.\r\nMAIL FROM:<x@y.example>\r\n")
    sent = MailServer(wanted, Path(), pytest.fail).send([(Message("1", LEAK, ""), letter)], 0)
    (mail,) = server.mails
    assert len(sent.delivered) == 1
    assert mail["Bcc"] is None
    assert mail["X"] is None
    assert mail["Subject"] == "alarm Bcc: all@elsewhere.example body x"
    assert mail["Message-ID"] == "<1@plant.example>"
    assert mail.get_content().splitlines() == ["text", ".", "MAIL FROM:<x@y.example>"]


@pytest.mark.parametrize("name", ["gripper\nBcc: x@y.example", "x" * 500, "Gerät 1"])
def test_an_odd_name_of_an_ejector_stays_in_the_subject(name: str, server: SmtpServer) -> None:
    wanted = EmailSettings(
        host="127.0.0.1", port=server.port, encryption="none", sender="twin@plant.example"
    )
    letter = Letter("Ann", ANN, f"{name}: high priority", "text")
    MailServer(wanted, Path(), pytest.fail).send([(Message("1", LEAK, ""), letter)], 0)
    (mail,) = server.mails
    assert set(mail.keys()) >= {"From", "To", "Subject"}
    assert mail["Bcc"] is None
    assert str(mail["Subject"]).startswith(name.partition("\n")[0][:190])


# --- protection ---------------------------------------------------------------------------------


@pytest.fixture
def password(tmp_path: Path) -> dict[str, str]:
    (tmp_path / "mail.password").write_text(f"{PASSWORD}\n")
    (tmp_path / "mail.password").chmod(0o600)
    return {"file": "mail.password"}


@pytest.mark.parametrize("encryption", ["starttls", "tls"])
def test_a_password_goes_inside_tls(
    tmp_path: Path, pem: Path, password: dict[str, str], encryption: str
) -> None:
    secured = SmtpServer(certificate=pem, implicit=encryption == "tls", password=PASSWORD)
    table = {"encryption": encryption, "user": "twin", "password": password}
    said = list[str]()
    tell(configuration(tmp_path, secured.port, **table, tls={"trusted": str(pem)}), said)
    secured.close()
    assert len(secured.mails) == 1
    assert all(inside for command, inside in secured.commands if command.startswith("AUTH"))
    assert all(inside for command, inside in secured.commands if command.startswith("MAIL"))
    assert said == []


@pytest.mark.parametrize("encryption", ["starttls", "tls"])
def test_a_server_that_nobody_vouches_for_gets_nothing(
    tmp_path: Path, pem: Path, encryption: str
) -> None:
    stranger = SmtpServer(certificate=pem, implicit=encryption == "tls")
    said = list[str]()
    tell(configuration(tmp_path, stranger.port, encryption=encryption), said)
    stranger.close()
    assert stranger.mails == []
    assert "certificate verify failed" in said[0]
    assert waiting(tmp_path) == 1


def test_a_certificate_of_another_name_is_refused(tmp_path: Path, pem: Path) -> None:
    stranger = SmtpServer(certificate=pem)
    wanted = {"host": "localhost", "encryption": "starttls", "tls": {"trusted": str(pem)}}
    said = list[str]()
    tell(configuration(tmp_path, stranger.port, **wanted), said)
    stranger.close()
    assert stranger.mails == []
    assert "ostname mismatch" in said[0]


def test_a_server_without_starttls_gets_nothing(
    tmp_path: Path, server: SmtpServer, password: dict[str, str]
) -> None:
    said = list[str]()
    table = {"encryption": "starttls", "user": "twin", "password": password}
    tell(configuration(tmp_path, server.port, **table), said)
    assert server.mails == []
    assert not any(command.startswith(("AUTH", "MAIL")) for command, _ in server.commands)
    assert "it offers no starttls" in said[0]


def test_a_wrong_password_is_reported_without_it(tmp_path: Path, password: dict[str, str]) -> None:
    strict = SmtpServer(password="another")
    said = list[str]()
    tell(configuration(tmp_path, strict.port, user="twin", password=password), said)
    strict.close()
    assert "it does not let us in: status 535 no such user" in said[0]
    assert PASSWORD not in "".join(said)
    assert waiting(tmp_path) == 1


# --- away and back ------------------------------------------------------------------------------


def test_mails_wait_for_a_server_that_is_away(tmp_path: Path) -> None:
    port, said = free_port(), list[str]()
    outlets = begun(configuration(tmp_path, port), said)
    outlets.write(NONE, NO_TICKS, leak().said)
    wait_until(lambda: len(said) == 1)
    back = SmtpServer(port=port)
    wait_until(lambda: len(said) == 2)
    outlets.close()
    back.close()
    assert back.subjects == ["gripper-01: medium priority, Leakage"]
    assert said[0].startswith(f"alarms wait in the outbox: email: mail server 127.0.0.1:{port}")
    assert said[1] == "alarms go to email again"


def test_the_next_run_sends_what_was_left_and_nothing_twice(tmp_path: Path) -> None:
    port, said = free_port(), list[str]()
    settings = configuration(tmp_path, port)
    tell(settings, said)
    assert said[-1].startswith("1 messages to email wait for the next run")
    running = SmtpServer(port=port)
    for _ in range(2):
        begun(settings, said).close()
    running.close()
    assert len(running.mails) == 1
    assert waiting(tmp_path) == 0


def test_one_recipient_who_is_put_off_does_not_hold_up_others(
    tmp_path: Path, server: SmtpServer
) -> None:
    server.answers["RCPT TO:<ann@"] = "450 later"
    said = list[str]()
    outlets = begun(
        configuration(tmp_path, server.port, recipients=[ANN, "bob@plant.example"]), said
    )
    outlets.write(NONE, NO_TICKS, leak().said)
    wait_until(lambda: len(server.mails) == 1 and bool(said))
    assert server.envelopes[0][1] == "bob@plant.example"
    assert "status 450 later" in said[0]
    server.answers.clear()
    wait_until(lambda: len(server.mails) == 2)
    outlets.close()
    assert server.envelopes[1][1] == ANN


def test_a_mail_that_is_refused_for_good_is_set_aside(tmp_path: Path, server: SmtpServer) -> None:
    server.answers["RCPT TO:<ann@"] = "550 unknown\tperson"
    said = list[str]()
    tell(configuration(tmp_path, server.port), said)
    (reported,) = said
    assert reported.startswith("email refuses mails, which are set aside")
    assert reported.endswith("status 550 unknown person")
    with open_outbox(tmp_path / "alarms.sqlite", UNIT) as outbox:
        ((message, reason),) = outbox.refused(box_of(EMAIL, MAIL))
    assert message.alarm == LEAK
    assert "550" in reason


def test_a_mail_that_cannot_be_written_does_not_hold_up_others(
    tmp_path: Path, server: SmtpServer
) -> None:
    with open_outbox(tmp_path / "alarms.sqlite", UNIT) as outbox:
        outbox.put([(box_of(EMAIL, MAIL), Message("old", LEAK, '{"format": "another"}'))])
    said = list[str]()
    tell(configuration(tmp_path, server.port), said)
    assert len(server.mails) == 1
    assert "the mail cannot be written" in said[0]


def test_a_server_that_hangs_up_gets_the_mail_again(tmp_path: Path, server: SmtpServer) -> None:
    server.answers["MAIL"] = "421 closing"
    said = list[str]()
    outlets = begun(configuration(tmp_path, server.port), said)
    outlets.write(NONE, NO_TICKS, leak().said)
    wait_until(lambda: len(said) == 1)
    server.answers.clear()
    wait_until(lambda: len(server.mails) == 1)
    outlets.close()
    assert said[1:] == ["alarms go to email again"]


def test_who_comes_on_duty_while_nothing_happens_is_told(
    tmp_path: Path, server: SmtpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sender's thread looks at the clock by itself."""
    on_duty = threading.Event()
    monkeypatch.setattr("twin.notifications.people.Person.is_on_duty", lambda *_: on_duty.is_set())
    bob = {"name": "Bob", "address": "bob@plant.example", "step": 1}
    outlets = begun(configuration(tmp_path, server.port, [bob], recipients=[]), [])
    outlets.write(NONE, NO_TICKS, leak().said)
    wait_until(lambda: _has_call(tmp_path))
    assert server.mails == []
    on_duty.set()
    wait_until(lambda: len(server.mails) == 1)
    outlets.close()
    assert "your duty began" in server.mails[0].get_content()
    assert str(server.mails[0]["To"]) == "Bob <bob@plant.example>"


def test_who_is_told_later_reads_what_the_diagnosis_found_meanwhile(
    tmp_path: Path, server: SmtpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_duty = threading.Event()
    monkeypatch.setattr("twin.notifications.people.Person.is_on_duty", lambda *_: on_duty.is_set())
    stream = leak()
    outlets = begun(configuration(tmp_path, server.port), [])
    outlets.write(NONE, NO_TICKS, stream.said)
    wait_until(lambda: _has_call(tmp_path))
    (episode,) = stream.desk.before.going_on
    later = {"probability": 0.93, "not_separable_from": []}
    known = replace(episode, evidence={**episode.evidence, **later})
    news = News(episodes={(episode.raised_ns, episode.raised_as): known})
    with open_store(tmp_path / "alarms.sqlite") as store:
        store.save(UNIT, news)
    on_duty.set()
    wait_until(lambda: len(server.mails) == 1)
    outlets.close()
    assert "diagnosed: 93 %" in server.mails[0].get_content()


def _has_call(folder: Path) -> bool:
    from twin.notifications.call_store import open_calls

    with open_calls(folder / "alarms.sqlite", UNIT) as store:
        return bool(store.calls())


@pytest.mark.parametrize("drip", [b"", b"2", b"220-slow\r\n"])
def test_a_server_that_does_not_come_to_an_end_is_lost(drip: bytes) -> None:
    """A reply has its time as a whole, not each byte of it."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        over = threading.Event()

        def drop() -> None:
            client, _ = listener.accept()
            with client, suppress(OSError):
                while not over.wait(0.02):
                    client.sendall(drip)

        thread = threading.Thread(target=drop)
        thread.start()
        wanted = EmailSettings(
            host="127.0.0.1",
            port=listener.getsockname()[1],
            encryption="none",
            sender="twin@plant.example",
            timeout_s=0.2,
        )
        sent = MailServer(wanted, Path(), pytest.fail).send([], 0)
        over.set()
        thread.join()
    assert "timed out" in str(sent.lost)


# --- configuration ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "advice"),
    [
        ({"sender": ""}, "no e-mail address"),
        ({"recipients": []}, "nobody gets the mails"),
        ({"recipients": [ANN, ANN]}, "written once"),
        ({"recipients": ["ann@plant.example\nBcc: x@y.example"]}, "no e-mail address"),
        ({"password": "s3cret", "user": "twin"}, '{ file = "FILE" }'),
        ({"user": "twin"}, "user and password belong together"),
        ({"encryption": "ssl"}, "starttls"),
        ({"host": ""}, r"\[notifications.email\] has no host"),
        ({"language": "xx"}, 'there are no texts in "xx"'),
        (
            {"host": "mail.plant", "user": "twin", "password": {"env": "PW"}},
            "not sent in the clear",
        ),
    ],
)
def test_a_wrong_table_is_refused_with_what_to_write(
    tmp_path: Path, change: dict[str, Any], advice: str
) -> None:
    with pytest.raises(ConfigError, match=advice) as caught:
        outlets_of(configuration(tmp_path, 25, **change), pytest.fail)
    assert "s3cret" not in str(caught.value)
    assert "cell.toml" in str(caught.value)


def test_mails_need_the_alarm_database(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    configuration(tmp_path, 25)
    path.write_text(path.read_text().replace("keep = true", "keep = false"))
    with pytest.raises(ConfigError, match="keep what waits in the alarm database"):
        outlets_of(Config.of(Document.read(path)), pytest.fail)


def test_a_server_that_cannot_be_reached_is_lost_not_refused(tmp_path: Path) -> None:
    wanted = EmailSettings(host="127.0.0.1", port=free_port(), sender="twin@plant.example")
    sent = MailServer(wanted, tmp_path, pytest.fail).send([], 0)
    assert isinstance(sent.lost, LostError)
