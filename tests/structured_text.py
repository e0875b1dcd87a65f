"""Structured Text made to run: blark parses it, and this makes a Python generator of a block.

As strict as a PLC's compiler where it matters here: an expression has one type, only the named
conversions change it, bit strings and unsigned numbers keep their width. Whatever a trace ring does
not need is refused.
"""

import re
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from blark import transform as tree
from blark.parse import parse_source_code

BITS = {"BOOL": 1, "WORD": 16, "DWORD": 32, "LWORD": 64}
UNSIGNED = {"UINT": 16, "UDINT": 32, "ULINT": 64}
SIGNED = {"INT": 16, "DINT": 32, "LINT": 64}
WIDTH = BITS | UNSIGNED | SIGNED
ARRAYS = {"WORD": np.uint16, "UINT": np.uint16, "UDINT": np.uint32, "REAL": np.float32}
SYMBOLS = {"AND": "&", "OR": "|", "MOD": "%", "/": "//", "+": "+", "-": "-", "*": "*"}

# What makes IEC text of an SCL source, so that the same parser reads both.
SCL = (
    (r'DATA_BLOCK ("\w+")([^;]*?)("\w+")\s+BEGIN', r"DATA_BLOCK \1\2VAR own : \3; END_VAR BEGIN"),
    (r"\{[^}]*\}|VERSION : 0\.1|NON_RETAIN|\bBEGIN\b", ""),
    (r'\bTYPE ("\w+")', r"TYPE \1 :"),
    (r"\bEND_STRUCT;", "END_STRUCT"),
    (r"\bDATA_BLOCK\b", "PROGRAM"),
    (r"\bEND_DATA_BLOCK\b", "END_PROGRAM"),
    (r'\bFUNCTION ("\w+") : Void\b', r"FUNCTION_BLOCK \1"),
    (r"\bEND_FUNCTION\b", "END_FUNCTION_BLOCK"),
    (r'(?<!\d)#|"', ""),
)


def parsed(source: str) -> list[Any]:
    """The objects of a source; lark's error where it is none."""
    short = re.sub(r"//.*|\(\*.*?\*\)|(?<=[ \n]) +", "", source)
    result = parse_source_code(short)  # half a millisecond for every character
    if result.exception:
        raise result.exception
    return list(result.transform().items)


def iec(scl: str) -> str:
    """IEC text of an SCL source."""
    scl = re.sub(r"//.*", "", scl)
    for pattern, text in SCL:
        scl = re.sub(pattern, text, scl)
    return scl


def to_bits(value: float) -> int:
    return int(struct.unpack(">I", struct.pack(">f", value))[0])


def to_width(value: int, kind: str) -> int:
    """``value`` as a number of type ``kind``, however it is cut off."""
    value &= (1 << WIDTH[kind]) - 1
    return value - (1 << WIDTH[kind]) if kind in SIGNED and value >> WIDTH[kind] - 1 else value


