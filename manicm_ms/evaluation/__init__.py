"""Evaluating policies: rollouts, latency, statistics, reports."""
