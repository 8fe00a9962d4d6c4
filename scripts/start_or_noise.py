"""The former place of scripts/results/start_or_noise.py, for one release."""

from former_paths import forward

forward(__file__)
