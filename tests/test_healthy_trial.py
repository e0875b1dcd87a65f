"""The trial of healthy rigs counts each alarm once, by what raised it."""

from pathlib import Path

from tools.fault_run import ROOT
from tools.healthy_trial import BEGIN, END, Watched, raised, table
from twin.events import Event, Kind


def alarm(figure: str) -> Event:
    return Event(0, Kind.DEVIATION, "it differs", {"figure": figure, "effect": "unknown"})


CLEARED = Event(0, Kind.DEVIATION_CLEARED, "it agrees again", {"effect": "unknown"})


def test_an_alarm_that_is_named_later_counts_once() -> None:
    events = [alarm("idle_mean"), alarm("cycles"), CLEARED, alarm("cycles"), alarm("hold_rms")]
    assert raised(events) == (1, 1)
    assert raised([CLEARED, alarm("cycles"), CLEARED, alarm("cycles")]) == (2, 0)
    assert raised([]) == (0, 0)


def test_the_table_counts_rigs_that_were_commissioned() -> None:
    rigs = [
        Watched(7, "gripper", 250, 0.2, 2, 0),
        Watched(8, "micro", 0, 0.0, 0, 0),
        Watched(9, "micro", 250, 0.3, 1, 1),
    ]
    text = table(rigs, "abc")
    assert "seeds 7 to 9: 2 of 3 rigs were commissioned; 500 healthy cycles in 0.5 hours" in text
    assert "| sums over cycles | 2 of 2 | 3 | 6.0 |" in text
    assert "| single cycles | 1 of 2 | 1 | 2.0 |" in text
    assert "| either | 2 of 2 | 4 | 8.0 |" in text


def test_the_page_has_the_table_of_the_trial() -> None:
    page = (Path(ROOT) / "docs" / "isolation.md").read_text(encoding="utf-8")
    block = page.split(BEGIN)[1].split(END)[0]
    assert "| either |" in block
    assert "healthy cycles in" in block.replace("\n", " ")
