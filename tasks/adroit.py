"""Adroit: a dexterous hand that opens a door, drives a nail with a hammer and turns a pen."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr
from dataclasses import dataclass
from functools import partial
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from manicm_ms.demos import inert_pickle
from manicm_ms.demos.expert_files import EXPERT_FILES, Arrays, ExpertFile, load_arrays
from manicm_ms.demos.experts import EXPERTS, RowPolicy, RowwiseExpertFactory
from manicm_ms.envs.mujoco_task import (
    DP3,
    MANICM_MS,
    Dp3Frame,
    FixedPose,
    Matrix3,
    MujocoTask,
    Outcome,
    View,
    layout,
    require_suite,
    sample_or_pad_with_zeros,
)
from manicm_ms.envs.simulator import ENVS, DemoRule, EnvEntry, Simulator, SimulatorConfig
from manicm_ms.errors import ExpertFileError
from manicm_ms.sensing.point_cloud import Box
from manicm_ms.spec import ActionSpec, EnvSpec

if TYPE_CHECKING:
    import mujoco

# ---- what the tasks share -------------------------------------------------------------------------------------

CONTROL_HZ = 50.0  # 5 physics steps of 2 ms, and every action is held for two of those
ACTION_REPEAT = 2  # DP3's
DEMO_SUCCESS_STEPS = 10  # DP3's filter, environment steps

ARM_JOINTS = ("ARTz", "ARRx", "ARRy", "ARRz")
HAND_JOINTS = (
    "WRJ1", "WRJ0",
    "FFJ3", "FFJ2", "FFJ1", "FFJ0", "MFJ3", "MFJ2", "MFJ1", "MFJ0", "RFJ3", "RFJ2", "RFJ1", "RFJ0",
    "LFJ4", "LFJ3", "LFJ2", "LFJ1", "LFJ0", "THJ4", "THJ3", "THJ2", "THJ1", "THJ0",
)  # fmt: skip
AGENT_POS_NAMES = tuple(f"{name} [rad]" for name in HAND_JOINTS)

# Of DP3's copy of the suite; this one's vil_camera, put there, takes their place.
CAMERA = "vil_camera"
FACING_DOWN = (0.000796, 0.0, 0.0, 0.9999997)
DOOR_POSE = FixedPose((0.0, 0.0, 1.5), FACING_DOWN)
HAMMER_POSE = FixedPose((0.0, 0.0, 1.1), FACING_DOWN)
PEN_POSE = FixedPose((0.0, -0.8, 0.8), (0.92388, 0.382683, 0.0, 0.0))

_HALF = float(np.sqrt(0.5))
DP3_TURN: Matrix3 = ((1.0, 0.0, 0.0), (0.0, _HALF, _HALF), (0.0, -_HALF, _HALF))
"""The wrapper's transform for door and hammer: undoes the 45 deg of the model's first camera."""
NO_TURN: Matrix3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True, kw_only=True)
class AdroitTask(MujocoTask):
    """A row of the table.

    Attributes:
        env_class: module and name of the suite's class, under gymnasium_robotics.envs.adroit_hand.
        dp3_success: (environment, its info) -> success by the thresholds of DP3's copy of the suite.
        dropped_below: height, metres, below which the object is lost and the episode over; None: it never is.
    """

    env_class: str
    dp3_success: Callable[[Any, dict[str, Any]], bool]
    dropped_below: float | None = None


def suite_success(env: Any, info: dict[str, Any]) -> bool:
    """Return what the suite itself calls success."""
    return bool(info["success"])


def _dp3_door_success(env: Any, info: dict[str, Any]) -> bool:
    return bool(env.data.qpos[env.door_hinge_addrs] > 1.4)  # rad; the suite's own threshold is 1.35


def _dp3_pen_success(env: Any, info: dict[str, Any]) -> bool:
    """Return whether the pen points as the target does, wherever it is (the suite also wants it within 75 mm)."""
    tip = env.data.site_xpos
    pen = (tip[env.obj_t_site_id] - tip[env.obj_b_site_id]) / env.pen_length
    target = (tip[env.tar_t_site_id] - tip[env.tar_b_site_id]) / env.tar_length
    return bool(pen @ target > 0.95)


def _views(pose: FixedPose, workspace: Box, frame: Dp3Frame, dp3_floor: float) -> dict[str, View]:
    dp3 = View(
        camera=CAMERA,
        pose=pose,
        workspace=(Box((-10.0, -10.0, dp3_floor), (10.0, 10.0, 10.0)),),
        frame=frame,
        size=(84, 84),
        pixel_centre=0.0,
        solid=False,
        sampler=sample_or_pad_with_zeros,
    )
    return {MANICM_MS: View(CAMERA, (workspace,), pose), DP3: dp3}


def _task(name: str, arm_joints: tuple[str, ...], steps: int, **fields: Any) -> AdroitTask:
    actions = tuple(f"{joint} [{'m' if joint.startswith('ART') else 'rad'}]" for joint in (*arm_joints, *HAND_JOINTS))
    title = name.capitalize()
    return AdroitTask(
        env_id=f"adroit/{name}",
        suite_id=f"AdroitHand{title}-v1",
        group="adroit",
        video=("fixed", FixedPose()),
        agent_pos_names=AGENT_POS_NAMES,
        action=ActionSpec(actions, "absolute_position", CONTROL_HZ),
        max_episode_steps=steps,
        action_repeat=ACTION_REPEAT,
        success_rule="last",
        demo_success_steps=DEMO_SUCCESS_STEPS,
        benchmark=True,
        former_names=(f"AdroitHand{title}-v1", f"{name}-v0", f"adroit_{name}", f"adroit/{name}-v1"),
        env_class=f"adroit_{name}.AdroitHand{title}Env",
        **fields,
    )


# ---- the table ------------------------------------------------------------------------------------------------

# Table tops are z = 0; what lies lower, or far beside, is table and floor.
TASKS = (
    _task(
        "door",
        ARM_JOINTS,
        steps=100,
        views=_views(DOOR_POSE, Box((-1, -1, 0.005), (1, 1, 1.4)), Dp3Frame(DP3_TURN, (0.0, 0.0, 1.0)), -0.499),
        state_layout=layout(
            arm_and_hand_qpos=27, latch=1, hinge=1, palm_position=3, handle_position=3, palm_from_handle=3, is_open=1
        ),
        dp3_success=_dp3_door_success,
    ),
    _task(
        "hammer",
        ARM_JOINTS[1:3],
        steps=100,
        views=_views(HAMMER_POSE, Box((-1, -1, 0.005), (1, 1, 1.0)), Dp3Frame(DP3_TURN, (0.0, 0.0, 1.0)), -0.099),
        state_layout=layout(
            arm_hand_and_nail_qpos=27, hammer_velocity=6, palm_position=3, hammer_position=3, hammer_euler=3,
            nail_position=3, nail_impact=1,
        ),
        dp3_success=suite_success,
    ),
    _task(
        "pen",
        (),
        steps=50,
        views=_views(PEN_POSE, Box((-1, -1, 0.005), (1, 1, 1.0)), Dp3Frame(NO_TURN), -0.79),
        state_layout=layout(
            hand_qpos=24, pen_position=3, pen_velocity=6, pen_direction=3, target_direction=3, pen_from_target=3,
            direction_error=3,
        ),
        dp3_success=_dp3_pen_success,
        dropped_below=0.075,
    ),
)  # fmt: skip


# ---- the suite's environments ---------------------------------------------------------------------------------


class AdroitEnv:
    """An Adroit v1 environment of gymnasium-robotics as a `SuiteEnv`.

    The suite leaves positions of bodies and sites one physics step (2 ms) behind the joints. Here they are brought up
    to date before a frame is observed: hand and object are 2 to 11 mm from where the suite's own picture has them.

    **Randomisation**: the suite's: where door or nail board stand, which way the pen is to point.

    **Success**: the suite's, or with the `dp3` preset DP3's thresholds; it must hold at the end. **Failure**: the pen
    was dropped.
    """

    reward_scale: float | None = None

    def __init__(self, task: AdroitTask, preset: str) -> None:
        require_suite("gymnasium-robotics")
        from manicm_ms.envs.mujoco import update_derived  # imports mujoco

        module, name = task.env_class.split(".")
        with redirect_stderr(StringIO()):  # the package prints a notice about rewards when it is imported
            suite = importlib.import_module(f"gymnasium_robotics.envs.adroit_hand.{module}")
        self._task, self._update = task, update_derived
        self._env = getattr(suite, name)()
        self._is_success = suite_success if preset == MANICM_MS else task.dp3_success
        self.model: mujoco.MjModel = self._env.model
        self.data: mujoco.MjData = self._env.data
        self._hand_qpos = [int(self.model.joint(joint).qposadr[0]) for joint in HAND_JOINTS]
        self._last_success = False

    def reset(self, seed: int) -> None:
        """See `SuiteEnv.reset`."""
        self._env.reset(seed=seed)
        self._last_success = False
        self._update(self.model, self.data)

    def step(self, action: NDArray[np.float64]) -> Outcome:
        """See `SuiteEnv.step`; the fact "success_last_two" is DP3's figure: the mean over two control steps."""
        reward, successes, dropped = 0.0, [], False
        for _ in range(self._task.action_repeat):
            _, step_reward, _, _, info = self._env.step(action)
            reward += float(step_reward)
            successes.append(self._is_success(self._env, info))
            dropped = self._dropped()
            if dropped:
                break
        self._update(self.model, self.data)
        success, before = successes[-1], self._last_success
        self._last_success = success
        return Outcome(success, dropped, reward, sum(successes), {"success_last_two": (success + before) / 2})

    def _dropped(self) -> bool:
        limit = self._task.dropped_below
        return limit is not None and bool(self.data.xpos[self._env.obj_body_id, 2] < limit)

    def agent_pos(self) -> NDArray[np.float64]:
        """Return the hand's joint angles (24,), rad."""
        return self.data.qpos[self._hand_qpos]

    def state(self) -> NDArray[np.float64]:
        """See `SuiteEnv.state`: the suite's own observation, which the DAPG policies read."""
        return np.asarray(self._env._get_obs())

    def save(self) -> dict[str, NDArray[Any]]:
        """See `SuiteEnv.save`."""
        return {"last_success": np.array(self._last_success)}

    def restore(self, saved: dict[str, NDArray[Any]]) -> None:
        """See `SuiteEnv.restore`."""
        self._last_success = bool(saved["last_success"])

    def close(self) -> None:
        """See `SuiteEnv.close`."""
        self._env.close()


