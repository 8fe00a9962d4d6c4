"""Tasks, one file each; importing a module registers its environments and expert.

Files in the folders that the environment variable MANICM_MS_TASKS names (separated as those of PATH) are modules of
this package too, in worker processes as well: a task of one's own need not lie in the repository.
"""

from manicm_ms.machine import mujoco_gl, vulkan
from manicm_ms.registry import outside_folders

__path__ += outside_folders("MANICM_MS_TASKS", beside=__path__)
vulkan.prepare()  # before SAPIEN is first imported
mujoco_gl.spare_others()  # before ManiSkill imports mujoco
