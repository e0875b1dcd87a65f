"""What one process of a run has calculated, another one takes."""

from pathlib import Path

import once
import pytest


@pytest.mark.parametrize(("is_shared", "calculated"), [(True, [3, 4]), (False, [3, 3, 4])])
def test_what_another_process_has_calculated_is_taken(
    is_shared: bool, calculated: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(once, "_folders", [])
    if is_shared:
        once.share(tmp_path / "shared")
    asked = []

    def doubled(value: int) -> int:
        asked.append(value)
        return 2 * value

    here, there = once.once(doubled), once.once(doubled)  # as two processes have it
    assert [here(3), there(3), here(3), there(4)] == [6, 6, 6, 8]
    assert asked == calculated
