"""What users time on their own machine: `manicm-ms bench COMMAND`, a module a command.

The grid of tasks, methods and seeds is no part of it: that is `manicm_ms.benchmark`.
"""

from manicm_ms.machine import mujoco_gl, vulkan

vulkan.prepare()  # before SAPIEN is first imported
mujoco_gl.spare_others()  # before ManiSkill imports mujoco
