"""What a log says of every effect on its own: the sizes of small ones, as the rig has them."""

import pytest
import rigs

from twin.fleet.watch import watched

CYCLES = 14
SECONDS = {"test_rig": 3.2, "gripper": 2.3}  # of a cycle


def effects(name: str, *faults: str) -> dict[str, dict[str, float]]:
    samples, _ = rigs.recorded(name, CYCLES * SECONDS[name], faults, seed=5)
    found: dict[str, dict[str, float]] = watched(rigs.config(name), [samples])["effects"]
    return found


# A delay of a row or less moves only the edges, and the rows at which switching is seen.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "effect", "size"),
    [
        ("test_rig", "leakage", 0.3),
        ("test_rig", "suction_loss", 3.0),
        ("test_rig", "slow_ramp_up", 0.7),
        ("test_rig", "response_delay", 1.0),
        ("gripper", "slow_ramp_up", 0.7),
        ("gripper", "sensor_offset", 2.0),
        ("gripper", "check_valve_leak", 0.3),
    ],
)
def test_a_small_size_is_seen_as_it_is(name: str, effect: str, size: float) -> None:
    healthy, faulty = effects(name), effects(name, f"{effect}={size}")
    assert faulty[effect]["size"] - healthy[effect]["size"] == pytest.approx(size, rel=0.25)
    assert faulty[effect]["cycles"] >= CYCLES - 3


@pytest.mark.parametrize("name", ["test_rig", "gripper"])
def test_of_a_slow_sensor_most_is_seen(name: str) -> None:
    """Its breakpoints are rounder as well, which no row says; a third is lost."""
    healthy, faulty = effects(name), effects(name, "sensor_lag=1.0")
    shown = faulty["sensor_lag"]["size"] - healthy["sensor_lag"]["size"]
    assert 0.5 < shown < 1.2


def test_key_figures_are_means_over_cycles() -> None:
    samples, _ = rigs.recorded("test_rig", CYCLES * SECONDS["test_rig"], seed=5)
    found = watched(rigs.config("test_rig"), [samples])
    t0 = found["figures"]["t0"]
    assert t0["measured"] == pytest.approx(t0["expected"], rel=0.01)
    assert found["cycles"] >= CYCLES - 3
