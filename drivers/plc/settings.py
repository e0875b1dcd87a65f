"""The ``[plc]`` table: the simulated PLC, its program and the rig behind it, in field units."""

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from twin.errors import ConfigError
from twin.settings import Settings
from twin.users import UsersFile


class Rig(Settings):
    """Surroundings, gas volumes and the lines between port and vessel."""

    ambient_mbar: float = Field(default=1013.0, ge=600, le=1100)  # absolute ambient pressure
    temperature_c: float = Field(default=20.0, ge=-20, le=80)  # temperature of air and walls
    port_ml: float = Field(default=2.0, ge=0.5, le=100)  # volume at the port
    line_ml: float = Field(default=3.0, ge=0.5, le=500)  # volume of the hose
    vessel_ml: float = Field(default=750.0, ge=5, le=100_000)  # volume of vessel or cups
    line_length_m: float = Field(default=0.1, ge=0.02, le=20)  # length of the hose
    line_diameter_mm: float = Field(default=6.0, ge=1, le=50)  # inner diameter of the hose
    # Place of the sensor: the ejector's port, or a T half-way along the hose.
    sensor: Literal["port", "line"] = "port"
    vessel_area_m2: float = Field(default=0.047, ge=0, le=10)  # wall area of the vessel
    vessel_film: float = Field(default=10.0, ge=0, le=500)  # W/(m²·K)
    tube_film: float = Field(default=60.0, ge=0, le=500)  # W/(m²·K), port and line
    # Sonic flow of leaks at healthy seals.
    seal_leak_sl_min: float = Field(default=0.3, ge=0, le=50)
    opens: bool = False  # whether the part leaves after blow-off and opens the cup to ambient
    opening_sl_min: float = Field(default=600.0, gt=0, le=2000)  # sonic flow through the open cup
    release_mbar: float = Field(default=20.0, ge=1, le=200)  # vacuum below which the part leaves


class Ejector(Settings):
    """Nozzle, supply line, exhaust and blow-off of this instance."""

    # Suction at ambient pressure and optimum supply.
    suction_capacity_sl_min: float = Field(default=35.0, gt=0, le=1000)
    # Absolute pressure without flow, at optimum supply.
    end_pressure_mbar: float = Field(default=150.0, ge=10, le=900)
    # Gauge pressure of the greatest suction.
    optimum_supply_bar: float = Field(default=4.8, ge=1, le=8)
    bulge: float = Field(default=1.25, ge=0.1, le=5)  # curvature of the characteristic
    # Share of a second stage in the suction capacity.
    second_stage: float = Field(default=0.0, ge=0, le=0.6)
    # End vacuum of the second stage over the first's.
    second_stage_depth: float = Field(default=0.5, gt=0, le=1)
    build_up_ms: float = Field(default=6.0, ge=0.5, le=200)  # time constant of the growing jet
    collapse_ms: float = Field(default=2.0, ge=0.5, le=200)  # time constant of the decaying jet
    supply_bar: float = Field(default=5.0, ge=0, le=10)  # gauge pressure at the regulator
    supply_droop_bar: float = Field(default=0.2, ge=0, le=2)  # pressure drop while the nozzle is on
    supply_lag_ms: float = Field(default=20.0, ge=1, le=1000)  # time constant of the supply line
    blow_off_sl_min: float = Field(default=130.0, gt=0, le=2000)  # sonic flow at optimum supply
    # Port pressure above ambient at the blow-off flow.
    relief_mbar: float = Field(default=100.0, gt=0, le=1000)


class Valves(Settings):
    """Delays from the command to the moved spool, for both directions of each valve."""

    suction_on_ms: float = Field(default=12.0, ge=0, le=200)  # delay of the opening suction valve
    suction_off_ms: float = Field(default=9.0, ge=0, le=200)  # delay of the closing suction valve
    blow_off_on_ms: float = Field(default=11.0, ge=0, le=200)  # delay of the opening blow-off valve
    blow_off_off_ms: float = Field(default=9.0, ge=0, le=200)  # delay of the closing blow-off valve
    # Time constant of the opening blow-off valve.
    blow_off_opening_ms: float = Field(default=3.0, ge=0.5, le=100)


class Sensor(Settings):
    """The sensor that the PLC reads."""

    lag_ms: float = Field(default=1.5, ge=0, le=100)  # time constant of each of its two stages
    noise_mbar: float = Field(default=0.3, ge=0, le=20)  # one standard deviation
    step_mbar: float = Field(default=0.1, gt=0, le=20)  # step of its converter
    # Largest absolute reading; overflow beyond it.
    full_scale_mbar: float = Field(default=2000.0, ge=1000, le=3200)
    # One standard deviation of the supply sensor.
    supply_noise_mbar: float = Field(default=3.0, ge=0, le=200)