def build(spec: EnvSpec, config: SimulatorConfig, task: AdroitTask) -> Simulator:
    """Return a simulator of the table's row `task`."""
    from manicm_ms.envs.mujoco import MujocoSimulator  # imports mujoco: not wanted where tasks are only listed

    return MujocoSimulator(spec, config, task, AdroitEnv(task, config.obs_preset))


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
            preload=("manicm_ms.envs.mujoco", "gymnasium.envs.mujoco.mujoco_env"),
            # Never cut: success must hold at the end, so a policy has to see how it is held.
            demos=DemoRule(_row.demo_success_steps, tail_steps=_row.max_episode_steps),
        ),
        tags=_row.tags,
        former=_row.former_names,
    )


# ---- experts --------------------------------------------------------------------------------------------------

_DAPG = "https://raw.githubusercontent.com/aravindr93/hand_dapg/9a1de23df6574e1b94e1da742e3326eb1f61c013"
_DAPG_CREDIT = (
    "Policies of Rajeswaran et al., Learning Complex Dexterous Manipulation with Deep Reinforcement Learning and "
    "Demonstrations, RSS 2018 (hand_dapg)."
)
_DAPG_LICENCE_SHA256 = "c71d239df91726fc519c6eb72d318ec65820627232b2f796219e87dcf35d0ab4"
# task: (SHA-256 of the published pickle, digest of the arrays in it)
_DAPG_SHA256 = {
    "door": (
        "288dd2131b905e40852d9eb032595bb9b3aa90b0502e9341e6b0e128b803478f",
        "0aacb53fd0e27dce5b4ad14fad621873140a036c5ceb8b8852f6f0c037202f06",
    ),
    "hammer": (
        "14c6b603af09acf87247f8b45d58f9671790d8e4ca0c48c8db5e1f7c98126ef4",
        "dc2fab50bd23c6699357a71bb61ac4a9dec8bc0735e77ac7a296ae8348282514",
    ),
    "pen": (
        "061dba4907a76b83139ae5a8d0809faa9774dd028d12ce869036b620bd728740",
        "1b7b3f77fd3b8befe0c896dc4a69981f77dc40007bde6d757edfee481b532b7f",
    ),
}
_SCALINGS = {"in_shift": 0.0, "in_scale": 1.0, "out_shift": 0.0, "out_scale": 1.0}  # and what they are if not set


