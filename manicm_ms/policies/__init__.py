"""Policies: observations in, action chunks out. Knows no simulator."""

from manicm_ms.policies.policy import example_observations as example_observations
