"""Meta-World: the 50 manipulation tasks of a Sawyer arm, 28 of them part of ManiCM's benchmark."""

from __future__ import annotations

import warnings
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from manicm_ms.demos.experts import EXPERTS, RowPolicy, RowwiseExpertFactory
from manicm_ms.envs.mujoco_task import (
    DP3,
    MANICM_MS,
    Dp3Frame,
    FixedPose,
    MujocoTask,
    Outcome,
    View,
    layout,
    require_suite,
    sample_or_pad_with_zeros,
)
from manicm_ms.envs.simulator import ENVS, DemoRule, EnvEntry, Simulator, SimulatorConfig
from manicm_ms.machine import mujoco_gl
from manicm_ms.sensing.point_cloud import Box
from manicm_ms.spec import ActionSpec, EnvSpec

if TYPE_CHECKING:
    import mujoco

# ---- what all tasks share -------------------------------------------------------------------------------------

CONTROL_HZ = 80.0  # 5 physics steps of 2.5 ms
MAX_EPISODE_STEPS = 200  # control steps; the suite's own limit is 500
DEMO_SUCCESS_STEPS = 5  # DP3's filter
CAMERA = "corner2"
EYE = (0.6, 0.295, 0.8)  # m; DP3's, beside the arm and nearer than the suite's own
UPRIGHT = (
    0.76536295,
    0.43493704,
    0.26266734,
    0.39503823,
)  # the suite's corner2, which stands on its head, rolled 180 deg
REWARD_SCALE = 10.0

ACTION = ActionSpec(("dx [m]", "dy [m]", "dz [m]", "gripper effort [1]"), "mocap_delta_position", CONTROL_HZ)
AGENT_POS_NAMES = tuple(
    f"{part}_{axis} [m]" for part in ("hand", "right_finger", "left_finger") for axis in ("x", "y", "z")
)
_FRAME_PARTS = {"hand_position": 3, "gripper_opening": 1, "first_position": 3, "first_quat": 4, "second_position": 3,
                "second_quat": 4}  # fmt: skip
STATE_LAYOUT = layout(**_FRAME_PARTS, **{f"previous_{name}": n for name, n in _FRAME_PARTS.items()}, goal_position=3)
"""The suite's goal-observable observation. "first" and "second" are the task's objects, the second often absent (0); a
quaternion's order is the task's own."""

# The table's top is z = 0, and a ledge of 12 cm runs around it: what stands on it, and the arm above it, is kept.
LOW, HIGH = (-0.675, 0.225, 0.005), (0.675, 0.975, 0.8)
TABLE = (Box(LOW, HIGH),)
# Another table, 5 cm higher and without the ledge, with a hole that holds the goal.
TABLE_WITH_HOLE = (Box((*LOW[:2], 0.055), HIGH), Box((-0.079, 0.761, -0.045), (0.079, 0.919, 0.055)))
# A slab of 5.4 cm on the table, and a pit in it where the object lies.
TABLE_WITH_PIT = (Box((*LOW[:2], 0.059), HIGH), Box((-0.149, 0.651, 0.005), (0.149, 0.949, 0.059)))
DP3_WORKSPACE = Box((-0.5, -1.5, -0.795), (1.0, -0.4, 100.0))


