"""Write the README's generated tables anew: effects and register map, from the code."""

import re
from pathlib import Path

from drivers.plc.registers import table as register_table
from twin.model.courses import table as courses_table
from twin.model.effects import table as effects_table

README = Path(__file__).parent.parent / "README.md"
TABLES = {"register map": register_table, "effects": effects_table, "courses": courses_table}


def filled(text: str) -> str:
    """Return ``text`` with each marked table as the code has it."""
    for name, table in TABLES.items():
        marked = rf"(<!-- {name}: [^\n]*-->\n).*?(<!-- end -->)"
        text = re.sub(marked, lambda m, t=table: f"{m[1]}{t()}\n{m[2]}", text, flags=re.DOTALL)
    return text


if __name__ == "__main__":
    README.write_text(filled(README.read_text()))