class Block:
    """A function block and its variables; ``real_bits`` says what REAL_TO_DWORD means."""

    def __init__(self, items: list[Any], name: str, *, real_bits: bool = False) -> None:
        self.types: dict[str, str] = {}
        self.values: dict[str, Any] = {}
        declarations = [item.declaration for item in items if hasattr(item, "declaration")]
        self._made = {str(declaration.name): declaration for declaration in declarations}
        self._real_bits = real_bits
        for item in items:
            if isinstance(item, tree.GlobalVariableDeclarations):
                self._declare(item.items, "GVL_Trace.")
        block = next(item for item in items if getattr(item, "name", None) == name)
        for part in block.declarations:
            self._declare(part.items)
        lines = ["def scan(v):", *self._statements(block.body.statements, "    ")]
        space: dict[str, Any] = {"to_bits": to_bits, "to_width": to_width}
        exec("\n".join(lines), space)
        self._scan = space["scan"]

    def scan(self, inputs: dict[str, Any]) -> Iterator[None]:
        """One call; stops after every statement."""
        assert set(inputs) <= set(self.types)
        self.values.update(inputs)
        yield from self._scan(self.values)

    def _declare(self, declarations: list[Any], prefix: str = "") -> None:
        for declared in declarations:
            init = getattr(declared, "init", None)
            spec = init.spec if init else declared.spec  # of a union's member
            for variable in (
                declared.variables if init and hasattr(declared, "variables") else [declared]
            ):
                name = prefix + str(
                    getattr(variable, "variable", getattr(variable, "name", variable))
                )
                self._add(name, spec, init and init.value)

    def _add(self, name: str, spec: Any, start: Any) -> None:
        if isinstance(spec, tree.ArraySpecification):
            kind = str(spec.type.type_name).upper()
            last = eval(self._expression(spec.subranges[0].stop)[0], {"v": self.values})
            self.values[name] = np.zeros(last + 1, ARRAYS[kind])
        else:
            kind = str(spec.type if hasattr(spec, "type") else spec)
            self.values[name] = 0 if start is None else int(str(start))
        self.types[name] = kind if kind in self._made else kind.upper()
        if kind in self._made:
            self._declare(self._made[kind].declarations, f"{name}.")

    def _statements(self, statements: list[Any], indent: str) -> list[str]:
        lines = []
        for statement in statements:
            if isinstance(statement, tree.IfStatement):
                assert statement.else_clause is None
                assert not statement.else_ifs
                condition = self._typed(statement.if_expression, "BOOL")
                body = self._statements(statement.statements.statements, indent + "    ")
                lines += [f"{indent}if {condition}:", *body]
            else:
                assert isinstance(statement, tree.AssignmentStatement)
                place, kind = self._place(statement.variables[0])
                value = self._typed(statement.expression, kind)
                if kind == "REAL" and self._of_union(statement.variables[0]):
                    value = f"to_bits({value})"
                lines += [f"{indent}{place} = {value}", f"{indent}yield"]
        return lines

    def _of_union(self, node: Any) -> bool:
        kind = self.types.get(str(node).partition(".")[0])
        return isinstance(self._made.get(str(kind)), tree.UnionTypeDeclaration)

    def _place(self, node: Any) -> tuple[str, str]:
        """Where a variable lies, in Python, and its type; a union's members lie in one place."""
        name, _, subscript = str(node).partition("[")
        kind = self.types[name]
        if self._of_union(node):
            name = name.partition(".")[0]
        index = f"[{self._expression(node.elements[-1].subscripts[0])[0]}]" if subscript else ""
        return f"v['{name}']{index}", kind

    def _typed(self, node: Any, kind: str) -> str:
        text, given = self._expression(node)
        assert given in (kind, ""), f"{node}: {given} where {kind} is due"
        return text

    def _expression(self, node: Any) -> tuple[str, str]:
        """Python text and type of an expression; no type for a plain number."""
        match node:
            case tree.Boolean():
                found = str(str(node) == "TRUE"), "BOOL"
            case tree.Integer():
                found = str(int(str(node.value), node.base)), str(node.type_name or "")
            case tree.ParenthesizedExpression():
                found = self._expression(node.expr)
            case tree.UnaryOperation():
                text, kind = self._expression(node.expr)
                found = {"-": f"-{text}", "NOT": f"(not {text})"}[str(node.op)], kind
            case tree.FunctionCall():
                found = self._call(node)
            case tree.BinaryOperation():
                found = self._operation(node)
            case _:
                found = self._place(node)
                assert found[1] != "REAL" or not self._of_union(node)
        return found

    def _operation(self, node: Any) -> tuple[str, str]:
        (left, one), (right, other) = self._expression(node.left), self._expression(node.right)
        kind = one or other
        assert {one, other} <= {kind, ""}, f"{node}: {one} and {other}"
        allowed = BITS if str(node.op) in ("AND", "OR") else UNSIGNED | SIGNED
        assert kind in allowed, f"{node}: not with {kind}"
        return f"to_width({left} {SYMBOLS[str(node.op)]} {right}, '{kind}')", kind

    def _call(self, node: Any) -> tuple[str, str]:
        name, arguments = str(node.name), [parameter.value for parameter in node.parameters]
        if name in ("SHL", "SHR"):
            text, kind = self._expression(arguments[0])
            assert kind in BITS
            sign = "<<" if name == "SHL" else ">>"
            return f"to_width({text} {sign} {arguments[1]}, '{kind}')", kind
        source, target = name.split("_TO_")
        text = self._typed(arguments[0], source)
        if name == "REAL_TO_DWORD":
            return (f"to_bits({text})" if self._real_bits else f"round({text})"), target
        return f"to_width(int({text}), '{target}')", target
