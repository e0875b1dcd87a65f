"""The C sources of an FMU: the physics translated from the model, and tables of its variables.

``model.h`` is generated; ``component.h`` and the functions of the standard are templates.
"""

from collections.abc import Mapping
from importlib.resources import files
from uuid import NAMESPACE_URL, uuid5

from twin.exchange.c_expressions import INDEX, LANE, NUMBER, ROWS, TABLES, WHOLE, literal
from twin.exchange.translate import Program
from twin.exchange.variables import Component, InSlot, Role, Variable, reference
from twin.model import control, kernel, mechanism, plant
from twin.model import theta as c
from twin.model.control import new_timer, nothing_done
from twin.model.effects import Effect

# What component.h calls, with the kinds of the arguments.
_CALLED = (
    (plant.prepare_one, ROWS, INDEX),
    (kernel._reset_to_ambient, ROWS, ROWS),
    (control.effective_command, ROWS, WHOLE, NUMBER, NUMBER, NUMBER),
    (kernel._run_controls, ROWS, TABLES, LANE, NUMBER, ROWS, LANE),
    (kernel._step, ROWS, ROWS, NUMBER, NUMBER),
    (kernel._read_sensors, ROWS, ROWS, LANE, LANE),
    (kernel.take_over, ROWS, ROWS, ROWS),
    (kernel._remove_mechanisms, ROWS, INDEX),
    (kernel._advance_mechanisms, ROWS, ROWS, NUMBER),
)
# And the numbers it reads.
_READ = (
    (plant, "PREPARED", "R"),
    (kernel, "STATE", "TOLERANCE", "PORT", "LINE", "LINE_MASS", "VESSEL", "VESSEL_MASS", "FAR"),
    (kernel, "PHASE", "_PART_PRESENT", "_AIR_SAVING"),
    (control, "CONTROL", "_SUCTION", "_BLOW_OFF"),
    (c, "LINE_VOLUME", "VOLUME", "BLOW_OFF_MODE", "BLOW_OFF_TIME"),
)
HEAD = """\
/* Generated from the digital twin's own model, function by function: the same equations. */

#include <math.h>
"""
_SETTABLE = {Role.DATA: "BEFORE", Role.OUTPUT: "NEVER", Role.SIGNAL: "NEVER"}


def sources(component: Component, version: int) -> tuple[Mapping[str, str], str]:
    """The files in ``sources/`` by name, and the token that ties binary and description together.

    The token depends only on the content: the same component and model give the same FMU.
    """
    model, templates = _model(component), files("twin.exchange") / "templates"
    token = str(uuid5(NAMESPACE_URL, f"ejector-twin FMI {version}\n{model}"))
    defines = f'#define TOKEN "{token}"\n#define STAMP {int(token[:8], 16)}.0\n'
    texts = {"model.h": f"{HEAD}\n{defines}{model}"}
    for name in ("component.h", "export.h", f"fmi{version}.h", main_source(version)):
        texts[name] = (templates / name).read_text(encoding="utf-8")
    return texts, token


def main_source(version: int) -> str:
    """The one file to compile; it includes the others."""
    return f"fmi{version}.c"


def _model(component: Component) -> str:
    program = Program()
    for source, *kinds in _CALLED:
        program.function(source, *kinds)
    acts = [line for effect in component.effects for line in _acts(program, component, effect)]
    for module, *names in _READ:
        for name in names:
            program.declarations.constant(module.__name__, name, getattr(module, name))
    for number, name in enumerate(c.COEFFICIENTS):
        program.declarations.constant(c.__name__, name, number)
    assignments = [
        f"    theta[THETA_{name}] = {component.sources[name]};" for name in c.COEFFICIENTS
    ]
    return "\n".join(
        [
            f"#define VESSEL_OUTSIDE {int(component.where == 'outside')}",
            f"#define CONTROL_TIMER {len(new_timer())}",
            "",
            program.text(),
            _at_rest(),
            "",
            _variables(component),
            "",
            "/* Coefficients from values; effects act on them as they do in the twin. */",
            "static void coefficients(const double *v, double *theta) {",
            *assignments,
            *acts,
            "}",
            "",
        ]
    )


def _acts(program: Program, component: Component, effect: Effect) -> list[str]:
    """The statements by which an effect acts on the coefficients."""
    values = {
        parameter.name: f"v[{reference(f'effect.{effect.name}.{parameter.name}')}]"
        for parameter in effect.parameters
    }
    if effect.name in component.slots:
        return _in_slot(program, component.slots[effect.name], values)
    function = program.function(effect.act, ROWS, *[NUMBER] * len(values)).name
    return [f"    {function}({', '.join(['theta', *values.values()])});"]


def _in_slot(program: Program, slot: InSlot, values: Mapping[str, str]) -> list[str]:
    """The same of a mechanism: what ``Mechanism`` does, by the same functions."""
    acting, first = slot.mechanism, slot.first
    place = acting.place
    sizes = zip(place.coefficients, place.si, place.parameters, strict=True)
    lines = []
    for where, (coefficient, si, parameter) in zip(
        (mechanism.ON, mechanism.ALSO_ON), sizes, strict=False
    ):
        in_si = program.function(si, ROWS, NUMBER).name
        limit = program.function(mechanism.limit_of(coefficient), ROWS, WHOLE, NUMBER).name
        added = f"{in_si}(theta, {values[parameter.name]})"
        lines += [
            f"    theta[{first + where}] = {coefficient}.0;",
            f"    theta[{first + where + 1}] = {limit}(theta, {coefficient}, {added});",
        ]
    lines.append(f"    theta[{first + mechanism.WHEN}] = {acting.when.code}.0;")
    for set_values, given in (
        (mechanism.set_condition, acting.condition(values, "0.0")),
        (mechanism.set_rhythm, acting.rhythm(values, "0.0")),
    ):
        function = program.function(set_values, ROWS, WHOLE, *[NUMBER] * len(given)).name
        lines.append(f"    {function}(theta, {first}, {', '.join(given)});")
    return lines


def _at_rest() -> str:
    values = ", ".join(literal(float(value)) for value in nothing_done())
    return f"static const double NOTHING_DONE[] = {{{values}}};"


def _variables(component: Component) -> str:
    """References by name and the table of variables; time comes last."""
    names = [variable.reference for variable in component.variables]
    rows = [_row(variable) for variable in component.variables]
    return "\n".join(
        [
            "enum { REAL, TRUTH, CHOICE };",
            "enum { NEVER, BEFORE, ALWAYS };",
            f"enum {{ {', '.join([*names, 'V_TIME', 'VARIABLES'])} }};",
            "",
            "struct Variable {",
            "    const char *name;",
            "    int kind;",
            "    int settable;",
            "    double low;",
            "    double high;",
            "    double start;",
            "};",
            "",
            "static const struct Variable VARIABLE[] = {",
            *rows,
            '    {"time", REAL, NEVER, -INFINITY, INFINITY, 0.0},',
            "};",
        ]
    )


def _row(variable: Variable) -> str:
    kind = "TRUTH" if variable.truth else "CHOICE" if variable.choices else "REAL"
    numbers = ", ".join(
        literal(float(value)) for value in (variable.low, variable.high, variable.start)
    )
    return (
        f'    {{"{variable.name}", {kind}, {_SETTABLE.get(variable.role, "ALWAYS")}, {numbers}}},'
    )