def _dp3_rotation() -> Any:
    """Return the wrapper's `pc_transform`: about x by 61.4 deg and y by -7 deg, found by eye there."""
    x, y = np.deg2rad(61.4), np.deg2rad(-7.0)
    about_x = np.array([[1, 0, 0], [0, np.cos(x), np.sin(x)], [0, -np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    return tuple(map(tuple, (about_x @ about_y).tolist()))


DP3_VIEW = View(
    camera=CAMERA,
    pose=FixedPose(position=EYE),
    workspace=(DP3_WORKSPACE,),
    frame=Dp3Frame(_dp3_rotation()),
    size=(128, 128),
    pixel_centre=0.0,
    clip=(0.1, 1.5),
    solid=False,
    sampler=sample_or_pad_with_zeros,
)


# ---- the table ------------------------------------------------------------------------------------------------


def _task(name: str, group: str, benchmark: bool = False, workspace: tuple[Box, ...] = TABLE) -> MujocoTask:
    return MujocoTask(
        env_id=f"metaworld/{name}",
        suite_id=f"{name}-v3",
        group=group,
        views={
            MANICM_MS: View(CAMERA, workspace, FixedPose(EYE, UPRIGHT)),
            DP3: DP3_VIEW,
        },
        video=(CAMERA, FixedPose(EYE, UPRIGHT)),
        agent_pos_names=AGENT_POS_NAMES,
        state_layout=STATE_LAYOUT,
        action=ACTION,
        max_episode_steps=MAX_EPISODE_STEPS,
        action_repeat=1,
        success_rule="any",
        demo_success_steps=DEMO_SUCCESS_STEPS,
        tcp_indices=(0, 1, 2),  # the hand, whose orientation never changes
        benchmark=benchmark,
        former_names=(name, *(f"{prefix}{name}-v{v}" for v in (2, 3) for prefix in ("", "metaworld/"))),
    )


EASY, MEDIUM, HARD, VERY_HARD = "easy", "medium", "hard", "very-hard"
# Groups: DP3's split of the 50 tasks. `benchmark=True`: ManiCM's 28 (docs/results/suites.md says from what).
TASKS = (
    _task("button-press", EASY, benchmark=True),
    _task("button-press-topdown", EASY),
    _task("button-press-topdown-wall", EASY),
    _task("button-press-wall", EASY, benchmark=True),
    _task("coffee-button", EASY, benchmark=True),
    _task("dial-turn", EASY, benchmark=True),
    _task("door-close", EASY, benchmark=True),
    _task("door-lock", EASY),
    _task("door-open", EASY, benchmark=True),
    _task("door-unlock", EASY),
    _task("drawer-close", EASY, benchmark=True),
    _task("drawer-open", EASY),
    _task("faucet-close", EASY),
    _task("faucet-open", EASY, benchmark=True),
    _task("handle-press", EASY),
    _task("handle-press-side", EASY, benchmark=True),
    _task("handle-pull", EASY, benchmark=True),
    _task("handle-pull-side", EASY, benchmark=True),
    _task("lever-pull", EASY, benchmark=True),
    _task("peg-unplug-side", EASY, benchmark=True),
    _task("plate-slide", EASY, benchmark=True),
    _task("plate-slide-back", EASY),
    _task("plate-slide-back-side", EASY, benchmark=True),
    _task("plate-slide-side", EASY),
    _task("reach", EASY, benchmark=True),
    _task("reach-wall", EASY, benchmark=True),
    _task("window-close", EASY, benchmark=True),
    _task("window-open", EASY),
    _task("basketball", MEDIUM),
    _task("bin-picking", MEDIUM),
    _task("box-close", MEDIUM, benchmark=True),
    _task("coffee-pull", MEDIUM),
    _task("coffee-push", MEDIUM),
    _task("hammer", MEDIUM),
    _task("peg-insert-side", MEDIUM),
    _task("push-wall", MEDIUM),
    _task("soccer", MEDIUM, benchmark=True),
    _task("sweep", MEDIUM),
    _task("sweep-into", MEDIUM, benchmark=True, workspace=TABLE_WITH_HOLE),
    _task("assembly", HARD),
    _task("hand-insert", HARD, benchmark=True, workspace=TABLE_WITH_HOLE),
    _task("pick-out-of-hole", HARD, benchmark=True, workspace=TABLE_WITH_PIT),
    _task("pick-place", HARD, benchmark=True),
    _task("push", HARD),
    _task("push-back", HARD),
    _task("disassemble", VERY_HARD),
    _task("pick-place-wall", VERY_HARD, benchmark=True),
    _task("shelf-place", VERY_HARD, benchmark=True),
    _task("stick-pull", VERY_HARD, benchmark=True),
    _task("stick-push", VERY_HARD, benchmark=True),
)


# ---- the suite's environments ---------------------------------------------------------------------------------


class MetaWorldEnv:
    """A Meta-World v3 environment as a `SuiteEnv`: goals in the state, episodes that follow from their seed.

    **Randomisation**: as the suite's, from the seed alone. Its `reset(seed=)` ignores the seed and draws from a fixed
    list of goals; `seed()` with `seeded_rand_vec` is what it offers instead.

    **Success**: the suite's, at some step.
    """

    reward_scale: float | None = REWARD_SCALE

    def __init__(self, task: MujocoTask) -> None:
        require_suite("metaworld")
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE

        from manicm_ms.envs.mujoco import update_derived  # imports mujoco

        self._update = update_derived
        make: Any = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task.suite_id}-goal-observable"]
        self._env = make(seed=0)  # any seed: without one, building draws from NumPy's global generator
        self._env._freeze_rand_vec = False
        self._env.seeded_rand_vec = True
        self.model: mujoco.MjModel = self._env.model
        self.data: mujoco.MjData = self._env.data
        self._previous = np.zeros(18)  # the part of the state that tells of the frame before

    def reset(self, seed: int) -> None:
        """See `SuiteEnv.reset`."""
        self._env.seed(seed)
        self._env.reset()
        self._update(self.model, self.data)  # the suite moves the goal's marker in the model and leaves it at that
        self._previous = self._env._prev_obs = self._env._get_curr_obs_combined_no_goal()

    def step(self, action: NDArray[np.float64]) -> Outcome:
        """See `SuiteEnv.step`."""
        self._previous = self._env._prev_obs
        _, reward, _, _, info = self._env.step(action)
        success = bool(info["success"])
        return Outcome(success, False, float(reward), int(success), {})

    def agent_pos(self) -> NDArray[np.float64]:
        """Return where hand, right and left finger are, (9,), metres, world frame."""
        fingers = [self.data.site(name).xpos for name in ("rightEndEffector", "leftEndEffector")]
        return np.concatenate([self.data.body("hand").xpos, *fingers])

    def state(self) -> NDArray[np.float64]:
        """See `SuiteEnv.state`: this frame, the one before, and the goal, (39,)."""
        now = self._env._get_curr_obs_combined_no_goal()
        space = self._env.sawyer_observation_space
        return np.clip(np.concatenate([now, self._previous, self._env._get_pos_goal()]), space.low, space.high)

    def save(self) -> dict[str, NDArray[Any]]:
        """See `SuiteEnv.save`."""
        return {"previous": self._previous.copy(), "elapsed": np.array(self._env.curr_path_length)}

    def restore(self, saved: dict[str, NDArray[Any]]) -> None:
        """See `SuiteEnv.restore`."""
        self._previous = saved["previous"].copy()
        self._env._prev_obs = self._env._get_curr_obs_combined_no_goal()
        self._env.curr_path_length = int(saved["elapsed"])

    def close(self) -> None:
        """See `SuiteEnv.close`."""
        self._env.close()


def build(spec: EnvSpec, config: SimulatorConfig, task: MujocoTask) -> Simulator:
    """Return a simulator of the table's row `task`."""
    from manicm_ms.envs.mujoco import MujocoSimulator  # imports mujoco: not wanted where tasks are only listed

    return MujocoSimulator(spec, config, task, MetaWorldEnv(task))


for _row in TASKS:
    ENVS.add(
        _row.env_id,
        EnvEntry(
            _row.spec,
            partial(build, task=_row),
            __name__,
            backends=("cpu",),
            obs_presets=(MANICM_MS, DP3),
            has_realism=False,
            group=_row.group,
            seed_limit=2**63,  # their random streams take any; stores keep 64 bits
            preload=("manicm_ms.envs.mujoco", "metaworld.env_dict"),
            demos=DemoRule(_row.demo_success_steps),
        ),
        tags=_row.tags,
        former=_row.former_names,
    )


# ---- experts --------------------------------------------------------------------------------------------------


def _scripted_policy(suite_id: str) -> RowPolicy:
    """Return the suite's scripted policy of one of its environments."""
    require_suite("metaworld")
    mujoco_gl.prepare()  # before mujoco is first imported
    from metaworld.policies import ENV_POLICY_MAP

    make: Any = ENV_POLICY_MAP[suite_id]
    policy = make()

    def act(state: NDArray[np.float64]) -> NDArray[np.float32]:
        with warnings.catch_warnings():  # it warns of actions beyond the box, which are clipped here
            warnings.simplefilter("ignore", UserWarning)
            return policy.get_action(state)

    return act


for _row in TASKS:
    EXPERTS.add(
        _row.env_id, RowwiseExpertFactory(partial(_scripted_policy, _row.suite_id), "Meta-World script", ("scripted",))
    )
