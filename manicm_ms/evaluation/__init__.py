"""Judging policies: roll-outs, latency, statistics, reports."""
