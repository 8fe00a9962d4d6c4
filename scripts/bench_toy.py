"""The former place of scripts/results/toy_distillation.py, for one release."""

from former_paths import forward

forward(__file__)
