"""What SAPIEN can do on this machine's GPU: whether it can render there, and where its PhysX library belongs.

SAPIEN is imported by the functions, not by the module, and nothing is downloaded.
"""

from __future__ import annotations

import platform
from pathlib import Path

from manicm_ms.machine import vulkan

PHYSX_REMEDY = "run python -c 'import sapien; sapien.physx.enable_gpu()' once while online, or copy it there"


def cuda_can_render() -> bool:
    """Return whether SAPIEN can render on the CUDA device; False where there is none.

    CUDA alone does not tell: in a container the driver often lacks its graphics part, and then a software Vulkan
    device renders on the CPU.
    """
    vulkan.prepare()
    import sapien

    try:
        return bool(sapien.Device("cuda").can_render())
    except RuntimeError:  # SAPIEN's answer where it finds no such device
        return False


def physx_gpu_library() -> Path:
    """Return the path of the PhysX GPU library that the installed SAPIEN loads, whether it is there or not."""
    vulkan.prepare()
    from sapien import physx

    name = "PhysXGpu_64.dll" if platform.system() == "Windows" else "libPhysXGpu_64.so"
    return Path.home() / ".sapien" / "physx" / physx.version() / name


if __name__ == "__main__":  # for callers that keep SAPIEN out of their own process
    print(physx_gpu_library())
