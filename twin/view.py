"""The view: measured beside expected in Rerun, live on this machine or as a ``.rrd`` file.

Rerun is the optional extra ``[view]``; it is imported only when a view is opened. This module
starts the viewer itself and binds it to loopback, since Rerun's own ``spawn`` and ``serve_*`` calls
listen on all interfaces. It switches usage statistics off for that process alone; the user's own
Rerun settings are neither read nor changed.
"""

import colorsys
import contextlib
import importlib
import logging
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import numpy.typing as npt

from twin.errors import ConfigError, SourceError
from twin.events import Event, Kind, Severity
from twin.extras import install_hint, require
from twin.model.effects import EFFECTS, UNKNOWN
from twin.quality import BREAK, UNUSABLE
from twin.signals import MBAR, SAMPLE, TICK, Command, Phase, Samples, Ticks, deviation

TIMELINE = "PLC time of the sample"  # as long as a time: it sets the width of the list's column
# PLC time sent to Rerun at once: a row costs 8 µs in batches of 100 and 2 µs in those of 1000.
LIVE_BATCH_NS = 100_000_000
FILE_BATCH_NS = 1_000_000_000
WINDOW_S = 20.0  # time span of a live plot
MEMORY = "1GB"  # beyond it the viewer drops the oldest data: hours at 1 kHz
START_S = 20.0  # limit for a start: a cold viewer on a busy machine takes a few seconds
PATIENCE_S = 0.05  # longest wait for the viewer in one write: well below a PLC's buffer
MISSES = 60  # consecutive unread writes after which the viewer counts as hung

# Entity, name in the legend, colour, line width, how it runs from sample to sample. The expected
# line is wide: where the two agree, it shows as the measured line's rim.
_SERIES = (
    ("vacuum/measured", "measured", 0x4FB3FFFF, 1.5, "Linear"),
    ("vacuum/expected", "expected", 0xE08A1EFF, 4.0, "Linear"),
    ("deviation", "measured − expected pressure", 0xFF6B6BFF, 1.5, "Linear"),
    ("commands/suction", "suction", 0x4FB3FFFF, 2.0, "StepAfter"),
    ("commands/blow_off", "blow-off", 0xC792EAFF, 2.0, "StepAfter"),
)
_PHASES = {
    Phase.IDLE: ("idle", 0x5C6370FF),
    Phase.SUCTION: ("suction", 0x2F7FC1FF),
    Phase.HOLD: ("hold (air saving)", 0x3C9D6BFF),
    Phase.BLOW_OFF: ("blow-off", 0x8E5BB5FF),
}
_ALARMS = (Kind.ALARM, Kind.ALARM_CHANGED)
CAUSES = {"none": "no cause: as healthy", UNKNOWN: "a cause not known yet"}
_LEVELS = {Severity.INFO: "INFO", Severity.WARNING: "WARN", Severity.ALARM: "ERROR"}

_log = logging.getLogger(__name__)


class Screen:
    """One recording, in a file or in a viewer on this machine, on which all views draw.

    Views may draw from threads of their own. ``url`` is the page to open if there is no window.
    """

    def __init__(self, title: str, target: Path | None, ejectors: Sequence[str] = ("",)) -> None:
        """Write to the file ``target``, or start a viewer if it is None.

        With several ``ejectors`` each has a page with its name, and one page shows all. ConfigError
        if Rerun is not installed; SourceError if the file cannot be written or no viewer starts.
        """
        self.rr = import_rerun()
        self._misses = 0
        self._asking = threading.Lock()
        self.batch_ns = FILE_BATCH_NS if target else LIVE_BATCH_NS
        self._viewer = None if target else _Viewer()
        self.url = self._viewer.url if self._viewer else ""
        self._stream: Any = self.rr.RecordingStream("ejector-twin")
        self._connect(target, _blueprint(self.rr, ejectors, live=target is None))
        self._stream.send_recording_name(title)

    def style(self, path: str, archetype: Any) -> None:
        """Set the style of an entity."""
        if stream := self._stream:
            stream.log(path, archetype, static=True, strict=True)

    def send(self, path: str, time_ns: npt.NDArray[np.int64], values: Any) -> None:
        """Draw columns of an entity at PLC times; does nothing once the screen has ended."""
        if stream := self._stream:
            column = self.rr.TimeColumn(TIMELINE, timestamp=time_ns.astype("datetime64[ns]"))
            stream.send_columns(path, [column], values, strict=True)

    def follow(self) -> None:
        """Check whether the viewer still reads, which bounds the data that wait for it.

        If the viewer was closed, or hangs for some seconds, only the screen ends.
        """
        if self._viewer is None or not self._asking.acquire(blocking=False):
            return  # another thread checks already
        try:
            if self._stream and not self._follows(self._viewer):
                _log.warning("the Rerun viewer was closed or hangs: going on without it")
                self._end()
        finally:
            self._asking.release()

    def close(self) -> None:
        """End the viewer if one was started, else complete the file."""
        with self._asking:
            self._end()

    def _end(self) -> None:
        stream, self._stream = self._stream, None
        if stream is None:
            return
        if self._viewer and not self._delivered(stream):
            self._viewer.close()  # disconnecting would wait for a hanging viewer for ever
        stream.disconnect()
        if self._viewer:
            self._viewer.close()

    def _connect(self, target: Path | None, plan: Any) -> None:
        if self._viewer:
            self._stream.connect_grpc(self._viewer.address, default_blueprint=plan)
            return
        try:
            self._stream.save(target, default_blueprint=plan)
        except RuntimeError as error:
            raise SourceError(
                f"{target}: cannot be written: {error}", "check the folder and its rights"
            ) from error

    def _follows(self, viewer: "_Viewer") -> bool:
        if not viewer.running():
            return False
        self._misses = 0 if self._delivered(self._stream) else self._misses + 1
        return self._misses < MISSES

    def _delivered(self, stream: Any) -> bool:
        try:
            stream.flush(timeout_sec=PATIENCE_S)
        except RuntimeError:
            return False
        return True