def read_dapg(content: bytes) -> Arrays:
    """Return the mean network of a DAPG policy's pickle, of which nothing is executed.

    Returns:
        float32 `w0`, `b0`, `w1`, ... (out, in) and (out,), `in_shift`, `in_scale` (S,), `out_shift`, `out_scale` (Da,),
        and `n_layers`.

    Raises ExpertFileError where it is another kind of file.
    """
    model = inert_pickle.attributes(inert_pickle.describe(content)).get("model")
    layers = list(_linear_layers(model))
    if not layers:
        raise ExpertFileError("the pickle holds no policy of DAPG: its attribute 'model' has no linear layers")
    arrays: Arrays = {}
    for k, (weight, bias) in enumerate(layers):
        inputs = layers[k - 1][1].shape if k else weight.shape[-1:]
        if weight.shape != bias.shape + inputs or weight.ndim != 2:
            raise ExpertFileError(f"layer {k} of the pickled policy has weights {weight.shape} and a bias {bias.shape}")
        arrays |= {f"w{k}": weight.astype(np.float32), f"b{k}": bias.astype(np.float32)}
    sizes = {"in": layers[0][0].shape[1], "out": layers[-1][0].shape[0]}
    kept = inert_pickle.attributes(model)
    for name, default in _SCALINGS.items():
        found = inert_pickle.tensor(kept.get(name))
        size = sizes[name.partition("_")[0]]
        arrays[name] = np.full(size, default, np.float32) if found is None else found.reshape(-1).astype(np.float32)
        if len(arrays[name]) != size:
            raise ExpertFileError(f"{name} of the pickled policy has {len(arrays[name])} entries instead of {size}")
    return arrays | {"n_layers": np.array(len(layers))}


