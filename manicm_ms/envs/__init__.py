"""Parallel environments behind one vector interface."""

from manicm_ms import vulkan

vulkan.prepare()  # before SAPIEN is first imported
