"""What people do with the program in their first hour, in a real terminal and a fresh folder.

Each journey uses the commands of the README, and asserts what the person sees.
"""

import re
import socket
from datetime import datetime, timedelta
from pathlib import Path

import rigs
from openpyxl import Workbook
from terminal import Program, typed

from twin.signals import Command

UNIT = "gripper-01"


def write_cell(folder: Path) -> Path:
    """The configuration of a cell: the shipped gripper, at a port that is free here."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = int(free.getsockname()[1])
    path = folder / f"{UNIT}.toml"
    path.write_text(rigs.path_of("gripper").read_text().replace("port = 5021", f"port = {port}"))
    return path


def test_a_wrong_word_order_is_named_and_put_right(tmp_path: Path) -> None:
    config = write_cell(tmp_path)
    right = config.read_text()
    with Program(tmp_path, "plc", config) as plc:
        plc.until("listening on")
        config.write_text(right.replace("[driver.tags]", 'word_order = "little"\n[driver.tags]'))
        said = typed(tmp_path, "probe", config, code=3)
        assert 'set word_order = "big" in [driver]' in said
        config.write_text(config.read_text().replace('"little"', '"big"'))
        said = typed(tmp_path, "probe", config, code=None)  # a busy machine is slow to answer
        assert re.search("(?m)^ok +word order +big, by the test registers", said)
        assert re.search("(?m)^ok +trace records", said)
        assert "set word_order" not in said


HEADER = ["Zeitstempel", "Unterdruck [kPa]", "Saugen", "Abblasen"]
COLUMNS = """
[import]
time_zone = "Europe/Berlin"

[import.columns]
time = "Zeitstempel"
vacuum = "Unterdruck [kPa]"
suction = "Saugen"
blow_off = "Abblasen"
"""


def test_a_german_excel_trace_becomes_a_log(tmp_path: Path) -> None:
    config = write_cell(tmp_path)
    book = Workbook()
    sheet = book.active
    assert sheet is not None
    sheet.append(["Anlage 4, Greifer links"])
    sheet.append(HEADER)
    rows = rigs.recorded("gripper", 6.0)[0][::10]
    begin = datetime(2026, 3, 1, 12, 0, 0)
    for number, row in enumerate(rows):
        bits = int(row["commands"])
        commands = [bool(bits & one) for one in (Command.SUCTION, Command.BLOW_OFF)]
        vacuum = (101_300.0 - float(row["pressure"])) / 1e3
        sheet.append([begin + timedelta(milliseconds=10 * number), round(vacuum, 3), *commands])
    book.save(tmp_path / "Messung.xlsx")
    asked = typed(tmp_path, "import", "Messung.xlsx", "--config", config, "--dry-run", code=3)
    assert "say under [import.columns] which one it is" in asked
    config.write_text(config.read_text() + COLUMNS)
    shown = typed(tmp_path, "import", "Messung.xlsx", "--config", config, "--dry-run")
    assert "600 rows, 5.990 s, every 10 ms" in shown
    typed(tmp_path, "import", "Messung.xlsx", "--config", config, "-o", "Messung.mcap")
    figures = typed(tmp_path, "figures", "show", "Messung.mcap")
    assert "t0" in figures
    assert typed(tmp_path, "log", "check", "Messung.mcap")
