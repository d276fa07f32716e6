"""Cameras: projection, the forms in which one comes, and whether it sees the mesh."""
