"""A real gripper, 38 rows a second without commands: imported, read, commissioned and compared."""

import json
from pathlib import Path

import numpy as np
import pytest
import rigs
from command_line import twin as command
from table_rows import SMALL
from test_derive import DATA, known, written

import twin
from twin.config import Config
from twin.errors import ConfigError
from twin.log.reader import open_log
from twin.signals import Command

CONFIG = DATA / "gripper.toml"
HELD, VENTED = sorted(DATA.glob("hold*.csv")), sorted(DATA.glob("vent*.csv"))
NEEDS_COMMANDS = "A twin needs to know when valves were told"


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Each record as a log, and the five vents behind each other as one."""
    folder = tmp_path_factory.mktemp("measured")
    config = folder / "joined.toml"
    config.write_text(
        f'{CONFIG.read_text()}jumps = "mark"    # time begins anew with each record\n'
    )
    joined = folder / "vents.csv"
    lines = [path.read_text().splitlines() for path in VENTED]
    joined.write_text("\n".join([*lines[0], *(row for some in lines[1:] for row in some[1:])]))
    files = [*((path, CONFIG) for path in (*HELD, *VENTED)), (joined, config)]
    with pytest.MonkeyPatch.context() as patch:
        for path, wanted in files:
            log = folder / f"{path.stem}.mcap"
            told = ("import", path, "--config", wanted, "-o", log, "--derive-commands")
            assert command(patch, *told) == 0
    return {path.stem: folder / f"{path.stem}.mcap" for path, _ in files}


def curve(
    monkeypatch: pytest.MonkeyPatch, log: Path, folder: Path
) -> list[dict[str, dict[str, float | str | None]]]:
    """What is read off each suction."""
    assert command(monkeypatch, "figures", "show", log, "--json", folder / "f.json") == 0
    told = json.loads((folder / "f.json").read_text())
    assert "derived from the pressure" in told["commands"]
    found: list[dict[str, dict[str, float | str | None]]] = told["curve"]
    return found


def test_suction_is_on_until_the_vacuum_ends(logs: dict[str, Path]) -> None:
    for name, log in logs.items():
        recorded = open_log(log)
        rows = np.concatenate([samples for samples, _ in recorded.blocks()])
        on = (rows["commands"] & Command.SUCTION) != 0
        off = np.flatnonzero(np.diff(on.astype(int)) == -1)
        assert on[0]
        assert len(off) == (5 if name == "vents" else 1)
        # What follows is ambient, and no release goes above it.
        assert not on[off[-1] + 1 :].any()
        assert (rows["pressure"][off[-1] + 3 :] > 101_400.0).all()
        assert not (rows["commands"] & Command.BLOW_OFF).any()
        assert "whether a blow-off or a vent ends the vacuum cannot be told" in (
            recorded.header.derived
        )


def test_what_holds_is_read_off_with_its_uncertainty(
    logs: dict[str, Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    found = [curve(monkeypatch, logs[path.stem], tmp_path)[0] for path in HELD]
    highest = [cycle["highest"]["value"] for cycle in found]
    assert highest == pytest.approx([436.3, 446.2, 446.6], abs=0.5)
    assert all(0.2 < float(cycle["highest"]["half95"] or 0.0) < 1.0 for cycle in found)
    opened = [cycle["open_cup"]["value"] for cycle in found]
    assert opened == pytest.approx([32.2, 40.9, 40.4], abs=1.0)
    for cycle in found:
        assert cycle["evacuation"]["value"] == pytest.approx(52.0, abs=10.0)  # in two or three rows
        assert cycle["evacuation"]["half95"] == pytest.approx(25.6, abs=0.5)
        assert cycle["rate"]["value"] is None
        assert "too few readings in the evacuation" in str(cycle["rate"]["why"])
    last = [cycle["last"]["value"] for cycle in found]
    assert last == pytest.approx([434.7, 445.2, 288.5], abs=1.0)  # the third loses its hold


def test_an_open_cup_that_is_vented_is_read_off_alike_five_times(
    logs: dict[str, Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    found = curve(monkeypatch, logs["vents"], tmp_path)
    highest = np.array([cycle["highest"]["value"] for cycle in found], float)
    assert len(highest) == 5
    assert highest.mean() == pytest.approx(56.1, abs=0.3)
    assert np.ptp(highest) < 0.5  # mbar: 0.1 % of what an ejector makes
    whys = {str(cycle["evacuation"].get("why")) for cycle in found}
    assert whys == {"the record begins in the vacuum"}


def test_log_check_says_how_the_commands_were_found(
    logs: dict[str, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command(monkeypatch, "log", "check", logs["vent_0"]) == 0
    assert "commands: suction and blow_off derived from the pressure: 1 suction" in (
        capsys.readouterr().out
    )


def test_no_twin_is_fitted_and_what_still_can_be_told_is_said(
    logs: dict[str, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log = logs["hold_and_release_0"]
    assert command(monkeypatch, "commission", log, "--id", "g") == 2
    assert command(monkeypatch, "calibrate", log, "--config", CONFIG) == 2
    said = capsys.readouterr().err
    assert said.count(NEEDS_COMMANDS) == 2
    assert "twin figures show LOG, twin compare A B" in said


def test_two_records_are_compared_by_their_curves(
    logs: dict[str, Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    a, b = logs["hold_and_release_0"], logs["hold_and_release_1"]
    told = ("--json", tmp_path / "c.json", "--picture", tmp_path / "c.png")
    assert command(monkeypatch, "compare", a, b, *told) == 0
    answer = json.loads((tmp_path / "c.json").read_text())
    by_name = {figure["name"]: figure for figure in answer["figures"]}
    assert by_name["highest"]["difference"] == pytest.approx(9.9, abs=0.5)
    assert by_name["highest"]["low95"] is None  # one suction each: nobody knows the scatter
    assert answer["conclusion"].startswith("Too few cycles to say whether they differ: 1 and 1")
    assert answer["deviations"] == []
    assert capsys.readouterr().err.count("derived from the pressure") == 2
    assert (tmp_path / "c.png").stat().st_size > 10_000
    # Five vents against five of the same.
    assert command(monkeypatch, "compare", logs["vents"], logs["vents"], *told[:2]) == 0
    answer = json.loads((tmp_path / "c.json").read_text())
    assert answer["conclusion"].startswith("B does not differ from A beyond chance")


def test_a_replay_keeps_the_mark_and_raises_no_alarm(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = written(tmp_path / "a.csv", known("gripper")[:8000])
    config = rigs.path_of("gripper")
    log, again = tmp_path / "a.mcap", tmp_path / "b.mcap"
    told = ("import", file, "--config", config, "-o", log, "--derive-commands")
    assert command(monkeypatch, *told) == 0
    assert command(monkeypatch, "replay", log, "-o", again) == 0
    out = capsys.readouterr().out
    assert "cycle 2: evacuated to H2 in 1" in out
    assert "alarm" not in out
    assert "expected" not in out  # nobody knows when
    assert open_log(again).header.derived == open_log(log).header.derived != ""
    assert command(monkeypatch, "diagnose", log, "--json", tmp_path / "d.json") == 0
    answer = json.loads((tmp_path / "d.json").read_text())
    assert answer["verdict"] == "insufficient"
    assert "derived from the pressure" in answer["next_experiment"]


def test_a_notebook_opens_it_with_a_warning() -> None:
    with pytest.warns(UserWarning, match="suction and blow_off derived from the pressure"):
        log = twin.open(HELD[0], CONFIG, derive_commands=True)
    assert log.columns()["suction"][0]
    with pytest.raises(ConfigError, match=NEEDS_COMMANDS):
        twin.calibrate(log)


@pytest.mark.parametrize(("column", "gauge"), [("vacuum_mbar", True), ("pressure_mbar", False)])
def test_a_log_of_a_table_says_what_its_pressure_counts_from(
    column: str, gauge: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Weather moves the readings of one sensor and not of the other, whoever looks at the log."""
    text = SMALL if column == "pressure_mbar" else SMALL.replace("pressure_mbar", column)
    file, config = tmp_path / "t.csv", rigs.path_of("gripper")
    file.write_text(text)
    log, again = tmp_path / "a.mcap", tmp_path / "b.mcap"
    assert command(monkeypatch, "import", file, "--config", config, "-o", log) == 0
    assert command(monkeypatch, "replay", log, "--config", config, "-o", again) == 0
    for path in (log, again):
        assert Config.of_recorded(open_log(path).header, path.name).is_gauge == gauge
    assert twin.open(file, config).config.is_gauge == gauge
