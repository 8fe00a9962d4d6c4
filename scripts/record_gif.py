"""The former place of scripts/results/record_gif.py, for one release."""

from former_paths import forward

forward(__file__)
