"""The former place of scripts/results/depth_picture.py, for one release."""

from former_paths import forward

forward(__file__)
