"""`manicm-ms collect` beyond one store: where it goes by default, many tasks at once, and those that cannot be had."""

import point_mass_env
import pytest
import toy_point_mass

from manicm_ms.cli import collecting
from manicm_ms.demos.experts import EXPERTS
from manicm_ms.demos.layout import store_path
from manicm_ms.demos.store import DemoStore
from manicm_ms.envs.simulator import ENVS
from manicm_ms.errors import ManicmError, UnknownNameError

OPTIONS = {"num_envs": 1, "style": None, "seed": 13}
TAG = "collected-together"
BROKEN = point_mass_env.RAISING  # cannot start the seed 13


@pytest.fixture
def two_tasks(monkeypatch):
    """A tag of two tasks, one of which does not start."""
    monkeypatch.setitem(EXPERTS._entries, BROKEN, toy_point_mass.StraightLine)
    for env_id in (BROKEN, toy_point_mass.ENV_ID):
        monkeypatch.setitem(ENVS._tags, env_id, frozenset({TAG}))


def test_without_out_a_store_lies_in_data_under_its_id(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    done = collecting.collect_one(toy_point_mass.ENV_ID, None, 2, OPTIONS)
    assert done.path == store_path(collecting.DATA, toy_point_mass.ENV_ID)
    assert (tmp_path / "data" / "toy" / "point-mass.zarr").is_dir()
    assert "2 episodes from" in capsys.readouterr().out


def test_a_tag_collects_all_and_names_those_that_failed(two_tasks, tmp_path, capsys):
    with pytest.raises(ManicmError, match=f"1 of 2 were not collected: {BROKEN}"):
        collecting.collect_tagged(TAG, tmp_path, 2, OPTIONS)
    with DemoStore.open(store_path(tmp_path, toy_point_mass.ENV_ID)) as store:
        assert len(store) == 2
    assert not store_path(tmp_path, BROKEN).exists()
    table = capsys.readouterr().out
    assert "attempts" in table
    assert toy_point_mass.ENV_ID in table


def test_a_tag_without_experts_is_refused():
    with pytest.raises(UnknownNameError, match="unknown tag 'nobody'"):
        collecting.tagged("nobody")


def test_the_benchmarks_tag_names_all_31():
    assert len(collecting.tagged("benchmark31")) == 31
