"""Parallel environments behind one vector interface."""

from manicm_ms.machine import mujoco_gl, vulkan

vulkan.prepare()  # before SAPIEN is first imported
mujoco_gl.spare_others()  # before ManiSkill imports mujoco