def _linear_layers(module: Any) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
    """Yield weight and bias of the linear layers of a described torch module, in order."""
    waiting, seen = [module], set()
    while waiting:
        module = waiting.pop()
        if id(module) in seen:
            continue
        seen.add(id(module))
        kept = inert_pickle.attributes(module)
        parameters = inert_pickle.entries(kept.get("_parameters"))
        weight, bias = (inert_pickle.tensor(parameters.get(name)) for name in ("weight", "bias"))
        if weight is not None and bias is not None:
            yield weight, bias
        waiting += reversed(inert_pickle.entries(kept.get("_modules")).values())


def _dapg_policy(env_id: str) -> RowPolicy:
    """Return the deterministic mean of a DAPG policy: tanh between layers; its 1e-8 is the published code's."""
    arrays = {name: array.astype(np.float64) for name, array in load_arrays(env_id).items()}
    count = int(arrays["n_layers"])

    def act(state: NDArray[np.float64]) -> NDArray[np.float64]:
        hidden = (state - arrays["in_shift"]) / (arrays["in_scale"] + 1e-8)
        for k in range(count):
            hidden = arrays[f"w{k}"] @ hidden + arrays[f"b{k}"]
            hidden = np.tanh(hidden) if k < count - 1 else hidden
        return hidden * arrays["out_scale"] + arrays["out_shift"]

    return act


for _row in TASKS:
    _name = _row.env_id.partition("/")[2]
    _source, _arrays = _DAPG_SHA256[_name]
    EXPERT_FILES.add(
        _row.env_id,
        ExpertFile(
            _row.env_id, f"{_DAPG}/dapg/policies/{_name}-v0.pickle", _source, read_dapg, _arrays,
            "Apache-2.0", f"{_DAPG}/LICENSE", _DAPG_LICENCE_SHA256, _DAPG_CREDIT,
        ),
    )  # fmt: skip
    EXPERTS.add(_row.env_id, RowwiseExpertFactory(partial(_dapg_policy, _row.env_id), "DAPG policy", ("dapg",)))
