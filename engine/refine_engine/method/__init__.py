"""The paper, in reading order: config (every number), loop (section 3.3), network (3.2), losses (3.3).

proportions moves the mesh as a whole before the network starts; views holds what is fixed during a run;
symmetry, topology and sparse are the tools below; presets is what a caller may choose.
"""
