"""The ids that Gymnasium knows as soon as manicm_ms is imported; what they name is imported when it is made.

Two kinds. ManiSkill's, such as "UR3eStackCube-v1": the plain task, for ManiSkill's wrappers and tools. Ours, such as
"ur3e/stack-cube", "adroit/door" and "metaworld/reach": one row of `make_vec` behind `gymnasium.make`, and `make_vec`
itself behind `gymnasium.make_vec`.

Entry points are text, so that `gymnasium.spec(id).to_json()` works. The names stand here a second time, because reading
them off the tasks would import a simulator; a test compares them.
"""

from __future__ import annotations

import gymnasium
from gymnasium.envs.registration import WrapperSpec

MANISKILL = {
    "UR3eSlideBlock-v1": ("manicm_ms.tasks.slide_block:SlideBlockEnv", 120),
    "UR3eStackCube-v1": ("manicm_ms.tasks.stack_cube:StackCubeEnv", 200),
    "UR3eTransferPiece-v1": ("manicm_ms.tasks.transfer_piece:TransferPieceEnv", 180),
}
"""ManiSkill's id -> class, and control steps of an episode."""

METAWORLD = (
    "assembly", "basketball", "bin-picking", "box-close", "button-press", "button-press-topdown",
    "button-press-topdown-wall", "button-press-wall", "coffee-button", "coffee-pull", "coffee-push", "dial-turn",
    "disassemble", "door-close", "door-lock", "door-open", "door-unlock", "drawer-close", "drawer-open", "faucet-close",
    "faucet-open", "hammer", "hand-insert", "handle-press", "handle-press-side", "handle-pull", "handle-pull-side",
    "lever-pull", "peg-insert-side", "peg-unplug-side", "pick-out-of-hole", "pick-place", "pick-place-wall",
    "plate-slide", "plate-slide-back", "plate-slide-back-side", "plate-slide-side", "push", "push-back", "push-wall",
    "reach", "reach-wall", "shelf-place", "soccer", "stick-pull", "stick-push", "sweep", "sweep-into", "window-close",
    "window-open",
)  # fmt: skip
OURS = {
    "ur3e/slide-block": 120,
    "ur3e/stack-cube": 200,
    "ur3e/transfer-piece": 180,
    "adroit/door": 100,
    "adroit/hammer": 100,
    "adroit/pen": 50,
    **{f"metaworld/{name}": 200 for name in METAWORLD},
}
"""Our id -> control steps of an episode."""

_ENTRY = "manicm_ms.envs.gym_entry"


def register() -> None:
    """Make the ids known to Gymnasium; a second call does nothing."""
    for gym_id, (entry_point, steps) in MANISKILL.items():
        register_maniskill(gym_id, entry_point, steps)
    for env_id, steps in OURS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point=f"{_ENTRY}:env[{env_id}]",
                vector_entry_point=f"{_ENTRY}:vector_env[{env_id}]",
                max_episode_steps=steps,
            )


def register_maniskill(gym_id: str, entry_point: str, max_episode_steps: int) -> None:
    """Make a ManiSkill task known to Gymnasium as ManiSkill would, unless it is known; see `register_env`.

    Args:
        gym_id: for example "UR3eStackCube-v1".
        entry_point: module and class, "package.module:Class".
        max_episode_steps: control steps of an episode.
    """
    if gym_id in gymnasium.registry:
        return
    limit = WrapperSpec(
        "MSTimeLimit",
        entry_point="mani_skill.utils.registration:TimeLimitWrapper",
        kwargs={"max_episode_steps": max_episode_steps},
    )
    gymnasium.register(
        gym_id,
        entry_point=entry_point,
        # Gymnasium's make_vec takes no id that has a wrapper of its own, as ManiSkill's time limit is, and says so.
        # Without this line it would batch environments that are batched already.
        vector_entry_point=f"{_ENTRY}:vector_env[{gym_id}]",
        max_episode_steps=max_episode_steps,
        disable_env_checker=True,  # ManiSkill's environments are batched tensors
        additional_wrappers=(limit,),
    )
