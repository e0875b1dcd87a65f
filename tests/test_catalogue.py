"""Effects that were found and taken in: a file that a person reads, a catalogue, a name."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rigs
import tomli_w
from command_line import twin
from pydantic import ValidationError

from twin.assets.catalogue import carried_on, take_in, target_of
from twin.assets.database import open_assets
from twin.assets.record import Record
from twin.config import Config
from twin.diagnosis.propose import Proposal
from twin.errors import ConfigError
from twin.exchange.aas import read_package, write_package
from twin.model import theta as c
from twin.model.catalogue import CatalogueEffect, effects_in, has_room, mechanism_of
from twin.model.courses import HOUR, Cause, Course
from twin.model.dataset import DataSet, coefficients
from twin.model.effects import apply, effect_of, find_effect
from twin.model.mechanism import MECHANISMS, SLOTS, free_slots
from twin.settings import Document

RANGES = {
    "sonic_flow": {"low": 0.0, "high": 60.0, "found": 1.7},
    "begins": {"low": 180.0, "high": 900.0, "found": 554.0},
    "ends_below": {"low": 10.0, "high": 400.0, "found": 147.0},
}
LIP = {
    "mechanism": "opening_above",
    "sentence": "A lip lifts off and lets air in",
    "look_at": "the lips of the cups",
    "parameters": RANGES,
}
KIND = "compact-ejector-35"


def known(**changes: object) -> CatalogueEffect:
    return CatalogueEffect.model_validate(LIP | changes)


def proposal(folder: Path, **changes: object) -> Path:
    file = folder / "lifting_lip.toml"
    tables = {
        "format": "ejector-twin-effect/1",
        "name": "lifting_lip",
        "type": KIND,
        "unit": "gripper-01",
        "effect": LIP,
        "test": {"log": str(folder / "lip.mcap"), "log_sha256": "00"},
    }
    file.write_text(tomli_w.dumps(tables | changes), encoding="utf-8")
    return file


# --- what it is -----------------------------------------------------------------------------------


def test_its_values_are_as_sure_as_those_of_its_mechanism() -> None:
    mechanism = MECHANISMS["supply_pulsed"]
    ranges = {
        p.name: {"low": p.low, "high": p.high, "found": p.low} for p in mechanism.effect.parameters
    }
    ranges["drop"] |= {"low": 0.0, "found": 0.7}
    effect = known(mechanism=mechanism.name, parameters=ranges).effect("second_ejector")
    for taken, own in zip(effect.parameters, mechanism.effect.parameters, strict=True):
        assert taken.relative_error == own.relative_error
        assert taken.is_of_the_log == own.is_of_the_log


def test_without_a_size_it_changes_nothing_and_with_one_it_is_its_mechanism() -> None:
    (effect,) = effects_in({"lifting_lip": known()})
    theta = coefficients(rigs.config("gripper").data)
    assert np.array_equal(apply(theta, "lifting_lip", {})[: c.MECHANISMS], theta[: c.MECHANISMS])
    assert free_slots(apply(theta, "lifting_lip", {})) == SLOTS
    here = apply(theta, "lifting_lip", {"sonic_flow": 2.0})
    values = {"sonic_flow": 2.0, "begins": 554.0, "ends_below": 147.0}
    assert np.array_equal(here, apply(theta, "opening_above", values))
    assert (effect.name, mechanism_of("lifting_lip")) == ("lifting_lip", "opening_above")
    assert effect_of("lifting_lip").sentence == "A lip lifts off and lets air in"


def test_what_shapes_it_does_not_grow_with_a_ramp() -> None:
    effects_in({"lifting_lip": known()})
    theta = coefficients(rigs.config("gripper").data)
    cause = Cause("lifting_lip", {"sonic_flow": 6.0, "begins": 500.0}, Course.RAMP, 0.0)
    at = cause.at(theta, HOUR / 2.0, 0)
    assert at == {"sonic_flow": 3.0, "begins": 500.0, "ends_below": 147.0}


def test_no_more_act_at_once_than_the_model_has_room_for() -> None:
    effects_in({"lifting_lip": known()})
    theta = coefficients(rigs.config("gripper").data)
    assert has_room(theta, ["lifting_lip", "leakage", "opening_beyond"])
    assert not has_room(theta, ["lifting_lip"] * (SLOTS + 1))
    for _ in range(SLOTS):
        theta = apply(theta, "lifting_lip", {"sonic_flow": 1.0})
    assert not effect_of("lifting_lip").acts(theta)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"mechanism": "opening_abov"}, "did you mean 'opening_above'"),
        ({"parameters": {"sonic_flow": RANGES["sonic_flow"]}}, "needs the parameters"),
        (
            {"parameters": RANGES | {"begins": {"low": 5.0, "high": 900.0, "found": 554.0}}},
            "20 to 900 mbar at most",
        ),
        (
            {"parameters": RANGES | {"sonic_flow": {"low": 1.0, "high": 60.0, "found": 2.0}}},
            "0 must lie within",
        ),
        (
            {"parameters": RANGES | {"begins": {"low": 100.0, "high": 200.0, "found": 554.0}}},
            "must lie within 100 to 200",
        ),
    ],
)
def test_what_the_model_cannot_do_is_refused(change: dict[str, object], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        known(**change)


@pytest.mark.parametrize("name", ["leakage", "opening_above", "unlisted", "Lip", "a b", "x"])
def test_a_name_that_is_taken_or_odd_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="name"):
        Proposal.read(proposal(tmp_path, name=name))
    with pytest.raises(ValidationError, match="name"):
        DataSet.model_validate({"catalogue": {name: LIP}})


def test_a_name_stands_for_one_mechanism_only() -> None:
    effects_in({"lifting_lip": known()})
    with pytest.raises(ConfigError, match="another mechanism under this name"):
        effects_in({"lifting_lip": known(mechanism="seepage_above", parameters=seeping())})


def seeping() -> dict[str, object]:
    (size,) = MECHANISMS["seepage_above"].place.parameters
    rest = {name: one for name, one in RANGES.items() if name != "sonic_flow"}
    return {size.name: RANGES["sonic_flow"], **rest}


# --- where it stands ------------------------------------------------------------------------------


def test_it_is_taken_in_for_a_type_and_comes_with_each_unit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    database = tmp_path / "assets.sqlite"
    file = proposal(tmp_path)
    url = f"sqlite:///{database}"
    assert twin(monkeypatch, "effects", "add", file, "--untested", "--assets", url) == 0
    assert "lifting_lip added" in capsys.readouterr().out
    document = Document.parse(f'[asset]\ntype = "{KIND}"\nid = "new"\n', "new.toml")
    config = Config.of(document, url)
    assert config.data.catalogue["lifting_lip"] == known()
    before = Config.of(document, "sqlite://")
    assert config.data.hash == before.data.hash  # the same pressures are expected


def catalogue_of(url: str, unit: str, kind: str = KIND) -> list[str]:
    document = Document.parse(f'[asset]\ntype = "{kind}"\nid = "{unit}"\n', "cell.toml")
    return list(Config.of(document, url, unit).data.catalogue)


def test_for_one_unit_it_is_taken_in_there_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    url, file = f"sqlite:///{tmp_path / 'assets.sqlite'}", proposal(tmp_path)
    target = ("--untested", "--assets", url, "--id", "gripper-01")
    assert twin(monkeypatch, "effects", "add", file, *target) == 0
    assert "gripper-01: lifting_lip added" in capsys.readouterr().out
    assert catalogue_of(url, "gripper-01") == ["lifting_lip"]
    assert catalogue_of(url, "another") == []


def test_for_a_site_it_is_taken_in_for_each_of_its_types(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    url, file = f"sqlite:///{tmp_path / 'assets.sqlite'}", proposal(tmp_path)
    with open_assets(tmp_path / "assets.sqlite") as database:
        database.add(replace(database.get(KIND).record, name="larger", type="larger"))
    assert twin(monkeypatch, "effects", "add", file, "--untested", "--assets", url, "--site") == 0
    said = capsys.readouterr().out
    for kind in (KIND, "larger"):
        assert f"{kind}: lifting_lip added" in said
        assert catalogue_of(url, "new", kind) == ["lifting_lip"]
    assert catalogue_of(url, "gripper-01") == ["lifting_lip"]  # from its type


def test_it_is_taken_in_for_one_of_unit_type_and_site(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = ("--untested", "--site", "--id", "gripper-01")
    assert twin(monkeypatch, "effects", "add", proposal(tmp_path), *both) == 2


def test_its_name_is_known_wherever_a_configuration_is() -> None:
    """An answer from another process names it: whoever puts that into words has only this."""
    config = rigs.config("gripper")
    data = config.data.model_copy(update={"catalogue": {"only_in_this_log": known()}})
    header = replace(config, data=data).log_header()
    assert find_effect("only_in_this_log") is None
    Config.of_recorded(header, "x.mcap")
    assert effect_of("only_in_this_log").look_at == "the lips of the cups"


def test_without_its_log_it_is_not_taken_in_untested(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    url = f"sqlite:///{tmp_path / 'assets.sqlite'}"
    assert twin(monkeypatch, "effects", "add", proposal(tmp_path), "--assets", url) == 3
    told = capsys.readouterr().err
    assert "lip.mcap" in told
    assert "--log LOG.mcap" in told
    assert not (tmp_path / "assets.sqlite").exists()


def test_a_units_own_stays_with_it_and_its_types_is_not_kept_twice(tmp_path: Path) -> None:
    entry = known().model_dump(mode="json")
    with open_assets(tmp_path / "assets.sqlite") as database:
        with pytest.raises(ConfigError, match="nothing is known of 'u' alone"):
            target_of(database, KIND, "u")
        database.add(Record("instance", "u", KIND, {"ejector": {"h1_mbar": 700.0}}))
        take_in(database, target_of(database, KIND, ""), "of_its_type", entry, "f.toml")
        take_in(database, target_of(database, KIND, "u"), "lifting_lip", entry, "f.toml")
        new = {"ejector": {"h1_mbar": 690.0}, "catalogue": {"of_its_type": entry}}
        kept = carried_on(database, "u", new)
    assert kept == {"ejector": {"h1_mbar": 690.0}, "catalogue": {"lifting_lip": entry}}


def test_it_goes_with_the_asset_in_shells(tmp_path: Path) -> None:
    entry = known().model_dump(mode="json")
    with open_assets(tmp_path / "assets.sqlite") as database:
        record = take_in(database, target_of(database, KIND, ""), "lifting_lip", entry, "f.toml")
    package = tmp_path / "type.aasx"
    package.write_bytes(write_package([record], 1, {}, ""))
    (there,) = read_package(package).document["records"]
    assert there["data"]["catalogue"]["lifting_lip"] == entry


def test_a_log_has_the_catalogue_that_it_was_recorded_with() -> None:
    config = rigs.config("gripper")
    data = config.data.model_copy(update={"catalogue": {"lifting_lip": known()}})
    header = replace(config, data=data).log_header()
    assert Config.of_recorded(header, "x.mcap").data.catalogue["lifting_lip"] == known()
