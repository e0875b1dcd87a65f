"""The FMU: what FMPy says of it, and that it is the twin to the last tenth of a pascal."""

import os
import re
import subprocess
import sys
import zipfile
from ctypes import CDLL
from io import BytesIO
from pathlib import Path

import fmpy
import fmus
import numpy as np
import pytest
import rigs
from fmpy import extract, read_model_description
from fmpy.build import build_platform_binary
from fmpy.validation import validate_fmu
from fmus import by_twin, cycles, made, stepped

from twin.exchange.fmu import make_fmu
from twin.exchange.variables import Component, Where
from twin.model import kernel
from twin.model import theta as c
from twin.model.air import GAMMA, R
from twin.model.catalogue import CatalogueEffect, Range
from twin.model.dataset import coefficients
from twin.model.effects import EFFECTS, apply
from twin.signals import MS, SL_MIN

BOUND = 0.1  # Pa
FAULT = {
    "leakage": {"sonic_flow": 2.0},
    "response_delay": {"delay": 7.3},
    "filter_clogging": {"pressure_drop_at_nominal": 40.0},
    "weak_blow_off": {"loss": 30.0},
}
ONLY_MODEL_EXCHANGE = {
    "fmi2EnterEventMode",
    "fmi2NewDiscreteStates",
    "fmi2EnterContinuousTimeMode",
    "fmi2CompletedIntegratorStep",
    "fmi2SetTime",
    "fmi2SetContinuousStates",
    "fmi2GetDerivatives",
    "fmi2GetEventIndicators",
    "fmi2GetContinuousStates",
    "fmi2GetNominalsOfContinuousStates",
}
ALL = [(version, where) for version in (2, 3) for where in ("inside", "outside")]


