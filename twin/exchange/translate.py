"""Translates compiled functions of the model into C, so that the physics has one source.

The translated part of Python is what the model uses: numbers, rows of numbers, named tuples,
tuples, ``if``, and loops over ranges and literal tuples. The C code has one hypothesis: loops over
hypotheses run once, and the index of a hypothesis is dropped. Functions are specialised by the
kinds of their arguments, as Numba does. Anything else is rejected with file and line.
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

from twin.exchange.c_expressions import (
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

# Needed by every translated program: Python's min and max, and conversion without overflow.
PRELUDE = """\
static double lesser(double a, double b) { return b < a ? b : a; }
static double greater(double a, double b) { return b > a ? b : a; }
static int to_whole(double x) { return x > -1e9 ? (x < 1e9 ? (int)x : 1000000000) : -1000000000; }
"""

# Functions of Python and NumPy that take one value.
_CALLED: Mapping[object, tuple[str, Kind]] = {
    math.sqrt: ("sqrt({})", NUMBER),
    math.sin: ("sin({})", NUMBER),
    math.ceil: ("to_whole(ceil({}))", WHOLE),
    math.floor: ("to_whole(floor({}))", WHOLE),
    math.isnan: ("isnan({})", WHOLE),
    np.log: ("log({})", NUMBER),
    np.exp: ("exp({})", NUMBER),
    abs: ("fabs({})", NUMBER),
    float: ("{}", NUMBER),
    int: ("to_whole({})", WHOLE),
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
    """Functions with their declarations, each before its first use."""

    declarations: Declarations = field(default_factory=Declarations)
    _texts: list[str] = field(default_factory=list)
    _functions: dict[tuple[object, tuple[Kind, ...]], Function] = field(default_factory=dict)

    def function(self, source: Callable[..., Any], *kinds: Kind) -> Function:
        """The function for arguments of these kinds; translated at the first call."""
        original = getattr(source, "py_func", source)
        if (original, kinds) not in self._functions:
            name, existing = named(original.__module__, original.__name__), self._functions.values()
            while any(function.name == name for function in existing):
                name += "_again"
            self._functions[original, kinds] = made = Function(name)
            self._texts.append(_Body(self, original, kinds, made).text())
        return self._functions[original, kinds]

    def text(self) -> str:
        """The whole program."""
        return "\n\n".join([self.declarations.text(), PRELUDE, *self._texts]) + "\n"


class _Body:
    """The translation of one function to C."""

    def __init__(
        self, program: Program, source: Callable[..., Any], kinds: tuple[Kind, ...], made: Function
    ) -> None:
        self._program, self._source, self._function = program, source, made
        self._declarations = program.declarations
        lines, self._line = inspect.getsourcelines(source)
        tree = ast.parse(textwrap.dedent("".join(lines))).body[0]
        assert isinstance(tree, ast.FunctionDef)
        self._tree = tree
        names = [argument.arg for argument in tree.args.args]
        self._parameters = dict(zip(names, kinds, strict=True))
        self._locals: dict[str, Kind] = {}
        self._count = 0

    def text(self) -> str:
        """The function in C; passes repeat until the kinds of all its variables are known."""
        docstring = ast.get_docstring(self._tree)
        statements = self._tree.body[1:] if docstring else self._tree.body
        while True:
            previous, self._count = (dict(self._locals), self._function.returns), 0
            body = self._block(statements)
            if previous == (self._locals, self._function.returns):
                break
        parameters = [
            declared(self._declarations.type_of(kind), name)
            for name, kind in self._parameters.items()
            if kind != INDEX
        ]
        returns = self._function.returns
        returned = self._declarations.type_of(returns) if returns else "void"
        header = f"static {declared(returned, self._function.name)}({', '.join(parameters)}) {{"
        local_declarations = [
            f"    {declared(self._declarations.type_of(kind), name)};"
            for name, kind in self._locals.items()
        ]
        used = {name.id for name in _names(self._tree)}
        unused = [  # compilers warn otherwise
            f"    (void){name};"
            for name, kind in self._parameters.items()
            if kind != INDEX and name not in used
        ]
        comment = [f"/* {textwrap.indent(docstring, '   ').strip()} */"] if docstring else []
        return "\n".join([*comment, header, *local_declarations, *unused, *body, "}"])

    # --- statements -----------------------------------------------------------------------------

    def _block(self, statements: list[ast.stmt]) -> list[str]:
        return [f"    {line}" for statement in statements for line in self._statement(statement)]

    def _statement(self, node: ast.stmt) -> list[str]:  # noqa: PLR0911 - a table of statements
        match node:
            case ast.Assign(targets=[ast.Tuple(elts=targets)], value=value):
                return self._unpacked(targets, value)
            case ast.Assign(targets=targets, value=value):
                result = self._value(value)
                return [
                    " = ".join([*(self._target(item, result) for item in targets), result.text])
                    + ";"
                ]
            case ast.AnnAssign(target=target, value=ast.expr() as value):
                result = self._value(value)
                return [f"{self._target(target, result)} = {result.text};"]
            case ast.AugAssign():
                return self._changed(node)
            case ast.If(test=test, body=body, orelse=orelse):
                lines = [f"if ({self._truth(test)}) {{", *self._block(body), "}"]
                return [*lines[:-1], "} else {", *self._block(orelse), "}"] if orelse else lines
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
        """Assign to several targets at once; values that read a target are held meanwhile."""
        if isinstance(value, ast.Tuple):
            parts = [self._value(item) for item in value.elts]
            written = {item.id for target in targets for item in _names(target)}
            if not written & {item.id for item in _names(value)}:
                values, lines = parts, []
            else:
                values = [Value(self._held(part.kind), part.kind) for part in parts]
                pairs = zip(values, parts, strict=True)
                lines = [f"{name.text} = {part.text};" for name, part in pairs]
        else:
            result = self._value(value)
            name = self._held(result.kind)
            values = [Value(f"{name}.a{n}", kind) for n, kind in enumerate(result.kind)]
            lines = [f"{name} = {result.text};"]
        for target, part in zip(targets, values, strict=True):
            if not (isinstance(target, ast.Name) and target.id == "_"):
                lines.append(f"{self._target(target, part)} = {part.text};")
        return lines

    def _changed(self, node: ast.AugAssign) -> list[str]:
        """``x += v`` and the like; several rows at once get the same ``v``."""
        if type(node.op) not in _BINARY:
            raise self._refused(node)
        operand, (sign, _) = self._value(node.value), _BINARY[type(node.op)]
        if isinstance(node.op, ast.Div):
            operand = Value(operand.text, NUMBER)  # so that the target becomes a number as well
        match node.target:
            case ast.Subscript(value=array, slice=ast.List(elts=rows)):
                name = self._held(operand.kind)
                places = [f"{self._value(array).text}[{self._value(row).text}]" for row in rows]
                return [
                    f"{name} = {operand.text};",
                    *(f"{place} {sign}= {name};" for place in places),
                ]
        return [f"{self._target(node.target, operand)} {sign}= {operand.text};"]

    def _loop(self, node: ast.For) -> list[str]:
        match node.iter, node.target:
            case ast.Call(func=ast.Name(id="range"), args=[ast.Subscript()]), ast.Name(id=name):
                self._parameters[name] = INDEX  # a loop over hypotheses, of which there is one
                return ["do {", *self._block(node.body), "} while (0);"]
            case ast.Call(func=ast.Name(id="range"), args=[_] | [_, _] as bounds), ast.Name(
                id=name
            ):
                values = [self._value(part).text for part in bounds]
                start, end = ["0", *values][-2:]
                counter = f"n{self._next()}" if name == "_" else name
                self._local(counter, WHOLE)
                header = f"for ({counter} = {start}; {counter} < {end}; {counter}++) {{"
                return [header, *self._block(node.body), "}"]
            case ast.Tuple(elts=items), target if not _continues(node.body):
                lines = []
                for item in items:  # unrolled
                    assignment: list[ast.stmt] = [ast.Assign([target], item, lineno=node.lineno)]
                    lines += [
                        line for part in assignment + node.body for line in self._statement(part)
                    ]
                return lines
        raise self._refused(node)

    def _returned(self, node: ast.expr) -> str:
        if isinstance(node, ast.Tuple):
            result = self._tuple(
                [self._value(element) for element in node.elts], self._function.returns
            )
        else:
            result = self._value(node)
        self._function.returns = joined(self._function.returns, result.kind)
        return result.text

    def _target(self, node: ast.expr, assigned: Value) -> str:
        if isinstance(node, ast.Name):
            self._local(node.id, assigned.kind)
            return node.id
        return self._value(node).text

    def _local(self, name: str, kind: Kind) -> None:
        if name not in self._parameters:
            self._locals[name] = joined(self._locals.get(name), kind)
        elif joined(self._parameters[name], kind) != self._parameters[name]:
            raise Untranslatable(f"{self._function.name}: {name} changes its kind")

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
            case ast.Attribute(value=container, attr=name):
                return Value(f"{self._value(container).text}.{name}", NUMBER)
            case ast.Subscript():
                return self._part(node)
            case ast.BinOp():
                return self._binary(node)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                negated = self._value(operand)
                return Value(f"-{negated.inside(5)}", negated.kind, 4)
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return Value(f"!({self._truth(operand)})", WHOLE)
            case ast.BoolOp(op=op, values=values):
                sign = " && " if isinstance(op, ast.And) else " || "
                return Value(sign.join(f"({self._truth(part)})" for part in values), WHOLE, 0)
            case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _COMPARED:
                pair = self._value(left).inside(2), self._value(right).inside(2)
                return Value(f"{pair[0]} {_COMPARED[type(op)]} {pair[1]}", WHOLE, 1)
            case ast.IfExp(test=test, body=body, orelse=orelse):
                return self._choice(test, body, orelse)
            case ast.Tuple(elts=parts):
                return self._tuple([self._value(part) for part in parts])
            case ast.Call(keywords=[]):
                return self._call(node)
        raise self._refused(node)

    def _tuple(self, parts: list[Value], expected: Kind = None) -> Value:
        kind = joined(expected, tuple(part.kind for part in parts))
        text = ", ".join(part.text for part in parts)
        return Value(f"({self._declarations.type_of(kind)}){{{text}}}", kind)

    def _truth(self, node: ast.expr) -> str:
        condition = self._value(node)
        return condition.text if condition.kind == WHOLE else f"{condition.inside(2)} != 0.0"

    def _choice(self, test: ast.expr, body: ast.expr, orelse: ast.expr) -> Value:
        first, second = self._value(body), self._value(orelse)
        text = f"({self._truth(test)}) ? {first.inside(1)} : {second.inside(1)}"
        return Value(text, joined(first.kind, second.kind), 0)

    def _constant(self, node: ast.expr, static: object) -> Value:
        """A number of a module, under the name in the module that the source refers to."""
        if not isinstance(static, int | float):
            raise self._refused(node)
        if isinstance(node, ast.Attribute):
            module = self._static(node.value)
            assert isinstance(module, ModuleType)
            return self._declarations.constant(module.__name__, node.attr, static)
        assert isinstance(node, ast.Name)
        return self._declarations.constant(self._source.__module__, node.id, static)

    def _part(self, node: ast.Subscript) -> Value:
        """An element: a row of rows; a value per hypothesis stands for itself."""
        container, index = self._value(node.value), node.slice
        if container.kind == ROWS:
            row = index.elts[0] if isinstance(index, ast.Tuple) else index
            return Value(f"{container.text}[{self._value(row).text}]", NUMBER)
        if isinstance(container.kind, tuple) and isinstance(index, ast.Constant):
            assert isinstance(index.value, int)
            return Value(f"{container.text}.a{index.value}", container.kind[index.value])
        if self._value(index).kind != INDEX:
            raise self._refused(node)
        by_kind: Mapping[object, Value] = {
            LANE: Value(f"{container.text}[0]", NUMBER),
            TABLES: Value(container.text, ROWS),
        }
        return by_kind.get(container.kind, container)

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
        numerator = (
            f"(double){left.inside(4)}"
            if sign == "/" and left.kind == WHOLE
            else left.inside(binds)
        )
        return Value(f"{numerator} {sign} {right.inside(binds + 1)}", kind, binds)

    def _call(self, node: ast.Call) -> Value:
        match node.func:
            case ast.Attribute(value=container, attr="copy" | "any") if (
                self._static(container) is None
            ):
                return self._value(container)  # of one value: the value itself
        static = self._static(node.func)
        if static is np.where:
            return self._choice(*node.args)
        values = [self._value(argument) for argument in node.args]
        if static is min or static is max:
            return self._extreme("lesser" if static is min else "greater", values)
        if static in _CALLED:
            form, kind = _CALLED[static]
            return Value(form.format(values[0].text), kind)
        if isinstance(static, type) and hasattr(static, "_fields"):
            text = ", ".join(argument.text for argument in values)
            return Value(f"({self._declarations.type_of(static)}){{{text}}}", static)
        if not inspect.isfunction(getattr(static, "py_func", static)):
            raise self._refused(node)
        callee = self._program.function(static, *(argument.kind for argument in values))
        passed = [argument.text for argument in values if argument.kind != INDEX]
        return Value(f"{callee.name}({', '.join(passed)})", callee.returns)

    def _extreme(self, name: str, values: list[Value]) -> Value:
        """The least or greatest of several values, from the left as in Python."""
        text, kind = values[0].text, values[0].kind
        for value in values[1:]:
            text, kind = f"{name}({text}, {value.text})", joined(kind, value.kind)
        return Value(f"(int){text}" if kind == WHOLE else text, kind)

    def _static(self, node: ast.expr) -> Any:
        """The object of a name outside the function; None for a name of the function itself."""
        if isinstance(node, ast.Attribute):
            module = self._static(node.value)
            return getattr(module, node.attr, None) if isinstance(module, ModuleType) else None
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
    return any(isinstance(node, ast.Continue) for line in body for node in ast.walk(line))


def _names(node: ast.AST) -> list[ast.Name]:
    return [child for child in ast.walk(node) if isinstance(child, ast.Name)]
