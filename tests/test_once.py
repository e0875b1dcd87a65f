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


def test_a_result_that_was_written_in_part_is_calculated_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(once, "_folders", [])
    once.share(tmp_path / "shared")

    def a_half(path: Path, content: bytes) -> None:
        with path.open("wb") as file:
            file.write(content[: len(content) // 2])
        raise KeyboardInterrupt

    def tripled(value: int) -> int:
        return 3 * value

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", a_half)
        with pytest.raises(KeyboardInterrupt):
            once.once(tripled)(7)
    assert once.once(tripled)(7) == 21
