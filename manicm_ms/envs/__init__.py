"""Parallel environments behind one vector interface."""
