"""The former place of scripts/results/renew_results.py, for one release."""

from former_paths import forward

forward(__file__)
