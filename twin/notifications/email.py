"""E-mail as a destination: changes of alarms come in, and mails to people go out.

Both wait in the outbox. The changes go through the escalation, which puts mails into a lane of
their own; from there they go to the mail server.
"""

import json
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from twin.errors import in_words
from twin.notifications.call_store import CallStore
from twin.notifications.escalation import Escalation, Outcome, Reason
from twin.notifications.mail_server import Letter, MailServer
from twin.notifications.message import Message
from twin.notifications.sender import ALARM, Sent, box_of
from twin.notifications.settings import NotificationSettings

EMAIL = "email"  # the destination
MAIL = "mail"  # the lane of what is written to people
LOOK_S = 1.0  # interval at which escalation looks for what is due

Write = Callable[[Mapping[str, Any]], Letter]  # from a mail's document, as the escalation makes it


class Email:
    """A channel (``twin.notifications.sender.Channel``).

    ``open_calls`` opens the calls in this thread; ``clock`` (ns) decides what is due.
    """

    def __init__(
        self,
        settings: NotificationSettings,
        server: MailServer,
        open_calls: Callable[[], CallStore],
        write: Write,
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self._settings, self._server, self._write = settings, server, write
        self._open_calls, self._clock = open_calls, clock
        self._store: CallStore | None = None
        self._escalation: Escalation | None = None

    def open(self) -> bool:
        """Look for what is due; the mail server is connected to for each batch of mails."""
        self._look()
        return False

    def send(self, messages: Sequence[Message], topic: str = ALARM) -> Sent:
        """Take changes of alarms, or hand mails to the mail server."""
        if topic == MAIL:
            return self._send_mails(messages)
        documents = [json.loads(message.body) for message in messages]
        outcome = self._opened().take(documents, self._clock())
        self._keep(outcome, [message.id for message in messages])
        return Sent(delivered=list(messages))

    def idle(self, wake: threading.Event) -> None:
        """Wait a moment, and look for what is due."""
        if not wake.wait(LOOK_S) and self._look():
            wake.set()

    def hang_up(self) -> None:
        """Close the calls; they are read anew."""
        if self._store is not None:
            self._store.close()
        self._store = self._escalation = None

    def close(self) -> None:
        """Close the calls."""
        self.hang_up()

    def _opened(self) -> Escalation:
        """The escalation, with the calls of earlier runs."""
        if self._store is None:
            self._store = self._open_calls()
        if self._escalation is None:
            self._escalation = Escalation(self._settings, self._store.calls())
        return self._escalation

    def _look(self) -> bool:
        """Put what is due into the outbox; returns whether there are mails."""
        outcome = self._opened().due(self._clock())
        if outcome.calls or outcome.mails:
            self._keep(outcome, [])
        return bool(outcome.mails)

    def _keep(self, outcome: Outcome, taken: Sequence[str]) -> None:
        assert self._store is not None
        assert self._escalation is not None
        self._store.store(outcome, box_of(EMAIL, MAIL), EMAIL, taken)
        self._escalation.accept(outcome)

    def _with_news(self, mail: dict[str, Any]) -> dict[str, Any]:
        """A mail about an alarm that stands for some time, with what the diagnosis found since."""
        document = mail["document"]
        if mail["reason"] == Reason.RAISED or not document["episode"] or self._store is None:
            return mail
        evidence = self._store.evidence(document["episode"]) or document["evidence"]
        return {**mail, "document": {**document, "evidence": evidence}}

    def _send_mails(self, messages: Sequence[Message]) -> Sent:
        """Write and send mails. One that cannot be written is set aside."""
        letters: list[tuple[Message, Letter]] = []
        refused: dict[str, str] = {}
        for message in messages:
            try:
                letters.append((message, self._write(self._with_news(json.loads(message.body)))))
            except Exception as error:  # the other mails must still go out, whatever the error
                refused[message.id] = f"the mail cannot be written: {in_words(error)}"
        sent = self._server.send(letters, self._clock()) if letters else Sent()
        sent.refused |= refused
        return sent