def parts(fmu: fmus.Fmu) -> dict[str, bytes]:
    with zipfile.ZipFile(BytesIO(fmu.content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.mark.slow
@pytest.mark.needs("cc")
@pytest.mark.parametrize(("version", "where"), ALL)
def test_fmpy_finds_nothing(version: int, where: Where) -> None:
    with fmus.as_file(made("gripper", version, where)) as path:
        assert validate_fmu(path) == []
        assert read_model_description(path).coSimulation.canGetAndSetFMUstate


@pytest.mark.slow
@pytest.mark.needs("cc")
@pytest.mark.parametrize(
    ("name", "version", "fault"),
    [("test_rig", 3, {}), ("test_rig", 2, FAULT), ("gripper", 2, {}), ("gripper", 3, FAULT)],
)
def test_ten_cycles_are_those_of_the_twin(
    name: str, version: int, fault: dict[str, dict[str, float]]
) -> None:
    theta, commands = rigs.theta(name), cycles(name, 10)
    for effect, values in fault.items():
        theta = apply(theta, effect, values)
    given = {f"effect.{e}.{p}": value for e, of in fault.items() for p, value in of.items()}
    off = np.abs(fmus.simulated(made(name, version), commands, given) - by_twin(theta, commands))
    print(f"at most {off.max():.3g} Pa")  # noqa: T201 - for pytest -s
    assert off.max() < BOUND


@pytest.mark.needs("cc")
@pytest.mark.parametrize("effect", EFFECTS.values(), ids=lambda effect: effect.name)
def test_every_effect_acts_as_in_the_twin(effect) -> None:  # type: ignore[no-untyped-def]
    theta, commands = rigs.theta("gripper"), cycles("gripper", 1)
    values = {
        parameter.name: parameter.neutral(theta) + parameter.typical
        for parameter in effect.parameters
    }
    with stepped(made("gripper")) as (one,):
        one.begin(**{f"effect__{effect.name}__{key}": value for key, value in values.items()})
        seen = one.run(commands[:-1])
    faulty = by_twin(apply(theta, effect.name, values), commands)[1:]
    assert np.abs(seen - faulty).max() < BOUND
    assert np.abs(seen - by_twin(theta, commands)[1:]).max() > 10 * BOUND  # it can be seen


@pytest.mark.needs("cc")
def test_an_effect_may_begin_while_time_runs() -> None:
    theta, commands = rigs.theta("gripper"), cycles("gripper", 2)
    values = {"cup_compliance": {"volume_at_full_vacuum": 8.0}, "leakage": {"sonic_flow": 1.0}}
    after, half = theta, len(commands) // 2
    for name, of in values.items():
        after = apply(after, name, of)
    state, control = kernel.at_rest(theta), kernel.Control.anew()
    dt, expected = np.full(len(commands), MS), np.empty(len(commands))
    dt[0] = 0.0
    other = np.empty((2, len(commands)), np.uint8)
    for rows, of in ((slice(0, half + 1), theta), (slice(half + 1, None), after)):
        if of is after:
            kernel.take_over(state, theta, after)
        out = other[0][rows], expected[rows], other[1][rows]
        kernel.run_on(state, control, of, dt[rows], commands[rows], out)
    with stepped(made("gripper")) as (one,):
        one.begin()
        before = one.run(commands[:half])
        one.set(effect__cup_compliance__volume_at_full_vacuum=8.0, effect__leakage__sonic_flow=1.0)
        seen = np.concatenate([before, one.run(commands[half:-1])])
    assert np.abs(seen - expected[1:]).max() < BOUND


@pytest.mark.needs("cc")
def test_what_a_diagnosis_found_is_where_the_effects_start() -> None:
    found = {"filter_clogging": {"pressure_drop_at_nominal": 60.0}, "suction_loss": {"loss": 20.0}}
    data, other = (
        rigs.config("gripper").data.model_copy(update={"effects": effects})
        for effects in (found, dict(reversed(found.items())))
    )
    commands = cycles("gripper", 1)
    with stepped(fmus.of_data(data)) as (one,):
        assert one.get("effect.suction_loss.loss") == 20.0
        one.begin()
        seen = one.run(commands[:-1])
        one.fmu.reset()
        one.time = 0.0
        one.begin(
            effect__filter_clogging__pressure_drop_at_nominal=0.0, effect__suction_loss__loss=0.0
        )
        mended = one.run(commands[:-1])
    expected, turned = (by_twin(coefficients(data_set), commands)[1:] for data_set in (data, other))
    assert np.abs(seen - expected).max() < BOUND
    assert np.abs(expected - turned).max() > 10 * BOUND  # their order matters
    assert np.abs(mended - by_twin(rigs.theta("gripper"), commands)[1:]).max() < BOUND


@pytest.mark.slow
@pytest.mark.needs("cc")
@pytest.mark.parametrize(
    ("mechanism", "values"),
    [
        ("suction_nozzle_on_slowly", {"loss": 40.0, "sets_in": 1.0, "fades": 2.0}),
        ("opening_above", {"sonic_flow": 3.0, "begins": 400.0, "ends_below": 100.0}),
        ("supply_swinging", {"drop": 1.0, "period": 0.7, "shift": 0.1}),
        ("supply_pulsed", {"drop": 1.0, "period": 0.7, "duty": 35.0, "shift": 0.1}),
    ],
)
def test_a_mechanism_of_the_data_set_is_in_the_fmu(
    mechanism: str, values: dict[str, float]
) -> None:
    data = rigs.config("gripper").data.model_copy(update={"effects": {mechanism: values}})
    commands = cycles("gripper", 2)
    with stepped(fmus.of_data(data)) as (one,):
        one.begin()
        seen = one.run(commands[:-1])
    assert np.abs(seen - by_twin(coefficients(data), commands)[1:]).max() < BOUND
    assert np.abs(seen - by_twin(rigs.theta("gripper"), commands)[1:]).max() > 10 * BOUND


def entry(mechanism: str, **ranges: tuple[float, float, float]) -> CatalogueEffect:
    """An effect taken in: low, found and high of each parameter."""
    parameters = {
        name: Range(low=low, found=found, high=high) for name, (low, found, high) in ranges.items()
    }
    sentence = f"What somebody saw: {mechanism}"
    return CatalogueEffect(mechanism=mechanism, sentence=sentence, parameters=parameters)


LIP = entry(
    "opening_above",
    sonic_flow=(0.0, 3.0, 60.0),
    begins=(100.0, 400.0, 900.0),
    ends_below=(1.0, 100.0, 400.0),
)
ICE = entry(
    "nozzle_nozzle_on_slowly",
    loss=(0.0, 30.0, 90.0),
    end_pressure_rise=(0.0, 10.0, 600.0),
    sets_in=(0.1, 1.0, 60.0),
    fades=(0.1, 2.0, 60.0),
)
CUP = entry("volume_beyond", volume_at_full_vacuum=(0.0, 5.0, 90.0), begins=(20.0, 200.0, 900.0))
BENT = entry(
    "line_beyond_slowly",
    pressure_drop_at_nominal=(-100.0, 50.0, 400.0),
    begins=(20.0, 200.0, 900.0),
    sets_in=(0.1, 0.5, 60.0),
)
SWING = entry(
    "supply_swinging", drop=(-2.0, 0.7, 2.0), period=(0.3, 1.7, 9.0), shift=(0.0, 0.3, 120.0)
)
PULSE = entry(
    "supply_pulsed",
    drop=(-2.0, 0.7, 2.0),
    period=(0.3, 1.7, 9.0),
    duty=(2.0, 40.0, 98.0),
    shift=(0.0, 0.3, 120.0),
)


@pytest.mark.needs("cc")
@pytest.mark.parametrize(
    ("taken_in", "values"),
    [
        (LIP, {"sonic_flow": 4.0, "begins": 350.0}),
        pytest.param(
            ICE, {"loss": 40.0, "end_pressure_rise": 30.0, "fades": 3.0}, marks=pytest.mark.slow
        ),
        (CUP, {"volume_at_full_vacuum": 80.0}),  # more than the cup has: both limit it
        pytest.param(BENT, {"pressure_drop_at_nominal": 200.0}, marks=pytest.mark.slow),
        pytest.param(SWING, {"drop": 0.9}, marks=pytest.mark.slow),
        pytest.param(PULSE, {"drop": 0.9, "duty": 60.0}, marks=pytest.mark.slow),
    ],
    ids=lambda of: of.mechanism if isinstance(of, CatalogueEffect) else "",
)
def test_an_effect_of_the_catalogue_acts_as_in_the_twin(
    taken_in: CatalogueEffect, values: dict[str, float]
) -> None:
    data = rigs.config("gripper").data.model_copy(
        update={"catalogue": {"seen_before": taken_in}, "effects": {"suction_loss": {"loss": 9.0}}}
    )
    commands, sizes = cycles("gripper", 2), taken_in.acts_as.place.parameters
    found = {name: bounds.found for name, bounds in taken_in.parameters.items()}
    expected = apply(coefficients(data), taken_in.mechanism, {**found, **values})
    with stepped(fmus.of_data(data)) as (one,):
        assert all(one.get(f"effect.seen_before.{size.name}") == 0.0 for size in sizes)
        one.begin()
        healthy = one.run(commands[:-1])
        one.fmu.reset()
        one.time = 0.0
        one.begin(**{f"effect__seen_before__{name}": value for name, value in values.items()})
        seen = one.run(commands[:-1])
    assert np.abs(healthy - by_twin(coefficients(data), commands)[1:]).max() < BOUND
    assert np.abs(seen - by_twin(expected, commands)[1:]).max() < BOUND
    assert np.abs(seen - healthy).max() > 10 * BOUND


@pytest.mark.needs("cc")
def test_what_was_found_of_an_effect_of_the_catalogue_is_where_that_starts() -> None:
    """It is stored as the mechanism that it is, and acts in the data set's order."""
    found = {"loss": 30.0, "end_pressure_rise": 5.0, "sets_in": 0.5, "fades": 2.0}
    effects = {ICE.mechanism: found, "suction_loss": {"loss": 20.0}, "opening_above": {
        "sonic_flow": 1.0, "begins": 50.0, "ends_below": 10.0}}  # fmt: skip
    data = rigs.config("gripper").data.model_copy(
        update={"effects": effects, "catalogue": {"lip": LIP, "ice": ICE}}
    )
    commands = cycles("gripper", 1)
    component = Component.of(data, "inside")
    assert (list(component.slots), component.left_out) == (["ice"], ("lip",))  # out of its bounds
    with stepped(fmus.of_data(data)) as (one,):
        assert one.get("effect.ice.loss") == 30.0
        one.begin()
        seen = one.run(commands[:-1])
        one.fmu.reset()
        one.time = 0.0
        one.begin(effect__ice__loss=0.0, effect__ice__end_pressure_rise=0.0)
        mended = one.run(commands[:-1])
    without = data.model_copy(update={"effects": dict(list(effects.items())[1:])})
    for values, of in ((seen, data), (mended, without)):
        assert np.abs(values - by_twin(coefficients(of), commands)[1:]).max() < BOUND


def test_an_effect_of_the_catalogue_without_a_slot_is_left_out_and_that_is_said() -> None:
    gripper = rigs.config("gripper").data
    effects = {"sensor_warming_up": {"offset": 5.0, "sets_in": 10.0}}
    data = gripper.model_copy(
        update={"effects": effects, "catalogue": {"cup": CUP, "lip": LIP, "ice": ICE}}
    )
    fmu = make_fmu(Component.of(data, "inside"), "cell 1", "a test", "tests", 3, compiled=False)
    texts = {name: content.decode() for name, content in parts(fmu).items()}
    described = texts["modelDescription.xml"]
    assert "effect.cup.begins" in described
    assert "effect.lip" not in described
    assert "left out of the catalogue: lip, ice (no more than 2 mechanisms" in described
    assert "Left out of the catalogue: lip, ice (no more" in texts["documentation/index.html"]
    outside = Component.of(data, "outside")  # the cup is somebody else's
    assert (list(outside.slots), outside.left_out) == (["lip"], ("ice",))
    assert Component.of(gripper, "inside").remark == ""


@pytest.mark.needs("cc")
def test_steps_may_be_of_any_length() -> None:
    commands = cycles("gripper", 1)  # all edges at 50 ms
    with stepped(made("gripper"), 3) as (fine, coarse, odd):
        for instance in (fine, coarse, odd):
            instance.begin()
        each = fine.run(commands)
        assert (coarse.run(commands, 50) == each[49::50]).all()
        uneven = []
        for told in commands[::50]:
            odd.set(command__suction=bool(told & 1), command__blow_off=bool(told & 2))
            for step in (0.0004, 0.0107, 0.0389):
                odd.step(step)
            uneven.append(odd.get("sensor.pressure"))
        off = np.abs(np.array(uneven) - each[49::50])
        assert off.max() < 1.0  # the control has decided at other times, too


@pytest.mark.needs("cc")
@pytest.mark.parametrize("version", [2, 3])
def test_a_state_is_saved_and_restored_to_the_last_bit(version: int) -> None:
    commands = cycles("gripper", 2)
    with stepped(made("gripper", version), 2) as (one, other):
        one.begin(effect__leakage__sonic_flow=1.0)
        other.begin()
        one.run(commands[:500])
        saved = one.saved()
        first = one.run(commands[500:2500])
        for instance in (one, other):
            instance.restore(saved, 500 * MS)
        again, elsewhere = one.run(commands[500:2500]), other.run(commands[500:2500])
    assert (again == first).all()
    assert (elsewhere == first).all()


@pytest.mark.needs("cc")
def test_instances_do_not_disturb_each_other() -> None:
    commands = cycles("gripper", 1)
    with stepped(made("gripper"), 3) as (alone, one, other):
        for instance in (alone, one):
            instance.begin()
        other.begin(effect__suction_loss__loss=30.0)
        undisturbed, turns = alone.run(commands), []
        for row in range(len(commands)):
            turns.append(one.run(commands[row : row + 1])[0])
            other.run(commands[-row - 1 :][:1])
    assert (np.array(turns) == undisturbed).all()


@pytest.mark.needs("cc")
def test_gas_from_elsewhere_comes_in_at_the_port() -> None:
    theta, commands = rigs.theta("test_rig"), cycles("test_rig", 1)
    theta[c.INFLOW] = 5.0 * SL_MIN
    with stepped(made("test_rig")) as (one,):
        one.begin(vessel__inflow=5.0 * SL_MIN)
        seen = one.run(commands[:-1])
    assert np.abs(seen - by_twin(theta, commands)[1:]).max() < BOUND
    assert np.abs(seen - by_twin(rigs.theta("test_rig"), commands)[1:]).max() > 1e3


@pytest.mark.needs("cc")
def test_a_vessel_outside_closes_the_open_port() -> None:
    """Mass and energy of a tank by explicit steps of 1 ms: about the twin's own curve."""
    theta, commands = rigs.theta("test_rig"), cycles("test_rig", 1)
    volume, film = theta[c.VOLUME], theta[c.FILM] * theta[c.AREA]
    pressure, wall = theta[c.AMBIENT], theta[c.TEMPERATURE]
    mass, seen = pressure * volume / (R * wall), []
    with stepped(made("test_rig", 3, "outside")) as (one,):
        one.begin()
        for told in commands[:-1]:
            warm = pressure * volume / (R * mass)
            one.set(command__suction=bool(told & 1), command__blow_off=bool(told & 2))
            one.set(vessel__pressure=pressure, vessel__temperature=warm)
            one.step(MS)
            flow = one.get("vessel.mass_flow")
            carried = warm if flow > 0.0 else one.get("line.temperature")
            gain = (GAMMA - 1.0) * film * (wall - warm) - GAMMA * R * flow * carried
            pressure, mass = pressure + gain * MS / volume, mass - flow * MS
            seen.append(one.get("sensor.pressure"))
    off = np.abs(np.array(seen) - by_twin(theta, commands)[1:])
    print(f"at most {off.max():.3g} Pa")  # noqa: T201 - for pytest -s
    assert off.max() < 500.0
    assert np.sqrt((off**2).mean()) < 100.0


@pytest.mark.needs("cc")
@pytest.mark.parametrize("version", [2, 3])
def test_what_cannot_be_is_refused_in_words(version: int) -> None:
    with stepped(made("gripper", version)) as (one,):
        with pytest.raises(Exception, match="rror"):
            one.set(effect__leakage__sonic_flow=61.0)
        one.begin()
        with pytest.raises(Exception, match="rror"):
            one.set(coefficient__suction=1e-3)
        with pytest.raises(Exception, match="rror"):
            one.set(sensor__pressure=1e5)
        with pytest.raises(Exception, match="rror"):
            one.set(ambient__pressure=float("nan"))
        with pytest.raises(Exception, match="rror"):
            one.step(-1.0)
    assert re.search(r"leakage.sonic_flow = 61 is out of bounds: between 0 and 60", one.said[0])
    assert "coefficient.suction cannot be set once time runs" in one.said[1]
    assert "sensor.pressure cannot be set from outside" in one.said[2]
    assert "ambient.pressure = nan" in one.said[3]
    assert "time ahead" in one.said[4]


@pytest.mark.needs("cc")
def test_a_state_of_another_fmu_is_refused() -> None:
    with stepped(made("gripper")) as (one,), stepped(made("test_rig")) as (other,):
        one.begin()
        other.begin()
        with pytest.raises(Exception, match="rror"):
            other.restore(one.saved(), 0.0)
    assert other.said == ["the state is not one of this FMU"]


@pytest.mark.needs("cc")
@pytest.mark.parametrize(("version", "where"), ALL)
def test_sources_compile_without_a_warning(version: int, where: Where, tmp_path: Path) -> None:
    catalogue = {"lip": LIP, "ice": ICE}
    data = rigs.config("gripper").data.model_copy(update={"catalogue": catalogue})
    for name, content in parts(fmus.of_data(data, version, where)).items():
        if name.startswith("sources/"):
            (tmp_path / Path(name).name).write_bytes(content)
    command = ["cc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-O1", "-c", f"fmi{version}.c"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def own_and_official(version: int, folder: Path) -> tuple[str, str, str]:
    """Our header, and what includes the standard's own, which FMPy carries; the sources beside."""
    for name, content in parts(made("gripper", version)).items():
        if name.startswith("sources/"):
            (folder / Path(name).name).write_bytes(content)
    official = Path(fmpy.__file__).parent / "c-code" / f"fmi{version}Functions.h"
    export = (
        f"#define API(type, name) FMI{version}_Export type name\n#define FULL_NAME(name) name\n"
    )
    header = f"fmi{version}.h"
    return header, (folder / header).read_text(), f'#include "{official}"\n{export}'


@pytest.mark.needs("cc")
@pytest.mark.parametrize("version", [2, 3])
def test_every_function_is_as_the_standard_declares_it(version: int, tmp_path: Path) -> None:
    header, _, official = own_and_official(version, tmp_path)
    (tmp_path / header).write_text(official)
    command = ["cc", "-std=c99", "-Wall", "-Werror", "-shared", "-fPIC", "-o", "a.so"]
    linked = [*command, f"fmi{version}.c", "-Wl,--no-undefined", "-lm"]
    done = subprocess.run(linked, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    declared = set(re.findall(rf"\bfmi{version}FullName\((fmi{version}\w+)\)", _included(official)))
    library = CDLL(str(tmp_path / "a.so"))
    model_exchange = set() if version == 3 else ONLY_MODEL_EXCHANGE
    assert {name for name in declared if not hasattr(library, name)} == model_exchange


def _included(text: str) -> str:
    found = re.search(r'"(.*)"', text)
    assert found
    return Path(found[1]).read_text()


@pytest.mark.needs("cc")
@pytest.mark.parametrize("version", [2, 3])
def test_types_and_numbers_are_those_of_the_standard(version: int, tmp_path: Path) -> None:
    header, own, official = own_and_official(version, tmp_path)
    plain = re.sub(r"/\*.*?\*/", "", own, flags=re.DOTALL)
    types = set(re.findall(rf"\b(fmi{version}\w+)\)?[;(]", plain)) - {"fmi2CallbackFunctions"}
    types = {name for name in types if re.search(rf"typedef[^;]*\b{name}\b", plain)}
    values = {
        name
        for body in re.findall(r"enum \{(.*?)\}", plain, re.DOTALL)
        for name in re.findall(r"\w+", body)
    }
    assert len(types) > 10 < len(values)
    lines = [f'printf("{name} %d\\n", (int)sizeof({name}));' for name in sorted(types)]
    lines += [f'printf("{name} %d\\n", (int)({name}));' for name in sorted(values)]
    lines += [f"printf(fmi{version}Version);"]
    if version == 2:
        field = "(int)offsetof(fmi2CallbackFunctions, componentEnvironment)"
        lines += ["printf(fmi2TypesPlatform);", f'printf("%d\\n", {field});']
    body = "\n".join(lines)
    said = []
    for text in (own, official):
        (tmp_path / header).write_text(text)
        main = f'#include <stddef.h>\n#include <stdio.h>\n#include "{header}"\nint main(void) {{\n'
        (tmp_path / "main.c").write_text(f"{main}{body}\nreturn 0;\n}}\n")
        command = ["cc", "-std=c99", "-Wno-format-security", "-o", "main", "main.c"]
        subprocess.run(command, cwd=tmp_path, check=True)
        said.append(
            subprocess.run(["./main"], cwd=tmp_path, check=True, capture_output=True).stdout
        )
    assert said[0] == said[1]


@pytest.mark.needs("cc")
@pytest.mark.parametrize("version", [2, 3])
def test_a_prefix_lets_several_be_linked_together(version: int, tmp_path: Path) -> None:
    own_and_official(version, tmp_path)
    prefixed = f"-DFMI{version}_FUNCTION_PREFIX=cell_"
    command = [
        "cc",
        "-std=c99",
        prefixed,
        "-shared",
        "-fPIC",
        "-o",
        "a.so",
        f"fmi{version}.c",
        "-lm",
    ]
    subprocess.run(command, cwd=tmp_path, check=True)
    library = CDLL(str(tmp_path / "a.so"))
    assert hasattr(library, f"cell_fmi{version}DoStep")
    assert not hasattr(library, f"fmi{version}DoStep")


@pytest.mark.needs("cc", "c++")
def test_another_tool_compiles_the_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")  # CMake's
    component = Component.of(rigs.config("gripper").data, "inside")
    bare = make_fmu(component, "cell 1", "a test", "tests", 3, compiled=False)
    assert bare.binary == ""
    with fmus.as_file(bare) as path:
        extract(path, tmp_path / "fmu")
    (tmp_path / "build").mkdir()
    build_platform_binary(tmp_path / "fmu", tmp_path / "build", all_warnings=True)
    one = fmus.Stepped(str(tmp_path / "fmu"), str(tmp_path / "fmu"))
    one.begin()
    commands = cycles("gripper", 1)[:400]
    seen = one.run(commands[:-1])
    one.fmu.freeInstance()
    assert np.abs(seen - by_twin(rigs.theta("gripper"), commands)[1:]).max() < BOUND


def test_without_a_compiler_there_are_sources_alone() -> None:
    component = Component.of(rigs.config("gripper").data, "inside")
    bare = make_fmu(component, "cell 1", "a test", "tests", 3, compiled=True)
    assert bare.binary == ""
    assert not [name for name in parts(bare) if name.startswith("binaries/")]
    with fmus.as_file(bare) as path:
        assert validate_fmu(path) == []


@pytest.mark.needs("cc")
def test_the_same_data_give_the_same_file_and_no_python_is_in_it() -> None:
    once, twice = made("gripper"), fmus.of_data(rigs.config("gripper").data)
    assert once.content == twice.content
    assert b"libpython" not in parts(once)[once.binary]
    assert made("test_rig").content != once.content
