"""The ``[plc]`` table: the simulated PLC, its program and the rig behind it, in field units."""

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from twin.errors import ConfigError
from twin.settings import Settings
from twin.users import UsersFile


class Rig(Settings):
    """Surroundings, gas volumes and the lines between port and vessel."""

    ambient_mbar: float = Field(default=1013.0, ge=600, le=1100)  # absolute
    temperature_c: float = Field(default=20.0, ge=-20, le=80)  # of air and walls
    port_ml: float = Field(default=2.0, ge=0.5, le=100)  # volume at the port
    line_ml: float = Field(default=3.0, ge=0.5, le=500)  # volume of the hose
    vessel_ml: float = Field(default=750.0, ge=5, le=100_000)  # volume of vessel or cups
    line_length_m: float = Field(default=0.1, ge=0.02, le=20)  # of the hose
    line_diameter_mm: float = Field(default=6.0, ge=1, le=50)  # inside
    sensor: Literal["port", "line"] = "port"  # at the ejector's port, or at a T half-way
    vessel_area_m2: float = Field(default=0.047, ge=0, le=10)  # of its wall
    vessel_film: float = Field(default=10.0, ge=0, le=500)  # W/(m²·K)
    tube_film: float = Field(default=60.0, ge=0, le=500)  # W/(m²·K), port and line
    seal_leak_sl_min: float = Field(default=0.3, ge=0, le=50)  # of healthy seals, sonic
    opens: bool = False  # after blow-off the part leaves and the cup is open to ambient
    opening_sl_min: float = Field(default=600.0, gt=0, le=2000)  # sonic, through the open cup
    release_mbar: float = Field(default=20.0, ge=1, le=200)  # vacuum below which the part leaves


class Ejector(Settings):
    """Nozzle, supply line, exhaust and blow-off of this instance."""

    suction_capacity_sl_min: float = Field(default=35.0, gt=0, le=1000)  # at optimum supply
    end_pressure_mbar: float = Field(default=150.0, ge=10, le=900)  # at optimum supply
    optimum_supply_bar: float = Field(default=4.8, ge=1, le=8)  # gauge
    bulge: float = Field(default=1.25, ge=0.1, le=5)  # curvature of the characteristic
    second_stage: float = Field(default=0.0, ge=0, le=0.6)  # share of capacity that ends early
    second_stage_depth: float = Field(default=0.5, gt=0, le=1)  # end vacuum over the first's
    build_up_ms: float = Field(default=6.0, ge=0.5, le=200)  # time constant of the jet as it starts
    collapse_ms: float = Field(default=2.0, ge=0.5, le=200)  # the same as it ends
    supply_bar: float = Field(default=5.0, ge=0, le=10)  # gauge, at the regulator
    supply_droop_bar: float = Field(default=0.2, ge=0, le=2)  # while the nozzle is on
    supply_lag_ms: float = Field(default=20.0, ge=1, le=1000)  # time constant of the supply line
    blow_off_sl_min: float = Field(default=130.0, gt=0, le=2000)  # sonic, at optimum supply
    relief_mbar: float = Field(default=100.0, gt=0, le=1000)  # above ambient, at blow-off flow


class Valves(Settings):
    """From the command to the moved spool; both directions of the suction valve differ."""

    suction_on_ms: float = Field(default=12.0, ge=0, le=200)  # delay
    suction_off_ms: float = Field(default=9.0, ge=0, le=200)  # delay
    blow_off_on_ms: float = Field(default=11.0, ge=0, le=200)  # delay
    blow_off_off_ms: float = Field(default=9.0, ge=0, le=200)  # delay
    blow_off_opening_ms: float = Field(default=3.0, ge=0.5, le=100)  # time constant


class Sensor(Settings):
    """The sensor that the PLC reads."""

    lag_ms: float = Field(default=1.5, ge=0, le=100)  # of each of its two stages
    noise_mbar: float = Field(default=0.3, ge=0, le=20)  # one standard deviation
    step_mbar: float = Field(default=0.1, gt=0, le=20)  # of its converter
    full_scale_mbar: float = Field(default=2000.0, ge=1000, le=3200)  # absolute; overflow beyond
    # One standard deviation, of the supply sensor.
    supply_noise_mbar: float = Field(default=3.0, ge=0, le=200)