class Control(Settings):
    """The compact ejector's two-point air saving on its own sensor, unseen by the PLC."""

    air_saving: bool = True  # whether the nozzle goes off at H1
    h1_mbar: float = Field(default=750.0, ge=10, le=998)  # vacuum from which the nozzle is off
    # The nozzle is on again this far below H1.
    h1_hysteresis_mbar: float = Field(default=150.0, ge=1, le=900)
    # Vacuum from which a part counts as present.
    h2_mbar: float = Field(default=550.0, ge=5, le=998)
    # The part counts as gone this far below H2.
    h2_hysteresis_mbar: float = Field(default=10.0, ge=1, le=900)
    # One standard deviation of the ejector's own sensor.
    noise_mbar: float = Field(default=0.5, ge=0, le=20)


class Reports(Settings):
    """Optional signals of the ejector and its surroundings that the PLC serves."""

    bits: bool = False  # nozzle, air saving and part present in the status, as from IO-Link
    # Delay of these bits: a cycle of IO-Link and of the PLC.
    bits_delay_ms: float = Field(default=0.0, ge=0, le=100)
    values: bool = False  # barometer, thermometer, the vessel's pressure and the suction flow


class Program(Settings):
    """The PLC's commands: a pick-and-place cycle, or coils that a client writes.

    In "hil" it is a PLC without a rig: its pressure is what the twin writes, and its program
    waits for part present before it goes on, for ``suction_ms`` more.
    """

    # Source of the commands: a program, coils, or the twin's hardware in the loop.
    commands: Literal["program", "coils", "hil"] = "program"
    start_ms: float = Field(default=500.0, ge=0, le=60_000)  # idle time before the first cycle
    suction_ms: float = Field(default=2300.0, ge=1, le=3.6e6)  # duration of suction in a cycle
    blow_off_ms: float = Field(default=300.0, ge=0, le=3.6e6)  # duration of blow-off in a cycle
    idle_ms: float = Field(default=600.0, ge=0, le=3.6e6)  # idle time between cycles
    jitter_ms: float = Field(default=5.0, ge=0, le=1000)  # one standard deviation of each duration


class Scatter(Settings):
    """Scatter from cycle to cycle, one standard deviation each."""

    supply_bar: float = Field(default=0.02, ge=0, le=1)  # scatter of the supply pressure
    seal_leak_sl_min: float = Field(default=0.03, ge=0, le=5)  # scatter of the seal leak
    valve_ms: float = Field(default=0.5, ge=0, le=20)  # scatter of each valve's delay


Policy = Literal["None", "Basic256Sha256", "Aes256Sha256RsaPss"]  # with sign-and-encrypt


class Server(Settings):
    """The PLC's Modbus server, and its layout of 32-bit and 64-bit values."""

    host: str = "127.0.0.1"  # address that it listens on
    port: int = Field(default=5020, ge=0, le=65535)  # 0 takes any free one
    unit: int = Field(default=1, ge=1, le=247)  # unit identifier that it answers to
    word_order: Literal["big", "little"] = "big"  # word order of 32-bit and 64-bit values


class OpcuaServer(Settings):
    """The PLC's OPC UA server: address, access, and limits as of a real server."""

    host: str = "127.0.0.1"  # address that it listens on
    port: int = Field(default=4840, ge=0, le=65535)  # 0 takes any free one
    prefix: str = ""  # prefix of the nodes' names, if several ejectors are served
    # Index of the namespace; reconfiguring a real server changes it.
    namespace_index: int = Field(default=2, ge=2, le=50)
    trace_depth: int = Field(default=1024, ge=256, le=4096)  # newest scans in the trace's arrays
    # Shortest sampling interval; a shorter request is revised to it.
    min_sampling_ms: int = Field(default=1, ge=1, le=10_000)
    # Shortest publishing interval; a shorter request is revised to it.
    min_publishing_ms: float = Field(default=1.0, ge=1, le=10_000)
    max_queue: int = Field(default=10_000, ge=1, le=100_000)  # longest queue of a node's values
    late_publishing_ms: float = Field(default=0.0, ge=0, le=10_000)  # time that a publication takes
    # Interval at which it drops all connections; 0: never.
    drop_every_s: float = Field(default=0.0, ge=0)
    policies: tuple[Policy, ...] = ("None",)  # security policies that clients may use
    certificates: Path | None = None  # a folder as twin cert makes it
    users: UsersFile | None = None  # file of twin users; with one, every client must log in

    @model_validator(mode="after")
    def _can_be_secure(self) -> Self:
        if self.policies != ("None",) and self.certificates is None:
            raise ValueError("policies other than None need certificates, a folder by twin cert")
        return self


class PlcSettings(Settings):
    """The table ``[plc]``."""

    rig: Rig = Rig()
    ejector: Ejector = Ejector()
    valves: Valves = Valves()
    sensor: Sensor = Sensor()
    control: Control = Control()
    reports: Reports = Reports()
    program: Program = Program()
    scatter: Scatter = Scatter()
    server: Server = Server()
    # OPC UA server beside Modbus with the same scans, if the table exists.
    opcua: OpcuaServer | None = None

    def on_port(self, port: int | None) -> "PlcSettings":
        """Give the same on another port (None: the configured one); ConfigError if it is none."""
        if port is None:
            return self
        if not 0 <= port <= 65535:
            raise ConfigError(f"{port} is not a port", "0 (any free one) to 65535")
        return self.model_copy(update={"server": self.server.model_copy(update={"port": port})})
