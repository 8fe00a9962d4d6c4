"""Meta-World's experts: the suite's own scripts for all its tasks, clipped to what an action may be."""

import warnings
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from suite_rows import ROW, simulator, smooth_actions

if find_spec("metaworld") is None:
    pytest.skip("the MuJoCo suites are an extra, which is not installed", allow_module_level=True)

from manicm_ms.tasks.metaworld import TASKS

from manicm_ms.demos.collect import collect
from manicm_ms.demos.experts import EXPERTS
from manicm_ms.demos.store import DemoStore
from manicm_ms.envs.simulator import ENVS
from manicm_ms.errors import UnknownNameError
from manicm_ms.spec import STATE


def expert_of(env_id, num_envs=1, style=None):
    return EXPERTS.get(env_id)(ENVS.get(env_id).spec, num_envs, torch.device("cpu"), style)


def suite_action(task, state):
    """What the suite's own policy says to the state (39,), not clipped; its warnings of that are not ours."""
    from metaworld.policies import ENV_POLICY_MAP

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return ENV_POLICY_MAP[task.suite_id]().get_action(state.numpy().astype(np.float64))


def test_every_task_has_an_expert():
    assert len(TASKS) == 50
    assert {task.env_id for task in TASKS} == set(ENVS.names("metaworld")) <= set(EXPERTS.names())
    with pytest.raises(UnknownNameError, match="scripted"):
        expert_of("metaworld/reach", style="script")


@pytest.mark.filterwarnings("error")
def test_every_expert_acts_as_the_suite_s_policy_does_within_the_box():
    clipped = 0
    for k, task in enumerate(TASKS):
        states = []
        with simulator(task.env_id, seed=k, obs=(STATE,)) as rows:
            for action in smooth_actions(4, 4, seed=k):
                states.append(rows.observe()[STATE][0])
                rows.step(action)
        states = torch.stack(states)
        theirs = np.stack([suite_action(task, state) for state in states])
        actions = expert_of(task.env_id, len(states)).act(states)
        assert actions.dtype == torch.float32
        np.testing.assert_array_equal(actions.numpy(), np.clip(theirs, -1, 1), strict=True, err_msg=task.env_id)
        clipped += int((np.abs(theirs) > 1).sum())
    assert clipped > 50, "the scripts do ask for more than the box holds"


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("env_id", ["metaworld/lever-pull", "metaworld/pick-place", "metaworld/stick-push"])
def test_tasks_are_solved(env_id):
    with simulator(env_id, obs=(STATE,)) as rows:
        expert = expert_of(env_id)
        for seed in (1, 2):
            rows.reset(ROW, [seed])
            expert.reset(rows.observe()[STATE], [seed], torch.ones(1, dtype=torch.bool))
            successes = 0
            for _ in range(rows.spec.max_episode_steps):
                action = expert.act(rows.observe()[STATE])
                assert action.abs().max() <= 1
                successes = rows.step(action).info["success_steps"].item()
                if successes >= ENVS.get(env_id).demos.success_steps:
                    break
            assert successes == ENVS.get(env_id).demos.success_steps == 5


def test_a_demonstration_is_cut_behind_its_success(tmp_path):
    made = collect("metaworld/coffee-button", 2, tmp_path / "a.zarr", num_envs=2, extras=("privileged_state",))
    with DemoStore.open(made.path) as store:
        assert (store.provenance["expert"], store.provenance["style"]) == ("Meta-World script", "scripted")
        assert (store.provenance["success_steps"], store.provenance["tail_steps"]) == (5, 8)
        for k, seed in enumerate(store.seeds.tolist()):
            episode = store.episode(k)
            task = next(task for task in TASKS if task.env_id == "metaworld/coffee-button")
            theirs = [suite_action(task, torch.from_numpy(state)) for state in episode.privileged_state]
            np.testing.assert_array_equal(episode.action, np.clip(theirs, -1, 1))
            with simulator("metaworld/coffee-button", seed=seed, obs=(STATE,)) as rows:
                played = [rows.step(torch.from_numpy(action)[None]).info["success"].item() for action in episode.action]
            assert len(episode) == played.index(True) + 1 + 8
            assert sum(played) >= 5
