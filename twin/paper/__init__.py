"""The founding paper's evacuation times, recomputed, and compared with this twin.

"Simulation Model for Digital Twins of Pneumatic Vacuum Ejectors" validates its model on a test rig
(its tables 1 and 2, Fig. 7) and on an industrial application (tables 3 and 4).
"""
