"""A second simulated world: rigs and records that share no equation with the product.

Topology: silencer - stage 2 - flap - stage 1 - check valve - head - hose of N cells - vessel.
Behind the regulator lie hose, suction valve, feed and nozzle; blow-off enters at the head.

Laws: each cell has mass and energy, each face of the hose momentum (Darcy-Weisbach, Haaland), walls
take heat by Nusselt laws and have a temperature. Orifices follow ISO 6358. An ejector stage is its
momentum balance with Fabri choking (`ejector`): no curve of suction capacity is put in. Cups yield
late and with hysteresis. Released parts open the vessel until the next contact. Air saving has its
own sensor, which the PLC cannot see. Sources stand beside each law.

Other than a lumped model: sound in the hose, end vacuum, kink and sag under supply all follow from
the physics. Kinetic energy of the gas and humidity are left out.

A record begins after a long rest. Its first evacuation takes up to an eighth longer than later
ones, whose air is still warm from filling.
"""

from second_world.draw import KINDS, draw_rig
from second_world.faults import OUTSIDE, TABLE, Fault
from second_world.records import Record, Truth, record, write_csv, write_parquet

__all__ = [
    "KINDS",
    "OUTSIDE",
    "TABLE",
    "Fault",
    "Record",
    "Truth",
    "draw_rig",
    "record",
    "write_csv",
    "write_parquet",
]
