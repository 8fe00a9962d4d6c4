"""Observation encoders: point clouds and proprioception to feature vectors."""
