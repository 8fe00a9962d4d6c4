"""The former place of scripts/robot/generate_robot.py, for one release."""

from former_paths import forward

forward(__file__)
