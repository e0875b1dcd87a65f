"""Old logs make room: which go, which never do, and that each deletion is told."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from log_rows import HEADER, course

from twin.log.check import recover
from twin.log.header import RECORDED
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.log.retention import DAY_S, LEAST_SHARE, Bounds, Disk, File, Retention, outdated

NOW = 1_800_000_000.0
OURS = replace(HEADER, metadata={RECORDED: "twin run"})
UNIT = HEADER.asset_type, HEADER.asset_id
ROOMY = Disk(total=10**12, free=10**12)
SAMPLES, TICKS = course(300)


def files(*sizes: int) -> list[File]:
    """Files of so many bytes, a day apart, the oldest first; the last one is an hour old."""
    ages = range(len(sizes) - 1, -1, -1)
    return [
        File(Path(f"{number}.mcap"), size, NOW - 3600 - age * DAY_S)
        for number, (size, age) in enumerate(zip(sizes, ages, strict=True))
    ]


def named(gone: list[tuple[File, str]]) -> str:
    return "".join(file.path.stem for file, _ in gone)


@pytest.mark.parametrize(
    ("bounds", "disk", "gone", "why"),
    [
        (Bounds(), ROOMY, "", ""),
        (Bounds(days=2.0), ROOMY, "01", "logs are kept for 2 days"),
        (Bounds(bytes=250.0), ROOMY, "01", "logs of this unit may take 2.5e-07 GB"),
        (Bounds(bytes=400.0), ROOMY, "", ""),
        (Bounds(bytes=1.0), ROOMY, "0123", "logs of this unit may take 1e-09 GB"),
        (Bounds(disk_share=0.8), Disk(1000, 200), "", ""),
        (Bounds(disk_share=0.8), Disk(1000, 50), "01", "the disk is more than 80% full"),
        # Others fill the disk: a tenth of it stays with the logs.
        (Bounds(disk_share=0.8), Disk(2000, 0), "01", "the disk is more than 80% full"),
        (Bounds(disk_share=1.0), Disk(1000, 0), "", ""),
    ],
)
def test_the_oldest_go_first_until_all_bounds_hold(
    bounds: Bounds, disk: Disk, gone: str, why: str
) -> None:
    found = outdated(files(100, 100, 100, 100), bounds, disk, NOW)
    assert named(found) == gone
    assert {reason for _, reason in found} == ({why} if why else set())


@given(
    st.lists(st.integers(0, 1000), max_size=8),
    st.floats(0.1, 10.0) | st.none(),
    st.integers(1, 5000) | st.none(),
    st.floats(0.1, 1.0),
    st.integers(0, 5000),
)
def test_what_stays_is_within_bounds_and_nothing_goes_in_vain(
    sizes: list[int], days: float | None, most: int | None, share: float, free: int
) -> None:
    there, disk, bounds = files(*sizes), Disk(10_000, free), Bounds(days, most, share)
    gone = outdated(there, bounds, disk, NOW)
    assert [file for file, _ in gone] == there[: len(gone)]

    def is_within(stays: list[File]) -> bool:
        size = sum(file.size for file in stays)
        used = disk.total - disk.free - sum(file.size for file in there) + size
        return (
            all(days is None or NOW - file.ended_s <= days * DAY_S for file in stays)
            and (most is None or size <= most)
            and (used <= share * disk.total or size <= LEAST_SHARE * disk.total)
        )

    assert is_within(there[len(gone) :])
    assert not gone or not is_within(there[len(gone) - 1 :])


def write(path: Path, age_days: float, header: object = OURS, *, end: bool = True) -> Path:
    """A log, written last so many days ago."""
    recorder = Recorder(path, header)  # type: ignore[arg-type]
    recorder.write(SAMPLES, TICKS)
    if end:
        recorder.close()
    else:
        recorder.write(SAMPLES[:0], TICKS[:0])
        recorder._output.abandon()
    os.utime(path, (NOW - age_days * DAY_S,) * 2)
    return path


class Folder:
    """A folder of logs, and who keeps it within bounds."""

    def __init__(self, path: Path, bounds: Bounds, written: str = "now.mcap") -> None:
        self.path, self.told, self.complaints = path, list[str](), list[str]()
        self.retention = Retention(
            path,
            UNIT,
            bounds,
            lambda: path / written,
            self.told.append,
            self.complaints.append,
            clock=lambda: NOW,
        )

    @property
    def there(self) -> list[str]:
        return sorted(file.name for file in self.path.iterdir())


@pytest.fixture
def many(tmp_path: Path) -> Folder:
    return Folder(tmp_path, Bounds(days=3.0))


def test_only_finished_logs_of_the_unit_that_a_run_wrote_are_deleted(many: Folder) -> None:
    folder = many.path
    write(folder / "old.mcap", 9)
    write(folder / "now.mcap", 9, end=False)  # of a PLC that has been off for long
    write(folder / "young.mcap", 1)
    write(folder / "other.mcap", 9, replace(OURS, asset_id="another"))
    write(folder / "kind.mcap", 9, replace(OURS, asset_type="another"))
    write(folder / "imported.mcap", 9, HEADER)
    write(folder / "read-only.mcap", 9).chmod(0o444)
    write(folder / "crashed.mcap", 9, end=False)
    write(folder / "crashed-now.mcap", 0.5, end=False)
    recover(folder / "old.mcap", folder / "recovered.mcap")
    os.utime(folder / "recovered.mcap", (0.0, 0.0))
    for name in ("text.mcap", "notes.txt"):
        (folder / name).write_text("not a log")
        os.utime(folder / name, (0.0, 0.0))
    (folder / "link.mcap").symlink_to(folder / "old.mcap")
    before = many.there
    many.retention.look()
    assert set(before) - set(many.there) == {"old.mcap", "crashed.mcap"}
    assert [line.split(" (")[0] for line in many.told] == [
        "crashed.mcap is deleted",
        "old.mcap is deleted",
    ]
    assert many.told[1].endswith("): logs are kept for 3 days")
    many.retention.look()
    assert len(many.told) == 2


def test_what_is_left_of_a_log_in_parts_can_be_read(tmp_path: Path) -> None:
    now = iter(range(10_000))
    samples, ticks = course(9000)
    with Recorder(tmp_path / "run.mcap", OURS, 20_000, lambda: next(now)) as recorder:
        for start in range(0, len(samples), 300):
            recorder.write(samples[start : start + 300], ticks[start : start + 300])
    parts = open_log(tmp_path / "run.mcap").parts
    for age, part in enumerate(reversed(parts)):
        os.utime(part, (NOW - age * DAY_S,) * 2)
    folder = Folder(tmp_path, Bounds(bytes=2.5 * parts[0].stat().st_size), written="run.9999.mcap")
    folder.retention.look()
    left = parts[len(folder.told) :]
    assert 1 < len(left) < len(parts)
    assert open_log(left[0]).parts == left


def test_what_cannot_be_deleted_is_told_once(many: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    write(many.path / "old.mcap", 9)

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", "old.mcap")

    looks = iter([False, False, True])
    monkeypatch.setattr(Path, "unlink", refuse)
    monkeypatch.setattr(many.retention._ending, "wait", lambda _: next(looks))
    many.retention._work()
    assert many.complaints == [
        "old logs cannot be deleted: [Errno 13] Permission denied: 'old.mcap'"
    ]
    assert "old.mcap" in many.there


def test_a_thread_looks_at_once_and_ends_with_the_run(many: Folder) -> None:
    write(many.path / "old.mcap", 9)
    with many.retention:
        pass
    assert many.told


def test_the_disk_is_seen_as_df_has_it(tmp_path: Path) -> None:
    disk = Disk.of(tmp_path)
    assert 0 < disk.free <= disk.total
