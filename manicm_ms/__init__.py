"""manicm_ms: one-step 3D manipulation policies and the parallel simulation to evaluate them in.

Importing this package makes its ids known to Gymnasium (`gymnasium.make("UR3eStackCube-v1")`) and loads no simulator;
making an environment does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from manicm_ms import signals

signals.quiet_start("manicm-ms", "manicm_ms.cli")  # before the imports, in which an interrupt can get lost

from manicm_ms import former_names, gym_ids  # noqa: E402

__version__ = "0.1.0"
__all__ = ["ChunkSpec", "EnvSpec", "__version__", "check_vec_env", "make_vec"]

if TYPE_CHECKING:
    from manicm_ms.envs.conformance import check_vec_env
    from manicm_ms.envs.vec_env import make_vec
    from manicm_ms.spec import ChunkSpec, EnvSpec

_LAZY = {
    "make_vec": "manicm_ms.envs.vec_env",
    "check_vec_env": "manicm_ms.envs.conformance",
    "ChunkSpec": "manicm_ms.spec",
    "EnvSpec": "manicm_ms.spec",
}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_LAZY[name]), name)


former_names.install()
gym_ids.register()