class View:
    """A sink that draws one ejector on a screen, below the entity path ``name`` if it has one."""

    def __init__(self, screen: Screen, ambient_pa: float, name: str = "") -> None:
        """Draw vacuum in mbar below ``ambient_pa`` (Pa, absolute)."""
        self._screen = screen
        self._rr = screen.rr
        self._ambient_pa = ambient_pa
        self._prefix = f"{name}/" if name else ""
        self._waiting: list[tuple[Samples, Ticks]] = []
        self._phase = -1
        self._last_ns: int | None = None
        self._causes: set[str] = set()  # of which a probability was shown
        self._style()

    def write(self, samples: Samples, ticks: Ticks, events: Sequence[Event]) -> None:
        """Take row-aligned blocks of SAMPLE and TICK and their events."""
        for event in events:
            self._send_event(event)
        if len(samples):
            self._waiting.append((samples, ticks))
        if self._waiting and (not len(samples) or self._span_ns() >= self._screen.batch_ns):
            self._send_waiting()
            self._screen.follow()

    def close(self) -> None:
        """Send the waiting rows; the screen stays open."""
        if self._waiting:
            self._send_waiting()

    def _style(self) -> None:
        """Set the style of each entity."""
        for path, name, colour, width, mode in _SERIES:
            style = self._rr.SeriesLines(
                names=name, colors=colour, widths=width, interpolation_mode=mode
            )
            self._screen.style(self._prefix + path, style)
        labels, colours = zip(*_PHASES.values(), strict=True)
        phases = self._rr.StateConfiguration(values=labels, colors=np.array(colours, np.uint32))
        self._screen.style(f"{self._prefix}phase", phases)

    def _span_ns(self) -> int:
        first, last = self._waiting[0][0]["time_ns"][0], self._waiting[-1][0]["time_ns"][-1]
        return abs(int(last) - int(first))  # PLC time may have jumped back

    def _send_waiting(self) -> None:
        blocks, self._waiting = self._waiting, []
        samples = np.concatenate([block for block, _ in blocks], dtype=SAMPLE)
        ticks = np.concatenate([block for _, block in blocks], dtype=TICK)
        self._lift_pen(samples)
        for path, values in self._series(samples, ticks).items():
            self._send(path, samples["time_ns"], self._rr.Scalars.columns(scalars=values))
        self._send_phases(samples, ticks)
        self._last_ns = int(samples["time_ns"][-1])

    def _lift_pen(self, samples: Samples) -> None:
        """Interrupt all lines at a break, since nothing was measured in between."""
        breaks = np.flatnonzero(samples["quality"] & BREAK)
        if self._last_ns is None:
            breaks = breaks[breaks > 0]  # before the very first row nothing is drawn
        if len(breaks):
            previous_ns = np.concatenate(([self._last_ns or 0], samples["time_ns"]))[breaks]
            blank_ns, count = previous_ns + 1, len(breaks)
            for path, *_ in _SERIES:
                self._send(path, blank_ns, self._rr.Scalars.columns(scalars=[np.nan] * count))
            self._send("phase", blank_ns, self._rr.StateChange.columns(state=[""] * count))

    def _series(self, samples: Samples, ticks: Ticks) -> Mapping[str, npt.NDArray[np.float64]]:
        usable = (samples["quality"] & UNUSABLE) == 0
        pressure = np.where(usable, samples["pressure"].astype(np.float64), np.nan)
        return {
            "vacuum/measured": (self._ambient_pa - pressure) / MBAR,
            "vacuum/expected": (self._ambient_pa - ticks["expected"].astype(np.float64)) / MBAR,
            "deviation": deviation(samples, ticks) / MBAR,
            "commands/suction": (samples["commands"] & Command.SUCTION > 0).astype(np.float64),
            "commands/blow_off": (samples["commands"] & Command.BLOW_OFF > 0).astype(np.float64),
        }

    def _send_phases(self, samples: Samples, ticks: Ticks) -> None:
        """Send the phase only where it changes, and after a break."""
        phases = ticks["phase"].astype(np.int64)
        changed = np.diff(phases, prepend=self._phase) != 0
        rows = np.flatnonzero(changed | (samples["quality"] & BREAK != 0))
        self._phase = int(phases[-1])
        if len(rows):
            names = [_PHASES[Phase(phase)][0] for phase in phases[rows]]
            times = samples["time_ns"][rows]
            self._send("phase", times, self._rr.StateChange.columns(state=names))

    def _send_event(self, event: Event) -> None:
        folder = "alarms" if event.kind in _ALARMS else "events"
        text = self._rr.TextLog.columns(text=[event.text], level=[_LEVELS[event.severity]])
        self._send(f"{folder}/{event.kind}", np.array([event.time_ns]), text)
        if event.kind is Kind.CYCLE and "probabilities" in event.data:
            self._send_probabilities(event.time_ns, event.data["probabilities"])

    def _send_probabilities(self, time_ns: int, probabilities: Mapping[str, float]) -> None:
        """Send the probabilities of a cycle; earlier causes that are missing get 0."""
        for cause in probabilities.keys() - self._causes:
            style = self._rr.SeriesLines(
                names=CAUSES.get(cause, cause),
                colors=_colour_of(cause),
                widths=2.0,
                interpolation_mode="StepAfter",
            )
            self._screen.style(f"{self._prefix}probabilities/{cause}", style)
        self._causes |= probabilities.keys()
        for cause in sorted(self._causes):
            value = self._rr.Scalars.columns(scalars=[probabilities.get(cause, 0.0)])
            self._send(f"probabilities/{cause}", np.array([time_ns]), value)

    def _send(self, path: str, time_ns: npt.NDArray[np.int64], values: Any) -> None:
        self._screen.send(self._prefix + path, time_ns, values)


