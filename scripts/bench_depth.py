"""The former place of `manicm-ms bench depth`, for one release."""

from former_paths import forward

forward(__file__)
