"""How near a mesh is to the truth; loaded by `refine eval` and `refine bench` only."""