def _colour_of(cause: str) -> tuple[int, int, int]:
    """The fixed colour of a cause; neighbours in the table get distant colours."""
    if cause == "none":
        return 230, 230, 230
    if cause == UNKNOWN:
        return 130, 130, 130
    number = list(EFFECTS).index(cause) if cause in EFFECTS else sum(cause.encode())
    hue = number * 0.618 % 1.0
    red, green, blue = (round(255 * part) for part in colorsys.hsv_to_rgb(hue, 0.6, 0.95))
    return red, green, blue


class _Viewer:
    """A viewer process on loopback: a window, or a page for the browser without a display."""

    def __init__(self) -> None:
        port, page = _free_port(), _free_port()
        self.address = f"rerun+http://127.0.0.1:{port}/proxy"
        self.url = ""
        command = [_executable(), "--bind", "127.0.0.1", "--port", str(port)]
        command += ["--hide-welcome-screen", "--memory-limit", MEMORY]
        if not _has_display():
            command += ["--serve-web", "--web-viewer-port", str(page)]
            command += ["--server-memory-limit", MEMORY]
            self.url = f"http://127.0.0.1:{page}?url={quote(self.address, safe='')}"
        # With CI set Rerun sends no usage statistics; Ctrl-C does not reach its own session.
        environment = {**os.environ, "CI": "1", "RUST_LOG": "error"}
        self._process = subprocess.Popen(command, env=environment, start_new_session=True)  # noqa: S603
        self._wait_for(port)
        if self.url:
            self._wait_for(page)

    def running(self) -> bool:
        """Whether the process is alive; the user may have closed its window."""
        return self._process.poll() is None

    def close(self) -> None:
        """Kill the process: it has nothing to save, and would not react while it hangs."""
        self._process.kill()
        self._process.wait()

    def _wait_for(self, port: int) -> None:
        end = time.monotonic() + START_S
        while self.running() and time.monotonic() < end:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 0.5):
                return
            time.sleep(0.05)
        self.close()
        raise SourceError(
            "the Rerun viewer did not start; what it said stands above",
            "write the view to a .rrd file and open it on another machine",
        )


