"""Tasks, one file each; importing a module registers its environments and expert."""

from manicm_ms import vulkan

vulkan.prepare()  # before SAPIEN is first imported
