"""The command line: the only place where the twin meets the drivers.

A command imports its modules when it runs, so that ``twin --help`` is quick. Results of a command
go to stdout, remarks on its work to stderr.
"""

import atexit
import gc
import os
import sys

from twin.cli.alarms import alarms_app
from twin.cli.app import App
from twin.cli.assets import assets_app
from twin.cli.calibrate import calibrate
from twin.cli.cert import cert
from twin.cli.commission import commission
from twin.cli.compare import compare
from twin.cli.config import config_app
from twin.cli.console import complain
from twin.cli.diagnose import diagnose
from twin.cli.effects import effects_app
from twin.cli.exchange import export_fmu
from twin.cli.figures import figures_app
from twin.cli.fleet import fleet_app
from twin.cli.init import init
from twin.cli.logs import log_app
from twin.cli.paper import paper
from twin.cli.plc import plc, probe
from twin.cli.replay import replay
from twin.cli.run import run
from twin.cli.serve import serve
from twin.cli.stopping import INTERRUPTED
from twin.cli.tables import export, import_
from twin.cli.users import users_app
from twin.errors import TwinError

GARBAGE = 20_000  # allocations beyond releases after which Python collects garbage

# In the order of use: set up, run, find causes, look after stored data, tools.
ORDER = (
    *("init", "config", "probe", "import", "commission", "calibrate"),
    *("run", "serve", "replay", "diagnose", "compare", "figures", "alarms"),
    *("fleet", "log", "assets", "users", "cert"),
    *("export", "export-fmu", "effects", "paper", "plc"),
)

INSTEAD = {  # of commands that people look for
    "check": "twin config check FILE, twin log check LOG.mcap",
    "report": "twin diagnose LOG.mcap --report FILE.html",
    "show": "twin figures show LOG.mcap",
    "simulate": "twin plc CONFIG",
    "start": "twin run CONFIG",
}
BEGIN = "Without a machine begin with: twin init rig.toml --starter test_rig"

app = App("A live digital twin of pneumatic vacuum ejectors.", ORDER, epilog=BEGIN, instead=INSTEAD)
for name, sub_app in {
    "assets": assets_app,
    "figures": figures_app,
    "alarms": alarms_app,
    "fleet": fleet_app,
    "users": users_app,
    "config": config_app,
    "effects": effects_app,
    "log": log_app,
}.items():
    app.add_typer(sub_app, name=name)
for command in (
    *(init, probe, commission, calibrate, run, serve, replay, diagnose, compare, cert),
    *(export, export_fmu, paper, plc),
):
    app.command()(command)
app.command("import")(import_)


def main() -> None:
    """Run the command line; errors become one message with a hint, and the exit code."""
    # Matrices are small: more threads only wait for each other, on cores that others need.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when a command imports NumPy
    gc.set_threshold(GARBAGE)  # imports make no garbage; collecting takes a tenth of the start
    atexit.register(gc.freeze)  # the process ends: no 0.2 s for a last collection
    try:
        app(prog_name="twin")
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except TwinError as error:
        complain(f"{error}\n  {error.hint}" if error.hint else str(error))
        sys.exit(error.exit_code)
