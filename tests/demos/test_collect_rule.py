"""Which episodes become demonstrations and where they are cut: a task's own rule, and what stores remember of it."""

import json

import pytest
from toy_blinker import ENV_ID, LAST_ID, MAX_STEPS, RULE, TWICE_ID, Onlooker
from toy_point_mass import ENV_ID as POINT_MASS

from manicm_ms.demos.attempts import Collector
from manicm_ms.demos.collect import collect, collect_episodes
from manicm_ms.demos.store import DemoStore
from manicm_ms.envs.gpu_vec_env import GpuVecEnv
from manicm_ms.envs.simulator import ENVS, DemoRule, SimulatorConfig
from manicm_ms.errors import ConfigError, StoreError
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, STATE


def attempts(rule, env_id=ENV_ID, first_seed=0, wanted=3, num_envs=2):
    """seed -> length of the episode, or why there is none; rows in this process."""
    entry = ENVS.get(env_id)
    config = SimulatorConfig(num_rows=num_envs, obs=(POINT_CLOUD, AGENT_POS, STATE))
    env = GpuVecEnv(entry, entry.spec, num_envs, config, None)
    collector = Collector(env, Onlooker(entry.spec, num_envs, env.device, None), rule=rule)
    tried = {a.seed: a.reason if a.episode is None else len(a.episode) for a in collector.attempts(first_seed, wanted)}
    env.close()
    return tried


@pytest.mark.parametrize("num_envs", [1, 3])
def test_an_episode_is_cut_behind_its_first_success_once_it_holds_enough_of_them(num_envs):
    assert attempts(DemoRule(success_steps=3, tail_steps=4), num_envs=num_envs) == {
        0: 7,  # solved at step 3, and three times by 5: four more steps
        1: 11,  # solved once by the tail's end: plays on until the third time
        2: "2 successful steps, of which 3 are wanted",
        3: f"not solved in {MAX_STEPS} steps",
        4: MAX_STEPS,  # solved three times, and out of time before the tail's end
    }


def test_one_successful_step_is_wanted_where_no_rule_is_given():
    assert attempts(DemoRule()) == {0: 11, 1: 11, 2: 11}
    assert attempts(DemoRule(tail_steps=0)) == {0: 3, 1: 3, 2: 3}
    assert attempts(DemoRule(success_steps=2, tail_steps=0), wanted=2) == {0: 4, 1: 10}


def test_more_than_any_episode_holds_keeps_none():
    reasons = attempts(DemoRule(success_steps=6, tail_steps=4), wanted=1, first_seed=1)
    assert reasons == {
        1: "4 successful steps, of which 6 are wanted",
        2: "2 successful steps, of which 6 are wanted",
        3: f"not solved in {MAX_STEPS} steps",
        4: "4 successful steps, of which 6 are wanted",
        5: 8,
    }


def test_environment_steps_count_where_the_simulator_counts_them():
    tried = attempts(DemoRule(success_steps=6, tail_steps=4), TWICE_ID, wanted=3)
    assert tried == {0: 7, 1: 11, 2: "4 successful steps, of which 6 are wanted", 3: "not solved in 20 steps", 4: 20}


def test_success_at_the_end_is_wanted_where_the_spec_says_so():
    whole = DemoRule(success_steps=3, tail_steps=MAX_STEPS)
    assert attempts(whole, LAST_ID, wanted=1) == dict.fromkeys(range(4), "not solved in 20 steps") | {4: MAX_STEPS}
    cut = DemoRule(success_steps=3, tail_steps=4)
    assert attempts(cut, LAST_ID, wanted=1) == {0: 7}, "solved at the end of what is kept"


def test_a_negative_tail_is_refused():
    with pytest.raises(ConfigError, match="tail_steps must not be negative, got -1"):
        attempts(DemoRule(tail_steps=-1))


# ---- stores ---------------------------------------------------------------------------------------------------------


def lengths_and_provenance(path):
    with DemoStore.open(path) as store:
        return store.lengths.tolist(), store.provenance


def forget(path, *names):
    """Make a store one of before these were recorded."""
    attrs = json.loads((path / ".zattrs").read_text())
    for name in names:
        del attrs["provenance"][name]
    (path / ".zattrs").write_text(json.dumps(attrs))


def test_the_task_s_own_rule_holds_unless_another_tail_is_asked_for(tmp_path):
    own, other = tmp_path / "own.zarr", tmp_path / "other.zarr"
    collect(ENV_ID, 3, own, num_envs=2)
    lengths, provenance = lengths_and_provenance(own)
    assert lengths == [7, 11, MAX_STEPS]
    assert (provenance["success_steps"], provenance["tail_steps"]) == (3, 4) == (RULE.success_steps, RULE.tail_steps)
    assert "--tail-steps" not in provenance["command"]
    assert collect(ENV_ID, 3, own, tail_steps=4).added == 0, "asked for by number it is the same"
    with pytest.raises(StoreError, match="tail_steps 4 where 6 is asked for"):
        collect(ENV_ID, 4, own, tail_steps=6)

    collect(ENV_ID, 2, other, tail_steps=6)
    lengths, provenance = lengths_and_provenance(other)
    assert lengths == [9, 11]
    assert (provenance["success_steps"], provenance["tail_steps"]) == (3, 6)
    assert "--tail-steps 6" in provenance["command"]
    with pytest.raises(StoreError, match="tail_steps 6 where 4 is asked for"):
        collect(ENV_ID, 2, other)
    assert [len(e) for e in collect_episodes(ENV_ID, 2, tail_steps=6)] == [9, 11]


def test_a_store_of_another_rule_is_not_continued(tmp_path):
    out = tmp_path / "a.zarr"
    collect(ENV_ID, 1, out)
    forget(out, "success_steps")  # what it meant then: one
    with pytest.raises(StoreError, match="success_steps 1 where 3 is asked for"):
        collect(ENV_ID, 1, out)


@pytest.mark.parametrize("episodes", [2, 4])
def test_a_store_of_before_rules_and_presets_were_recorded_goes_on(tmp_path, episodes):
    old, new = tmp_path / "old.zarr", tmp_path / "new.zarr"
    for path in (old, new):
        collect(POINT_MASS, 2, path, seed=100)
    forget(old, "success_steps", "obs_preset")
    assert collect(POINT_MASS, episodes, old, seed=100, num_envs=2).added == episodes - 2
    collect(POINT_MASS, episodes, new, seed=100)
    assert lengths_and_provenance(old)[0] == lengths_and_provenance(new)[0]
    with DemoStore.open(old) as ours, DemoStore.open(new) as theirs:
        assert ours.frames("action").tobytes() == theirs.frames("action").tobytes()


def test_another_preset_of_observations_does_not_go_on(tmp_path):
    out = tmp_path / "a.zarr"
    collect(ENV_ID, 1, out, obs_preset="dp3")
    with DemoStore.open(out) as store:
        assert store.spec.obs.frame == "dp3"
        assert store.provenance["obs_preset"] == "dp3"
        assert "--obs-preset dp3" in store.provenance["command"]
    for episodes in (1, 2):
        with pytest.raises(StoreError, match="obs_preset 'dp3' where 'manicm_ms' is asked for"):
            collect(ENV_ID, episodes, out)
    assert collect(ENV_ID, 2, out, obs_preset="dp3").added == 1
    with pytest.raises(ConfigError, match="has no obs_preset 'dp3'"):
        collect(POINT_MASS, 1, tmp_path / "b.zarr", obs_preset="dp3")
    assert not (tmp_path / "b.zarr").exists()
