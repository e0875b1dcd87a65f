"""A twin that is only usable: its verdict is stored with it and is said wherever it is used."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import rigs
from calibrations import typed
from command_line import twin
from test_report import explained
from written_pages import commissioned

from twin.assets.catalogue import take_in
from twin.assets.database_url import open_chosen
from twin.assets.provenance import weak_phases
from twin.calibration.save import store_first
from twin.config import Asset, Config
from twin.diagnosis.answer import Diagnosis, diagnose
from twin.diagnosis.report import in_words, summary, write_report
from twin.settings import Document

WEAK = {"hold": 1.8, "blow_off": 1.8}
LINE = "this twin is usable: off 1.8 times its floor in hold and 1.8 times its floor in blow-off"


def stored(word: str, folder: Path) -> tuple[Path, str]:
    """A configuration and the database in which its unit has a twin with a verdict."""
    path, url = folder / "cell.toml", f"sqlite:///{folder}/assets.sqlite"
    text = rigs.path_of("test_rig").read_text(encoding="utf-8")
    path.write_text(text, encoding="utf-8")
    config = replace(typed("test_rig"), document=Document.read(path))
    unit = Asset(type=config.asset.type, id=rigs.config("test_rig").asset.id)
    log = folder / "healthy.mcap"
    log.write_bytes(b"a log")
    store_first(commissioned(word), replace(config, asset=unit), url, log)
    return path, url


def with_twin(weak: dict[str, float]) -> Diagnosis:
    found = explained()
    return replace(found, json={**found.json, "twin": {"verdict": "usable", "weak": weak}})


def test_the_weak_phases_of_a_usable_twin_are_known_to_who_uses_it(tmp_path: Path) -> None:
    path, url = stored("usable", tmp_path)
    config = Config.of(Document.read(path), url)
    assert config.weak == WEAK
    header = config.log_header()
    assert Config.of_log(Document.read(path), header.metadata, "a.mcap").weak == WEAK
    damaged = {**header.metadata, "weak": "[1"}
    assert Config.of_log(Document.read(path), damaged, "a.mcap").weak == {}


def test_nothing_is_said_of_a_good_one(tmp_path: Path) -> None:
    path, url = stored("good", tmp_path)
    config = Config.of(Document.read(path), url)
    assert config.weak == {}
    assert "weak" not in config.log_header().metadata
    assert "usable" not in in_words(explained())


def test_the_verdict_stays_with_what_is_made_of_the_twin(tmp_path: Path) -> None:
    path, url = stored("usable", tmp_path)
    config = Config.of(Document.read(path), url)
    with open_chosen(url, config.document, write=True) as database:
        record = database.get(config.asset.type, config.asset.id).record
        assert (record.provenance["verdict"], record.provenance["weak"]) == ("usable", WEAK)
        assert take_in(database, record, "a", {}, "a.toml").provenance["weak"] == WEAK


@pytest.mark.parametrize("value", [None, 3, [], {"hold": "x"}, {"hold": float("inf")}, {"x": 2.0}])
def test_what_is_no_phase_or_no_number_is_left_out(value: object) -> None:
    assert weak_phases(value) == {}


def test_a_diagnosis_says_it_in_text_and_report(tmp_path: Path) -> None:
    found = with_twin(WEAK)
    assert LINE in in_words(found)
    write_report(found, tmp_path / "a.html")
    sentence = f"{LINE[:1].upper()}{LINE[1:]}."
    assert sentence in (tmp_path / "a.html").read_text(encoding="utf-8")
    assert sentence in summary(found)


def test_the_answer_has_it_for_programs() -> None:
    config = replace(rigs.config("gripper"), weak=WEAK)
    answer = diagnose(config, [], "a.mcap", lambda _what: None).json
    assert json.loads(json.dumps(answer))["twin"] == {"verdict": "usable", "weak": WEAK}


@pytest.mark.parametrize("word", ["good", "usable"])
def test_assets_show_says_it(
    word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _, url = stored(word, tmp_path)
    assert twin(monkeypatch, "assets", "show", "rig-01", "--assets", url) == 0
    shown = capsys.readouterr().out
    assert (f"# {LINE}" in shown) == (word == "usable")
    assert "# verdict" not in shown
    assert "# weak" not in shown
