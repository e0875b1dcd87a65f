"""What a log's evidence holds beside its cycles."""

from dataclasses import replace

import pytest
import rigs

from twin.diagnosis.evidence import collect
from twin.model import theta as c
from twin.model.dataset import coefficients


def test_a_value_that_is_open_by_more_than_itself_keeps_to_its_bounds() -> None:
    """A sigma less than a flow that hardly shows is no negative one, which has no pressure."""
    config = rigs.config("test_rig")
    relief = config.data.ejector.relief_sl_min
    healthy = config.monitor.healthy.model_copy(
        update={"uncertain": {"ejector.relief_sl_min": (3.0 * relief,)}}
    )
    monitor = config.monitor.model_copy(update={"healthy": healthy})
    samples, _ = rigs.recorded("test_rig", 12.0)
    evidence = collect(replace(config, monitor=monitor), [samples])
    healthy_relief = coefficients(config.data)[c.RELIEF]
    up, down = evidence.uncertain[-1]
    assert up[c.RELIEF] == pytest.approx(4.0 * healthy_relief)
    assert 0.0 < down[c.RELIEF] < healthy_relief
