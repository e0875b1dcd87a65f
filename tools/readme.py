"""Generate the tables of README and documentation from the code."""

import re
from pathlib import Path

from drivers.plc.registers import table as register_table
from twin.alarms.text import rules_table as alarm_rules_table
from twin.alarms.text import table as alarm_states_table
from twin.figures.curve import table as curve_table
from twin.figures.key_figures import table as figures_table
from twin.figures.warnings import table as warnings_table
from twin.model.courses import table as courses_table
from twin.model.effects import table as effects_table
from twin.model.mechanism import places_table, whens_table

ROOT = Path(__file__).parent.parent
PAGES = (
    ROOT / "README.md",
    *(
        ROOT / "docs" / name
        for name in ("alarms.md", "effects.md", "key-figures.md", "mechanisms.md")
    ),
)
TABLES = {
    "register map": register_table,
    "effects": effects_table,
    "courses": courses_table,
    "places": places_table,
    "ways of acting": whens_table,
    "key figures": figures_table,
    "curve figures": curve_table,
    "warnings": warnings_table,
    "alarm states": alarm_states_table,
    "alarm rules": alarm_rules_table,
}


def filled(text: str) -> str:
    """Return ``text`` with each marked table generated anew."""
    for name, table in TABLES.items():
        marked = rf"(<!-- {name}: [^\n]*-->\n).*?(<!-- end -->)"
        text = re.sub(marked, lambda m, t=table: f"{m[1]}{t()}\n{m[2]}", text, flags=re.DOTALL)
    return text


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(filled(page.read_text()))
