"""An alarm's mail, in the words of the page."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any

from twin.alarms.advice import action_of
from twin.alarms.rules import Rule
from twin.instants import DATE, TIME
from twin.languages.choice import language_of
from twin.languages.texts import ENGLISH, Language, ntr, speaking, tr
from twin.notifications.escalation import Reason
from twin.notifications.mail_server import Letter
from twin.notifications.message import ns_of
from twin.notifications.people import local_time
from twin.notifications.settings import chosen_notifications
from twin.page.ejector_status import describe_alarm, facts, priority_words, state_words
from twin.settings import Document

Body = Mapping[str, Any]


def writer(rules: Sequence[Rule], language: Language) -> Callable[[Body], Letter]:
    """A function that writes mails of ``twin.notifications.escalation`` in one language.

    ``rules`` are those in use. An alarm whose rule is gone is told in the words of its message.
    """
    by_name = {rule.name: rule for rule in rules}

    def write(mail: Body) -> Letter:
        rule = by_name.get(mail["document"]["alarm"])
        with speaking(language):
            subject, text = _subject(mail, rule), "\n".join(_lines(mail, rule)) + "\n"
        return Letter(mail["name"], mail["address"], subject, text)

    return write


def mail_language(document: Document) -> Language:
    """The language of e-mails in a configuration; ConfigError if there are no texts in it."""
    settings = chosen_notifications(document)
    code = settings.email.language if settings else ENGLISH.code
    return language_of(code, f"{document.name}: [notifications.email] language")


def _subject(mail: Body, rule: Rule | None) -> str:
    """Ejector, priority and cause; escalation and repetition come first."""
    document = mail["document"]
    subject = tr(
        "{asset}: {priority}, {what}",
        asset=_asset(document),
        priority=priority_words(document["priority"]),
        what=_description(document, rule)["what"],
    )
    match mail["reason"]:
        case Reason.ESCALATED:
            return tr("Not acknowledged: {subject}", subject=subject)
        case Reason.REPEATED:
            return ntr(
                "{count} time: {subject}",
                "{count} times: {subject}",
                mail["count"],
                subject=subject,
            )
    return subject


def _lines(mail: Body, rule: Rule | None) -> Iterator[str]:
    document = mail["document"]
    description = _description(document, rule)
    yield f"{description['what']} ({priority_words(document['priority'])})"
    if description["sentence"]:
        yield description["sentence"]
    yield ""
    yield from _where_and_when(mail, description["where"])
    yield from (_labelled(name, text) for name, text in facts(document["evidence"]))
    yield ""
    consequence = tr(rule.consequence) if rule else document["consequence"]
    if consequence:
        yield _labelled(tr("if nobody acts"), consequence)
    action = action_of(rule, document["evidence"]) if rule else document["action"]
    yield _labelled(tr("what to do"), action)
    yield ""
    yield _why(mail)
    yield tr(
        "To acknowledge: on the page, or twin alarms acknowledge {alarm}", alarm=document["alarm"]
    )


def _where_and_when(mail: Body, location: str) -> Iterator[str]:
    document = mail["document"]
    yield _labelled(tr("ejector"), _asset(document, whole=True))
    if location:
        yield _labelled(tr("where"), location)
    if document["since"]:
        since = local_time(ns_of(document["since"]), mail["time_zone"])
        yield _labelled(tr("since"), _clock(since))
    yield _labelled(tr("state"), state_words(document["state"]))


def _labelled(name: str, text: str) -> str:
    return f"{name[:1].upper()}{name[1:]}: {text}"


def _clock(instant: datetime) -> str:
    """Date, time and zone, since a mail may be read much later and in another zone."""
    offset = instant.strftime("%z")
    local = instant.strftime(f"{tr(DATE)} {TIME}")
    return f"{local} (UTC{offset[:3]}:{offset[3:5]})"


def _why(mail: Body) -> str:
    """The reason why the person gets the mail."""
    match mail["reason"]:
        case Reason.ESCALATED:
            return tr("You get this mail because nobody has acknowledged the alarm yet.")
        case Reason.ON_DUTY:
            return tr("You get this mail because the alarm stood when your duty began.")
        case Reason.REPEATED:
            return ntr(
                "The alarm was raised {count} time in all. You get one mail for several times.",
                "The alarm was raised {count} times in all. You get one mail for several times.",
                mail["count"],
            )
    return tr("You get this mail because the alarm was raised.")


def _description(document: Body, rule: Rule | None) -> Mapping[str, str]:
    value = rule.value if rule else ""
    return describe_alarm(document["alarm"], value, document["evidence"].get("taken_in"))


def _asset(document: Body, *, whole: bool = False) -> str:
    """The ejector's ID, ``whole`` with its type."""
    asset = document["asset"]
    if not asset["id"]:
        return str(asset["type"])
    return f"{asset['id']} ({asset['type']})" if whole else str(asset["id"])