def import_rerun() -> Any:
    """The optional package; if it is missing, ConfigError says what to install."""
    require("view", "the view")
    return importlib.import_module("rerun")


def _executable() -> str:
    """Path of the viewer itself: a terminated ``rerun`` script would leave the viewer running."""
    folder = Path(str(importlib.import_module("rerun_cli").__file__)).parent
    path = shutil.which("rerun", path=folder)
    if not path:
        raise ConfigError(f"no Rerun viewer in {folder}", install_hint("view"))
    return path


def _has_display() -> bool:
    windowed = sys.platform in ("win32", "darwin")
    return windowed or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def _blueprint(rr: Any, ejectors: Sequence[str], *, live: bool) -> Any:
    """The layout of one ejector, or of several as pages after an overview; live follows time.

    Rerun has no linked time axis that also moves on, so live axes are not linked.
    """
    plan = rr.blueprint
    axis = plan.archetypes.TimeAxis(
        link=None if live else "LinkToGlobal", view_range=_window(rr) if live else None
    )
    pages = [_page(plan, axis, name) for name in ejectors]
    return plan.Blueprint(
        pages[0] if len(pages) == 1 else plan.Tabs(_overview(plan, axis, ejectors), *pages),
        plan.TimePanel(
            state="collapsed", timeline=TIMELINE, play_state="following" if live else None
        ),
        plan.BlueprintPanel(state="hidden"),
        plan.SelectionPanel(state="hidden"),
    )


def _page(plan: Any, axis: Any, name: str) -> Any:
    """The page of one ejector: its views one below the other."""
    legend = {"axis_x": axis, "plot_legend": plan.PlotLegend(plan.Corner2D.LeftTop)}
    views = (
        _vacuum(plan, axis, name, "Vacuum, mbar below ambient"),
        plan.TimeSeriesView(origin=f"{name}/deviation", name="Deviation, mbar", **legend),
        plan.TimeSeriesView(
            origin=f"{name}/commands",
            name="Commands: suction (blue), blow-off (violet)",
            axis_x=axis,
            axis_y=plan.ScalarAxis(range=(-0.15, 1.15), zoom_lock=True),
            plot_legend=plan.PlotLegend(visible=False),  # a legend would hide the steps
        ),
        plan.StateTimelineView(origin=f"{name}/phase", name="Phase", time_view=axis),
        _probabilities(plan, axis, name),
        plan.Horizontal(
            _texts(plan, "Events", [f"{name}/events"]), _texts(plan, "Alarms", [f"{name}/alarms"])
        ),
    )
    return plan.Vertical(*views, row_shares=[3.6, 2.4, 1.3, 1.4, 2.8, 2.0], name=name or None)


def _overview(plan: Any, axis: Any, ejectors: Sequence[str]) -> Any:
    """Vacuum and probabilities of every ejector, and the alarms of all."""
    cells = [
        plan.Vertical(
            _vacuum(plan, axis, name, f"{name}: vacuum, mbar below ambient"),
            _probabilities(plan, axis, name),
            row_shares=[3.0, 2.0],
        )
        for name in ejectors
    ]
    alarms = _texts(plan, "Alarms", [f"{name}/alarms" for name in ejectors])
    return plan.Vertical(plan.Grid(*cells), alarms, row_shares=[4.0, 1.0], name="all")


def _vacuum(plan: Any, axis: Any, name: str, title: str) -> Any:
    legend = plan.PlotLegend(plan.Corner2D.LeftTop)
    return plan.TimeSeriesView(origin=f"{name}/vacuum", name=title, axis_x=axis, plot_legend=legend)


def _probabilities(plan: Any, axis: Any, name: str) -> Any:
    return plan.TimeSeriesView(
        origin=f"{name}/probabilities",
        name="Probability of each cause after each cycle",
        axis_x=axis,
        axis_y=plan.ScalarAxis(range=(-0.05, 1.05), zoom_lock=True),
        plot_legend=plan.PlotLegend(plan.Corner2D.LeftTop),
    )


def _texts(plan: Any, title: str, paths: Sequence[str]) -> Any:
    path_column = ["entitypath"] if len(paths) > 1 else []
    return plan.TextLogView(
        origin="/",
        contents=[f"+ /{place.lstrip('/')}/**" for place in paths],
        name=title,
        columns=plan.TextLogColumns(
            timeline_columns=[TIMELINE], text_log_columns=[*path_column, "loglevel", "body"]
        ),
    )


def _window(rr: Any) -> Any:
    edge = rr.blueprint.TimeRangeBoundary.cursor_relative
    return rr.blueprint.TimeRange(start=edge(seconds=-WINDOW_S), end=edge(seconds=0.0))
