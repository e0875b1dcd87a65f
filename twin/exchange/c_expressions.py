"""Building blocks of the generated C: kinds of values, expressions and declarations."""

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

# A kind is one of these, a class of named tuples, or a tuple of kinds.
NUMBER, WHOLE = "double", "int"
ROWS = "rows"  # one value per row: coefficients, state
LANE = "lane"  # one value per hypothesis
TABLES = "tables"  # rows per hypothesis
INDEX = "index"  # of a hypothesis
Kind = Any

ATOM = 9  # binds more tightly than any operator
_NAMED_BY_C = {"nan": "NAN", "inf": "INFINITY"}


class Untranslatable(Exception):  # noqa: N818 - says what the source has, not that something broke
    """A passage of the source without a translation, with its file and line."""


class Value(NamedTuple):
    """An expression in C, its kind, and how tightly its outermost operator binds."""

    text: str
    kind: Kind
    binds: int = ATOM

    def inside(self, binds: int) -> str:
        """The text as an operand of an operator with that precedence."""
        return self.text if self.binds >= binds else f"({self.text})"


@dataclass
class Declarations:
    """Constants and structures; each is declared once, before its first use."""

    _numbers: dict[str, float] = field(default_factory=dict)
    _structs: dict[str, str] = field(default_factory=dict)

    def constant(self, module: str, name: str, value: float) -> Value:
        """A named number of a module."""
        if name in _NAMED_BY_C:
            return Value(_NAMED_BY_C[name], NUMBER)
        c_name = named(module, name).upper()
        self._numbers[c_name] = value
        return Value(c_name, WHOLE if isinstance(value, int) else NUMBER)

    def type_of(self, kind: Kind) -> str:
        """The type in C of a kind; structures are declared at their first use."""
        if kind in (NUMBER, WHOLE):
            return str(kind)
        if kind in (ROWS, LANE, TABLES):
            return "double *"
        if isinstance(kind, tuple):
            words = [part if isinstance(part, str) else part.__name__ for part in kind]
            name, fields = "_".join(words), [f"a{n}" for n in range(len(kind))]
            types = [self.type_of(part) for part in kind]
        else:
            name, fields = kind.__name__, kind._fields
            types = [NUMBER] * len(fields)
        lines = [
            f"    {declared(type_name, part)};"
            for type_name, part in zip(types, fields, strict=True)
        ]
        self._structs[name] = "\n".join([f"struct {name} {{", *lines, "};"])
        return f"struct {name}"

    def text(self) -> str:
        """All declarations in C."""
        integers = [f"    {name} = {value}," for name, value in self._of(int)]
        numbers = [
            f"static const double {name} = {literal(value)};" for name, value in self._of(float)
        ]
        return "\n\n".join(
            ["\n".join(["enum {", *integers, "};"]), "\n".join(numbers), *self._structs.values()]
        )

    def _of(self, kind: type) -> list[tuple[str, float]]:
        return sorted(item for item in self._numbers.items() if isinstance(item[1], kind))


def named(module: str, name: str) -> str:
    """The C name of an object in one of the model's modules."""
    return f"{module.rsplit('.', 1)[-1]}_{name.strip('_')}"


def declared(type_name: str, name: str) -> str:
    """A declaration in C."""
    return f"{type_name}{name}" if type_name.endswith("*") else f"{type_name} {name}"


def literal(value: float) -> str:
    """A number to the last bit."""
    if isinstance(value, float) and not math.isfinite(value):
        return "NAN" if math.isnan(value) else ("INFINITY" if value > 0.0 else "-INFINITY")
    return repr(value)


def joined(first: Kind, second: Kind) -> Kind:
    """The kind that holds both."""
    if first is None or first == second:
        return second
    if isinstance(first, tuple) and isinstance(second, tuple) and len(first) == len(second):
        return tuple(joined(a, b) for a, b in zip(first, second, strict=True))
    if {first, second} == {NUMBER, WHOLE}:
        return NUMBER
    raise Untranslatable(f"{first} and {second} have no kind in common")
