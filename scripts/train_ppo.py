"""The former place of scripts/examples/train_ppo.py, for one release."""

from former_paths import forward

forward(__file__)
