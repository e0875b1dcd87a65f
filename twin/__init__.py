"""A live digital twin of pneumatic vacuum ejectors.

For notebooks: ``open`` a log, ``simulate``, ``commission``, ``calibrate``, ``diagnose``. They are
loaded at their first use, so ``import twin`` costs nothing.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from twin.api import (
        Answer,
        Calibrated,
        Columns,
        Commissioned,
        Compared,
        Log,
        TwinError,
        calibrate,
        commission,
        diagnose,
        open,  # noqa: A004
        simulate,
    )

__all__ = [
    "Answer",
    "Calibrated",
    "Columns",
    "Commissioned",
    "Compared",
    "Log",
    "TwinError",
    "calibrate",
    "commission",
    "diagnose",
    "open",
    "simulate",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from twin.extras import require  # noqa: PLC0415  (with its first use)

    require("notebook", f"twin.{name}")
    from twin import api  # noqa: PLC0415  (as above)

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
