"""Compiled functions of the model as C: the same source, so the physics exists once.

What is translated is the part of Python that the model is written in: numbers, rows of numbers,
named tuples, tuples, ``if``, and loops over ranges and over what is written out. One hypothesis is
left: loops over hypotheses are done once and the index of a hypothesis falls away. Functions are
specialised by the kinds of their arguments, as the compiler for Python does it. Anything else is
refused with file and line.
"""

import ast
import builtins
import inspect
import math
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np

from twin.exchange.c import (
    ATOM,
    INDEX,
    LANE,
    NUMBER,
    ROWS,
    TABLES,
    WHOLE,
    Declarations,
    Kind,
    Untranslatable,
    Value,
    declared,
    joined,
    literal,
    named,
)

# What every translated program needs: Python's min and max, and whole numbers that do not overflow.
PRELUDE = """\
static double lesser(double a, double b) { return b < a ? b : a; }
static double greater(double a, double b) { return b > a ? b : a; }
static int whole(double x) { return x > -1e9 ? (x < 1e9 ? (int)x : 1000000000) : -1000000000; }
"""

# What is called of Python and of NumPy, on one value.
_CALLED: Mapping[object, tuple[str, Kind]] = {
    math.sqrt: ("sqrt({})", NUMBER),
    math.sin: ("sin({})", NUMBER),
    math.ceil: ("whole(ceil({}))", WHOLE),
    math.isnan: ("isnan({})", WHOLE),
    np.log: ("log({})", NUMBER),
    np.exp: ("exp({})", NUMBER),
    abs: ("fabs({})", NUMBER),
    float: ("{}", NUMBER),
    int: ("whole({})", WHOLE),
}
_BINARY: Mapping[type[ast.operator], tuple[str, int]] = {
    ast.Add: ("+", 2),
    ast.Sub: ("-", 2),
    ast.Mult: ("*", 3),
    ast.Div: ("/", 3),
    ast.BitAnd: ("&", 0),
    ast.BitOr: ("|", 0),
}
_COMPARED: Mapping[type[ast.cmpop], str] = {
    ast.Lt: "<",
    ast.LtE: "<=",
    ast.Gt: ">",
    ast.GtE: ">=",
    ast.Eq: "==",
    ast.NotEq: "!=",
}


@dataclass
class Function:
    """A function in C: its name and what it returns."""

    name: str
    returns: Kind = None


@dataclass
class Program:
    """Functions with what they need, each before it is used."""

    declarations: Declarations = field(default_factory=Declarations)
    _texts: list[str] = field(default_factory=list)
    _functions: dict[tuple[object, tuple[Kind, ...]], Function] = field(default_factory=dict)

    def function(self, source: Callable[..., Any], *kinds: Kind) -> Function:
        """The function for arguments of these kinds, translated where it is not yet."""
        plain = getattr(source, "py_func", source)
        if (plain, kinds) not in self._functions:
            name, taken = named(plain.__module__, plain.__name__), self._functions.values()
            while any(one.name == name for one in taken):
                name += "_again"
            self._functions[plain, kinds] = made = Function(name)
            self._texts.append(_Body(self, plain, kinds, made).text())
        return self._functions[plain, kinds]

    def text(self) -> str:
        """The whole program."""
        return "\n\n".join([self.declarations.text(), PRELUDE, *self._texts]) + "\n"


