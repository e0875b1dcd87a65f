"""The founding paper's evacuation times, recomputed, and what this twin makes of them.

"Simulation Model for Digital Twins of Pneumatic Vacuum Ejectors" validates its model on a test rig
(its tables 1 and 2, Fig. 7) and on an industrial application (tables 3 and 4).
"""
