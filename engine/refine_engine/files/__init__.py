"""Bytes of meshes and images -> tensors, and meshes back into their files. Read under limits."""