class Control(Settings):
    """The compact ejector's two-point air saving on its own sensor, unseen by the PLC."""

    air_saving: bool = True  # whether the nozzle goes off at H1
    h1_mbar: float = Field(default=750.0, ge=10, le=998)  # vacuum; nozzle off from here
    # Below H1, at which the nozzle is on again.
    h1_hysteresis_mbar: float = Field(default=150.0, ge=1, le=900)
    h2_mbar: float = Field(default=550.0, ge=5, le=998)  # vacuum; part present from here
    # Below H2, at which the part is gone.
    h2_hysteresis_mbar: float = Field(default=10.0, ge=1, le=900)
    noise_mbar: float = Field(default=0.5, ge=0, le=20)  # one standard deviation, of its own sensor


class Reports(Settings):
    """What the ejector and its surroundings tell besides, where the PLC serves it."""

    bits: bool = False  # nozzle, air saving and part present in the status, as IO-Link brings them
    bits_delay_ms: float = Field(default=0.0, ge=0, le=100)  # IO-Link's cycle, and the PLC's
    values: bool = False  # barometer, thermometer, the vessel's pressure and the suction flow


class Program(Settings):
    """What the PLC commands: a pick-and-place cycle, or coils that a client writes.

    In "hil" it is a PLC without a rig: its pressure is what the twin writes, and its program
    waits for part present before it goes on, for ``suction_ms`` more.
    """

    commands: Literal["program", "coils", "hil"] = "program"  # who gives them
    start_ms: float = Field(default=500.0, ge=0, le=60_000)  # idle before the first cycle
    suction_ms: float = Field(default=2300.0, ge=1, le=3.6e6)  # of a cycle
    blow_off_ms: float = Field(default=300.0, ge=0, le=3.6e6)  # of a cycle
    idle_ms: float = Field(default=600.0, ge=0, le=3.6e6)  # between cycles
    jitter_ms: float = Field(default=5.0, ge=0, le=1000)  # one standard deviation per duration


class Scatter(Settings):
    """What differs from cycle to cycle, one standard deviation each."""

    supply_bar: float = Field(default=0.02, ge=0, le=1)  # of the supply
    seal_leak_sl_min: float = Field(default=0.03, ge=0, le=5)  # of the seal leak
    valve_ms: float = Field(default=0.5, ge=0, le=20)  # of each delay


Policy = Literal["None", "Basic256Sha256", "Aes256Sha256RsaPss"]  # with sign-and-encrypt


class Server(Settings):
    """Where the PLC speaks Modbus and how it lays out 32-bit and 64-bit values."""

    host: str = "127.0.0.1"  # that it listens on
    port: int = Field(default=5020, ge=0, le=65535)  # 0 takes any free one
    unit: int = Field(default=1, ge=1, le=247)  # identifier that it answers to
    word_order: Literal["big", "little"] = "big"  # of 32- and 64-bit values


class OpcuaServer(Settings):
    """Where the PLC serves OPC UA, to whom, and how much like a real server it behaves."""

    host: str = "127.0.0.1"  # that it listens on
    port: int = Field(default=4840, ge=0, le=65535)  # 0 takes any free one
    prefix: str = ""  # of its nodes' names, where several ejectors are served
    namespace_index: int = Field(default=2, ge=2, le=50)  # real ones change it when reconfigured
    trace_depth: int = Field(default=1024, ge=256, le=4096)  # newest scans in the trace's arrays
    min_sampling_ms: int = Field(default=1, ge=1, le=10_000)  # asked for less, it is revised
    min_publishing_ms: float = Field(default=1.0, ge=1, le=10_000)  # the same
    max_queue: int = Field(default=10_000, ge=1, le=100_000)  # values of one node
    late_publishing_ms: float = Field(default=0.0, ge=0, le=10_000)  # so long publishing takes
    drop_every_s: float = Field(default=0.0, ge=0)  # hang up on everybody so often; 0: never
    policies: tuple[Policy, ...] = ("None",)  # that clients may use
    certificates: Path | None = None  # a folder as twin cert makes it
    users: UsersFile | None = None  # as twin users makes it; with one, everybody logs in

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
    opcua: OpcuaServer | None = None  # beside Modbus, from the same scans, if there is a table

    def on_port(self, port: int | None) -> "PlcSettings":
        """Give the same on another port (None: the configured one); ConfigError if it is none."""
        if port is None:
            return self
        if not 0 <= port <= 65535:
            raise ConfigError(f"{port} is not a port", "0 (any free one) to 65535")
        return self.model_copy(update={"server": self.server.model_copy(update={"port": port})})
