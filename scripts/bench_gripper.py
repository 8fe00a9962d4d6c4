"""The former place of scripts/results/gripper_hold.py, for one release."""

from former_paths import forward

forward(__file__)
