"""``twin plc`` and ``twin probe``: the simulated PLC, and the inspection of a real one."""

from typing import Annotated

import typer

from twin.cli.app import positive, read_config
from twin.cli.console import complain, hint
from twin.cli.options import Address, ConfigFile, ConfigFiles
from twin.errors import ConfigError


def plc(
    configs: ConfigFiles,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE[@START][/COURSE]", help="For example leakage=2.0@10."),
    ] = None,
    port: Annotated[int | None, typer.Option(help="Modbus TCP port; 0 takes any free.")] = None,
    seed: Annotated[
        int, typer.Option(min=0, help="For all that is random: same seed, same run.")
    ] = 0,
    duration: Annotated[
        float | None,
        typer.Option(metavar="S", callback=positive, help="Stop after S seconds."),
    ] = None,
) -> None:
    """Run the simulated PLC with an ejector behind it, for trials and tests.

    With several configurations as many ejectors are behind it, each with its own unit and prefix
    of nodes; the first one says where it listens and has the faults.
    """
    from drivers.plc.faults import parse_fault
    from drivers.plc.live import announce, run_plc
    from drivers.plc.settings import PlcSettings

    documents = [read_config(path) for path in configs]
    for document in documents:
        if "plc" not in document.tables:
            raise ConfigError(
                f"{document.name}: there is no [plc] table",
                "say what is simulated, as in: twin init FILE.toml --starter test_rig",
            )
    settings = [document.section(PlcSettings, "plc").on_port(port) for document in documents]

    def ready(host: str, port: int) -> None:
        announce(host, port)
        beside = " ".join(map(str, configs))
        hint(complain, f"Ctrl-C ends it; beside it, in a second terminal: twin run {beside}")

    run_plc(settings, [parse_fault(text) for text in fault or []], seed, duration, ready)


def probe(config: ConfigFile, address: Address = "") -> None:
    """Say what a PLC answers at its address, and in which word order."""
    from drivers.sources import probe_source

    for line in probe_source(read_config(config), address):
        print(line)
