"""Packaged data files: robot descriptions, meshes and shaders, reached through `manicm_ms.paths.asset`."""
