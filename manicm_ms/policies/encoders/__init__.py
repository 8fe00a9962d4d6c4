"""Observation encoders, and the transforms that stand before them; a file in here that registers one is found."""
