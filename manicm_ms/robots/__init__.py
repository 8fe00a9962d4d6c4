"""Robots as ManiSkill agents; importing a module registers its agent."""

from manicm_ms import vulkan

vulkan.prepare()  # before SAPIEN is first imported
