"""The former place of scripts/results/results_table.py, for one release."""

from former_paths import forward

forward(__file__)