class _Body:
    """One function on its way to C."""

    def __init__(
        self, program: Program, source: Callable[..., Any], kinds: tuple[Kind, ...], made: Function
    ) -> None:
        self._program, self._source, self._made = program, source, made
        self._known = program.declarations
        lines, self._line = inspect.getsourcelines(source)
        tree = ast.parse(textwrap.dedent("".join(lines))).body[0]
        assert isinstance(tree, ast.FunctionDef)
        self._tree = tree
        names = [argument.arg for argument in tree.args.args]
        self._parameters = dict(zip(names, kinds, strict=True))
        self._locals: dict[str, Kind] = {}
        self._count = 0

    def text(self) -> str:
        """The function in C; gone through until the kinds of all its variables are known."""
        told = ast.get_docstring(self._tree)
        statements = self._tree.body[1:] if told else self._tree.body
        while True:
            before, self._count = (dict(self._locals), self._made.returns), 0
            body = self._block(statements)
            if before == (self._locals, self._made.returns):
                break
        given = [
            declared(self._known.type_of(kind), name)
            for name, kind in self._parameters.items()
            if kind != INDEX
        ]
        returned = self._known.type_of(self._made.returns) if self._made.returns else "void"
        head = f"static {declared(returned, self._made.name)}({', '.join(given)}) {{"
        known = [
            f"    {declared(self._known.type_of(kind), name)};"
            for name, kind in self._locals.items()
        ]
        comment = [f"/* {textwrap.indent(told, '   ').strip()} */"] if told else []
        return "\n".join([*comment, head, *known, *body, "}"])

    # --- statements -----------------------------------------------------------------------------

    def _block(self, statements: list[ast.stmt]) -> list[str]:
        return [f"    {line}" for one in statements for line in self._statement(one)]

    def _statement(self, node: ast.stmt) -> list[str]:  # noqa: PLR0911 - a table of statements
        match node:
            case ast.Assign(targets=[ast.Tuple(elts=targets)], value=value):
                return self._unpacked(targets, value)
            case ast.Assign(targets=targets, value=value):
                given = self._value(value)
                return [
                    " = ".join([*(self._target(one, given) for one in targets), given.text]) + ";"
                ]
            case ast.AnnAssign(target=target, value=ast.expr() as value):
                given = self._value(value)
                return [f"{self._target(target, given)} = {given.text};"]
            case ast.AugAssign():
                return self._changed(node)
            case ast.If(test=test, body=body, orelse=other):
                lines = [f"if ({self._truth(test)}) {{", *self._block(body), "}"]
                return [*lines[:-1], "} else {", *self._block(other), "}"] if other else lines
            case ast.For():
                return self._loop(node)
            case ast.Return(value=ast.expr() as value):
                return [f"return {self._returned(value)};"]
            case ast.Expr(value=ast.Call() as call):
                return [f"{self._value(call).text};"]
            case ast.Continue():
                return ["continue;"]
        raise self._refused(node)

    def _unpacked(self, targets: list[ast.expr], value: ast.expr) -> list[str]:
        """Several targets at once; values that read what is assigned are held meanwhile."""
        if isinstance(value, ast.Tuple):
            parts = [self._value(one) for one in value.elts]
            written = {one.id for target in targets for one in _names(target)}
            if not written & {one.id for one in _names(value)}:
                held, lines = parts, []
            else:
                held = [Value(self._held(part.kind), part.kind) for part in parts]
                pairs = zip(held, parts, strict=True)
                lines = [f"{name.text} = {part.text};" for name, part in pairs]
        else:
            whole = self._value(value)
            name = self._held(whole.kind)
            held = [Value(f"{name}.a{n}", kind) for n, kind in enumerate(whole.kind)]
            lines = [f"{name} = {whole.text};"]
        for target, part in zip(targets, held, strict=True):
            if not (isinstance(target, ast.Name) and target.id == "_"):
                lines.append(f"{self._target(target, part)} = {part.text};")
        return lines

    def _changed(self, node: ast.AugAssign) -> list[str]:
        """``x += v`` and the like; several rows at once get the same ``v``."""
        if type(node.op) not in _BINARY:
            raise self._refused(node)
        given, (sign, _) = self._value(node.value), _BINARY[type(node.op)]
        if isinstance(node.op, ast.Div):
            given = Value(given.text, NUMBER)  # and so becomes what is divided
        match node.target:
            case ast.Subscript(value=of, slice=ast.List(elts=rows)):
                name = self._held(given.kind)
                places = [f"{self._value(of).text}[{self._value(row).text}]" for row in rows]
                return [f"{name} = {given.text};", *(f"{one} {sign}= {name};" for one in places)]
        return [f"{self._target(node.target, given)} {sign}= {given.text};"]

    def _loop(self, node: ast.For) -> list[str]:
        match node.iter, node.target:
            case ast.Call(func=ast.Name(id="range"), args=[ast.Subscript()]), ast.Name(id=name):
                self._parameters[name] = INDEX  # over hypotheses, of which there is one
                return ["do {", *self._block(node.body), "} while (0);"]
            case ast.Call(func=ast.Name(id="range"), args=[_] | [_, _] as bounds), ast.Name(
                id=name
            ):
                values = [self._value(one).text for one in bounds]
                start, end = ["0", *values][-2:]
                counter = f"n{self._next()}" if name == "_" else name
                self._local(counter, WHOLE)
                head = f"for ({counter} = {start}; {counter} < {end}; {counter}++) {{"
                return [head, *self._block(node.body), "}"]
            case ast.Tuple(elts=items), target if not _continues(node.body):
                lines = []
                for item in items:  # written out one after the other
                    given: list[ast.stmt] = [ast.Assign([target], item, lineno=node.lineno)]
                    lines += [line for one in given + node.body for line in self._statement(one)]
                return lines
        raise self._refused(node)

    def _returned(self, node: ast.expr) -> str:
        if isinstance(node, ast.Tuple):
            given = self._tuple([self._value(one) for one in node.elts], self._made.returns)
        else:
            given = self._value(node)
        self._made.returns = joined(self._made.returns, given.kind)
        return given.text

    def _target(self, node: ast.expr, given: Value) -> str:
        if isinstance(node, ast.Name):
            self._local(node.id, given.kind)
            return node.id
        return self._value(node).text

    def _local(self, name: str, kind: Kind) -> None:
        if name not in self._parameters:
            self._locals[name] = joined(self._locals.get(name), kind)
        elif joined(self._parameters[name], kind) != self._parameters[name]:
            raise Untranslatable(f"{self._made.name}: {name} changes its kind")

    def _held(self, kind: Kind) -> str:
        name = f"held{self._next()}"
        self._local(name, kind)
        return name

    def _next(self) -> int:
        self._count += 1
        return self._count

    # --- expressions ----------------------------------------------------------------------------

    def _value(self, node: ast.expr) -> Value:  # noqa: C901, PLR0911, PLR0912 - a table of expressions
        match node:
            case ast.Constant(value=bool() as truth):
                return Value(str(int(truth)), WHOLE)
            case ast.Constant(value=int() | float() as number):
                return Value(literal(number), WHOLE if isinstance(number, int) else NUMBER)
            case ast.Name(id=name) if name in self._parameters:
                return Value(name, self._parameters[name])
            case ast.Name(id=name) if name in self._locals:
                return Value(name, self._locals[name])
            case ast.Name() | ast.Attribute() if (static := self._static(node)) is not None:
                return self._constant(node, static)
            case ast.Attribute(value=of, attr=name):
                return Value(f"{self._value(of).text}.{name}", NUMBER)
            case ast.Subscript():
                return self._part(node)
            case ast.BinOp():
                return self._binary(node)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                given = self._value(operand)
                return Value(f"-{given.inside(5)}", given.kind, 4)
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return Value(f"!({self._truth(operand)})", WHOLE)
            case ast.BoolOp(op=op, values=values):
                sign = " && " if isinstance(op, ast.And) else " || "
                return Value(sign.join(f"({self._truth(one)})" for one in values), WHOLE, 0)
            case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _COMPARED:
                pair = self._value(left).inside(2), self._value(right).inside(2)
                return Value(f"{pair[0]} {_COMPARED[type(op)]} {pair[1]}", WHOLE, 1)
            case ast.IfExp(test=test, body=body, orelse=other):
                return self._choice(test, body, other)
            case ast.Tuple(elts=parts):
                return self._tuple([self._value(one) for one in parts])
            case ast.Call(keywords=[]):
                return self._call(node)
        raise self._refused(node)

    def _tuple(self, parts: list[Value], wanted: Kind = None) -> Value:
        kind = joined(wanted, tuple(part.kind for part in parts))
        text = ", ".join(part.text for part in parts)
        return Value(f"({self._known.type_of(kind)}){{{text}}}", kind)

    def _truth(self, node: ast.expr) -> str:
        given = self._value(node)
        return given.text if given.kind == WHOLE else f"{given.inside(2)} != 0.0"

    def _choice(self, test: ast.expr, body: ast.expr, other: ast.expr) -> Value:
        one, two = self._value(body), self._value(other)
        text = f"({self._truth(test)}) ? {one.inside(1)} : {two.inside(1)}"
        return Value(text, joined(one.kind, two.kind), 0)

    def _constant(self, node: ast.expr, static: object) -> Value:
        """A number of a module, under the name it has in the module that was asked."""
        if not isinstance(static, int | float):
            raise self._refused(node)
        if isinstance(node, ast.Attribute):
            module = self._static(node.value)
            assert isinstance(module, ModuleType)
            return self._known.constant(module.__name__, node.attr, static)
        assert isinstance(node, ast.Name)
        return self._known.constant(self._source.__module__, node.id, static)

    def _part(self, node: ast.Subscript) -> Value:
        """A row of rows; what is one per hypothesis is itself."""
        of, at = self._value(node.value), node.slice
        if of.kind == ROWS:
            row = at.elts[0] if isinstance(at, ast.Tuple) else at
            return Value(f"{of.text}[{self._value(row).text}]", NUMBER)
        if isinstance(of.kind, tuple) and isinstance(at, ast.Constant):
            assert isinstance(at.value, int)
            return Value(f"{of.text}.a{at.value}", of.kind[at.value])
        if self._value(at).kind != INDEX:
            raise self._refused(node)
        known = {LANE: Value(f"{of.text}[0]", NUMBER), TABLES: Value(of.text, ROWS)}
        return known.get(of.kind, of)

    def _binary(self, node: ast.BinOp) -> Value:
        left, right = self._value(node.left), self._value(node.right)
        if isinstance(node.op, ast.Pow):
            if isinstance(node.right, ast.Constant) and node.right.value == 2:
                return Value(f"{left.inside(4)} * {left.inside(4)}", left.kind, 3)
            return Value(f"pow({left.text}, {right.text})", NUMBER)
        if type(node.op) not in _BINARY:
            raise self._refused(node)
        sign, binds = _BINARY[type(node.op)]
        if binds == 0:
            return Value(f"{left.inside(ATOM)} {sign} {right.inside(ATOM)}", WHOLE, 0)
        kind = NUMBER if sign == "/" else joined(left.kind, right.kind)
        first = (
            f"(double){left.inside(4)}"
            if sign == "/" and left.kind == WHOLE
            else left.inside(binds)
        )
        return Value(f"{first} {sign} {right.inside(binds + 1)}", kind, binds)

    def _call(self, node: ast.Call) -> Value:
        match node.func:
            case ast.Attribute(value=of, attr="copy" | "any") if self._static(of) is None:
                return self._value(of)  # of one value: itself
        static = self._static(node.func)
        if static is np.where:
            return self._choice(*node.args)
        values = [self._value(one) for one in node.args]
        if static is min or static is max:
            return self._extreme("lesser" if static is min else "greater", values)
        if static in _CALLED:
            form, kind = _CALLED[static]
            return Value(form.format(values[0].text), kind)
        if isinstance(static, type) and hasattr(static, "_fields"):
            text = ", ".join(one.text for one in values)
            return Value(f"({self._known.type_of(static)}){{{text}}}", static)
        if not inspect.isfunction(getattr(static, "py_func", static)):
            raise self._refused(node)
        called = self._program.function(static, *(one.kind for one in values))
        kept = [one.text for one in values if one.kind != INDEX]
        return Value(f"{called.name}({', '.join(kept)})", called.returns)

    def _extreme(self, name: str, values: list[Value]) -> Value:
        """The least or greatest of several, from the left as in Python."""
        text, kind = values[0].text, values[0].kind
        for one in values[1:]:
            text, kind = f"{name}({text}, {one.text})", joined(kind, one.kind)
        return Value(f"(int){text}" if kind == WHOLE else text, kind)

    def _static(self, node: ast.expr) -> Any:
        """What a name stands for outside the function; None where it is the function's own."""
        if isinstance(node, ast.Attribute):
            of = self._static(node.value)
            return getattr(of, node.attr, None) if isinstance(of, ModuleType) else None
        if not isinstance(node, ast.Name) or node.id in {**self._parameters, **self._locals}:
            return None
        return self._source.__globals__.get(node.id, getattr(builtins, node.id, None))

    def _refused(self, node: ast.AST) -> Untranslatable:
        file, line = (
            inspect.getsourcefile(self._source),
            self._line + getattr(node, "lineno", 1) - 1,
        )
        return Untranslatable(f"{file}:{line}: no translation into C: {ast.unparse(node)}")


def _continues(body: list[ast.stmt]) -> bool:
    return any(isinstance(one, ast.Continue) for line in body for one in ast.walk(line))


def _names(node: ast.AST) -> list[ast.Name]:
    return [one for one in ast.walk(node) if isinstance(one, ast.Name)]
