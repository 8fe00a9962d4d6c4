"""Policies: point clouds in, action chunks out. Knows no simulator."""
