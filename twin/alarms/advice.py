"""Advice for an alarm: what to do, beginning with where to look.

The sentences are those of the rules (``default_rules.toml``) and of the table of effects.
"""

from twin.alarms.causes import cause_of
from twin.alarms.rules import Rule
from twin.alarms.watch import Evidence
from twin.languages.texts import tr
from twin.model.effects import EFFECTS

COMMISSION = "Commission the unit (twin commission): then causes are named."


def action_of(rule: Rule, evidence: Evidence) -> str:
    """What to do, beginning with where to look; a unit must be commissioned before all else."""
    if evidence.get("commissioned") is False:
        return tr(COMMISSION)
    cause, catalogued = cause_of(rule.value), evidence.get("taken_in")
    if cause not in EFFECTS and not catalogued:
        return tr(rule.action)
    location = catalogued["look_at"] if catalogued else tr(EFFECTS[cause].look_at)
    look = tr("Look at {where}.", where=location)
    return f"{look} {tr(rule.action)}".rstrip()
