"""The settings of the monitor."""

from pydantic import Field

from twin.monitor.healthy import Healthy
from twin.settings import Settings


class MonitorSettings(Settings):
    """When a deviation is an alarm."""

    # Mean time between false alarms of any kind, of a unit.
    false_alarm_days: float = Field(30.0, gt=0.0)
    clear_cycles: int = Field(3, ge=1)  # successive normal cycles that clear the alarm
    smallest_mbar: float = Field(0.5, ge=0.0)  # deviations below are never worth an alarm
    stale_ms: float = Field(500.0, gt=0.0)  # without a new row, after which the PLC is stale
    isolate: bool = True  # step a bank of hypotheses beside the twin, and sum over cycles
    healthy: Healthy = Healthy()
