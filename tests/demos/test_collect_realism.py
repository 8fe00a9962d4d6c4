"""Collecting under a realism preset, for real: what was drawn is stored, and another preset does not go on."""

import pytest

from manicm_ms.demos.collect import collect
from manicm_ms.demos.store import DemoStore
from manicm_ms.envs.simulator import ENVS
from manicm_ms.errors import StoreError, UnknownNameError
from manicm_ms.sensing.realism import REALISM

ENV_ID, PRESET = "ur3e/slide-block", "d435i+dr"


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("collect") / "dr.zarr"
    collect(ENV_ID, 2, path, seed=40, realism=PRESET, backend="cpu")
    return path


def test_every_episode_carries_what_was_drawn_for_its_seed(store):
    entry = ENVS.get(ENV_ID)
    with DemoStore.open(store) as reader:
        assert len(reader) == 2
        for k, seed in enumerate(reader.seeds.tolist()):
            drawn = entry.conditions(REALISM.get(PRESET), seed)
            assert drawn
            assert reader.episode(k).realism == drawn
        assert reader.provenance["realism"] == PRESET
        assert reader.provenance["realism_ranges"] == REALISM.get(PRESET).to_dict()
        assert f"--realism {PRESET}" in reader.provenance["command"]


def test_the_same_call_is_content_with_it(store):
    assert collect(ENV_ID, 2, store, seed=40, realism=PRESET, backend="cpu").added == 0


@pytest.mark.parametrize("other", ["clean", "d435i"])
def test_another_preset_does_not_go_on(store, other):
    with pytest.raises(StoreError, match=rf"realism 'd435i\+dr' where '{other}' is asked for"):
        collect(ENV_ID, 3, store, seed=40, realism=other, backend="cpu")


def test_an_unknown_preset_leaves_nothing_behind(tmp_path):
    with pytest.raises(UnknownNameError, match="did you mean 'd435i'"):
        collect(ENV_ID, 1, tmp_path / "a.zarr", realism="d435")
    assert not (tmp_path / "a.zarr").exists()
