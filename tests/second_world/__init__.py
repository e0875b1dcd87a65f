from second_world.draw import KINDS, draw_rig
from second_world.faults import OUTSIDE, TABLE, Fault
from second_world.records import Record, Truth, record, write_csv, write_parquet
