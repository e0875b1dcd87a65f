"""The first answer while the loop runs: few rows drawn, and the same said of them."""

import numpy as np
import pytest
import rigs

from twin.model import kernel
from twin.model.effects import EFFECTS, UNKNOWN
from twin.model.theta import Theta
from twin.monitor import naming
from twin.monitor.naming import likenesses
from twin.monitor.rows import drawn_rows, time_steps
from twin.quality import Quality
from twin.signals import Samples, Ticks

BEGIN = 3600  # rows that let the models swing in


def beside(name: str, fault: str) -> tuple[Theta, Samples, Ticks]:
    """Three cycles with something wrong, a gap in the last one."""
    samples, _ = rigs.recorded(name, 10.0, (fault,))
    kept = np.delete(samples, slice(7000, 7030))
    kept["quality"][7000] = Quality.GAP
    samples, ticks = rigs.expectation(rigs.twin(name), rigs.cut(kept, 1000))
    return rigs.theta(name), samples, ticks


@pytest.mark.slow
@pytest.mark.parametrize("name", rigs.NAMES)
@pytest.mark.parametrize("fault", ["leakage=2.0", "response_delay=20.0"])
def test_few_rows_say_what_all_of_them_do(
    name: str, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    theta, samples, ticks = beside(name, fault)
    assert len(drawn_rows(samples, ticks)) < 0.3 * len(samples)
    healthy = rigs.config(name).monitor.healthy
    few = {
        likeness.effect: likeness for likeness in likenesses(theta, healthy, samples, ticks, BEGIN)
    }
    monkeypatch.setattr(naming, "drawn_rows", lambda samples, _: np.arange(len(samples)))
    monkeypatch.setattr(kernel, "COARSE_TOLERANCE", kernel.TOLERANCE)
    every = {
        likeness.effect: likeness for likeness in likenesses(theta, healthy, samples, ticks, BEGIN)
    }
    assert few.keys() == every.keys() == {*EFFECTS, UNKNOWN}
    for effect, likeness in every.items():
        assert few[effect].share == pytest.approx(likeness.share, abs=0.01)
        if likeness.share > 0.1 and effect != UNKNOWN:
            assert few[effect].size == pytest.approx(likeness.size, rel=0.02)


def test_time_that_stands_still_or_jumps_is_drawn() -> None:
    _, samples, ticks = beside("test_rig", "leakage=2.0")
    dt = time_steps(samples, None)
    odd = np.flatnonzero((dt < 0.0005) | (dt > 0.0015))
    assert len(odd)
    assert np.isin(odd, drawn_rows(samples, ticks)).all()


@pytest.mark.parametrize("fault", ["weak_blow_off=85.0", "blow_off_delay=250.0"])
def test_a_blow_off_that_hardly_acts_is_not_weather(fault: str) -> None:
    # Cups that stay on the part leave the idle pressure low, by more than any weather.
    theta, samples, ticks = beside("gripper", fault)
    healthy = rigs.config("gripper").monitor.healthy
    first = likenesses(theta, healthy, samples, ticks, BEGIN)[:1]
    assert [cause.effect for cause in first] != ["ambient_pressure"]
