"""What C is made of here: kinds of values, expressions, declarations."""

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
    """A passage of the source that has no translation, with its place."""


class Value(NamedTuple):
    """An expression in C, its kind, and how tightly its outermost operator binds."""

    text: str
    kind: Kind
    binds: int = ATOM

    def inside(self, binds: int) -> str:
        """The text as an operand of an operator that binds so tightly."""
        return self.text if self.binds >= binds else f"({self.text})"


@dataclass
class Declarations:
    """Constants and structures, each once and before it is used."""

    _numbers: dict[str, float] = field(default_factory=dict)
    _structs: dict[str, str] = field(default_factory=dict)

    def constant(self, module: str, name: str, value: float) -> Value:
        """A number that has a name in a module."""
        if name in _NAMED_BY_C:
            return Value(_NAMED_BY_C[name], NUMBER)
        known = named(module, name).upper()
        self._numbers[known] = value
        return Value(known, WHOLE if isinstance(value, int) else NUMBER)

    def type_of(self, kind: Kind) -> str:
        """The type in C of a kind; structures are declared at their first use."""
        if kind in (NUMBER, WHOLE):
            return str(kind)
        if kind in (ROWS, LANE, TABLES):
            return "double *"
        if isinstance(kind, tuple):
            words = [one if isinstance(one, str) else one.__name__ for one in kind]
            name, fields = "_".join(words), [f"a{n}" for n in range(len(kind))]
            types = [self.type_of(one) for one in kind]
        else:
            name, fields = kind.__name__, kind._fields
            types = [NUMBER] * len(fields)
        lines = [f"    {declared(of, one)};" for of, one in zip(types, fields, strict=True)]
        self._structs[name] = "\n".join([f"struct {name} {{", *lines, "};"])
        return f"struct {name}"

    def text(self) -> str:
        """All of them in C."""
        whole = [f"    {name} = {value}," for name, value in self._of(int)]
        numbers = [
            f"static const double {name} = {literal(value)};" for name, value in self._of(float)
        ]
        return "\n\n".join(
            ["\n".join(["enum {", *whole, "};"]), "\n".join(numbers), *self._structs.values()]
        )

    def _of(self, kind: type) -> list[tuple[str, float]]:
        return sorted(one for one in self._numbers.items() if isinstance(one[1], kind))


def named(module: str, name: str) -> str:
    """The name in C of what a module of ours has."""
    return f"{module.rsplit('.', 1)[-1]}_{name.strip('_')}"


def declared(of: str, name: str) -> str:
    """A declaration."""
    return f"{of}{name}" if of.endswith("*") else f"{of} {name}"


def literal(value: float) -> str:
    """A number to the last bit."""
    if isinstance(value, float) and not math.isfinite(value):
        return "NAN" if math.isnan(value) else ("INFINITY" if value > 0.0 else "-INFINITY")
    return repr(value)


def joined(one: Kind, two: Kind) -> Kind:
    """The kind that holds both."""
    if one is None or one == two:
        return two
    if isinstance(one, tuple) and isinstance(two, tuple) and len(one) == len(two):
        return tuple(joined(a, b) for a, b in zip(one, two, strict=True))
    if {one, two} == {NUMBER, WHOLE}:
        return NUMBER
    raise Untranslatable(f"{one} and {two} have no kind in common")
