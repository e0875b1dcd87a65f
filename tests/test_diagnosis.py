"""Effects hidden in the simulated rig's data are found, and nothing is found where nothing is."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks
from twin.config import Config
from twin.diagnosis.answer import Diagnosis, diagnose, split
from twin.errors import ConfigError
from twin.settings import Document
from twin.signals import Command, Quality, Samples

ROOT = Path(__file__).parent.parent
DOCUMENT = Document.read(ROOT / "configs" / "test_rig.toml")
CONFIG = Config.of(DOCUMENT)
PLC = DOCUMENT.section(PlcSettings, "plc")

# Sizes from just isolable to gross, in the unit of the effect's parameter; one is drawn by seed.
SIZES = {
    "leakage": (0.5, 8.0),
    "porous_leakage": (0.6, 6.0),
    "check_valve_leak": (0.5, 5.0),
    "suction_loss": (4.0, 30.0),
    "end_vacuum_loss": (12.0, 60.0),
    "added_volume": (20.0, 200.0),
    "heat_exchange": (13.0, 25.0),
    "response_delay": (8.0, 60.0),
    "slow_ramp_up": (10.0, 60.0),
    "threshold_drift": (8.0, 40.0),
    "weak_blow_off": (10.0, 50.0),
    "blow_off_delay": (5.0, 40.0),
    "sensor_offset": (4.0, 30.0),
    "sensor_gain": (1.0, 6.0),
    "sensor_lag": (8.0, 50.0),
}


def quiet(_what: str) -> None:
    """Take progress and say nothing."""


def record(seconds: float, *faults: str, seed: int = 0) -> Iterator[Samples]:
    return blocks(PLC, seconds, [parse_fault(fault) for fault in faults], seed)


def of(stream: Iterator[Samples], config: Config = CONFIG) -> Diagnosis:
    return diagnose(config, stream, "log.mcap", quiet)


@pytest.mark.parametrize("seed", range(6))
def test_a_hidden_effect_is_named_with_its_size(seed: int) -> None:
    rng = np.random.default_rng([2026, seed])
    effect = str(rng.choice(list(SIZES)))
    low, high = SIZES[effect]
    size = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    answer = of(record(27.0, f"{effect}={size:.3f}", seed=int(rng.integers(1 << 30)))).json

    assert answer["verdict"] == "explained", (effect, size, answer)
    (cause,) = answer["causes"]
    assert effect in {cause["effect"], *cause["not_separable_from"]}, (effect, size, cause)
    assert cause["course"] == "constant"
    if cause["effect"] == effect:
        (found,) = cause["parameters"].values()
        assert found["value"] == pytest.approx(size, rel=0.35)
    if effect != "threshold_drift":  # it moves the switching points, not the curve between them
        assert answer["extended"]["rms_mbar"] < 0.7 * answer["baseline"]["rms_mbar"]
        assert answer["gain"]["low95"] > 0


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_healthy_cycles_are_consistent(seed: int) -> None:
    answer = of(record(27.0, seed=seed)).json
    assert (answer["verdict"], answer["causes"]) == ("consistent", [])
    assert answer["baseline"]["leftover_sigma"] < 1.6
    assert answer["gain"]["rms_reduction_pct"] == 0


def test_a_leak_that_opens_half_way_is_a_step_with_its_onset() -> None:
    answer = of(record(27.0, "leakage=1.7@14.4", seed=21)).json
    (cause,) = answer["causes"]
    assert (cause["effect"], cause["course"]) == ("leakage", "step")
    assert cause["onset_s"] == pytest.approx(14.4, abs=0.1)
    assert cause["parameters"]["sonic_flow"]["low95"] < 1.75
    assert answer["extended"]["leftover_sigma"] < 1.5 < answer["baseline"]["leftover_sigma"]


def test_an_effect_outside_the_table_is_not_explained_away() -> None:
    answer = of(record(27.0, "sensor_backlash=25", seed=22)).json
    assert answer["verdict"] == "unlisted"
    assert answer["unlisted"]["where"] in {"suction", "hold", "blow_off", "idle"}


def test_fitted_and_held_out_cycles_have_nothing_in_common() -> None:
    diagnosis = of(record(20.0, "suction_loss=12", seed=23))
    cycles = diagnosis.json["cycles"]
    assert not set(cycles["fitted"]) & set(cycles["held_out"])
    assert {0} | set(cycles["fitted"]) | set(cycles["held_out"]) == set(range(cycles["total"]))
    onset = int(diagnosis.evidence.starts[4]) + 100
    assert 4 in split(diagnosis.evidence, onset)[0]


def test_the_answer_has_the_form_that_others_rely_on() -> None:
    answer = json.loads(json.dumps(of(record(20.0, "leakage=2", seed=24)).json, allow_nan=False))
    assert list(answer) == [
        "format",
        "log",
        "asset",
        "verdict",
        "causes",
        "runners_up",
        "unlisted",
        "cycles",
        "baseline",
        "extended",
        "gain",
        "next_experiment",
    ]
    assert answer["format"] == "ejector-twin-diagnosis/1"
    assert set(answer["causes"][0]) == {
        "effect",
        "course",
        "onset_s",
        "parameters",
        "probability",
        "not_separable_from",
        "why",
    }
    assert set(answer["causes"][0]["parameters"]["sonic_flow"]) == {
        "value",
        "unit",
        "low95",
        "high95",
    }
    figures = {"rms_mbar", "max_mbar", "evacuation_time_error_pct", "leftover_sigma"}
    assert set(answer["baseline"]) == set(answer["extended"]) == figures
    assert set(answer["gain"]) == {"rms_reduction_pct", "low95", "high95"}
    assert set(answer["runners_up"][0]) == {"effect", "course", "leftover_sigma"}


def test_too_few_cycles_are_insufficient() -> None:
    answer = of(record(8.0)).json
    assert (answer["verdict"], answer["causes"]) == ("insufficient", [])
    assert "cycle can be judged" in answer["next_experiment"]


def test_a_log_without_suction_is_insufficient() -> None:
    def idle() -> Iterator[Samples]:
        for block in record(20.0):
            block["commands"] &= Command.BLOW_OFF.value
            yield block

    answer = of(idle()).json
    assert answer["verdict"] == "insufficient"
    assert "suction" in answer["next_experiment"]


def test_an_empty_log_is_insufficient() -> None:
    assert of(iter(())).json["verdict"] == "insufficient"


def test_a_saturated_sensor_is_insufficient() -> None:
    def saturated() -> Iterator[Samples]:
        for block in record(20.0):
            block["quality"][block["pressure"] < 50_000] |= Quality.OVERFLOW.value
            yield block

    answer = of(saturated()).json
    assert answer["verdict"] == "insufficient"
    assert "saturated" in answer["next_experiment"]


def test_a_gap_costs_its_cycle_and_nothing_else() -> None:
    def gappy() -> Iterator[Samples]:
        for number, block in enumerate(record(30.0, "leakage=2", seed=25)):
            if number == 12:
                block["quality"][400] |= Quality.GAP.value
            yield block[400:] if number == 12 else block

    (cause,) = of(gappy()).json["causes"]
    assert cause["effect"] == "leakage"


def test_without_calibration_there_is_no_diagnosis() -> None:
    text = DOCUMENT.text.split("[monitor.healthy]")[0] + "[plc]\n"
    bare = Config.of(Document.parse(text, "bare.toml"))
    with pytest.raises(ConfigError, match=r"bare\.toml: the twin is not calibrated"):
        of(record(8.0), bare)
