"""Adroit's experts: the published policies' arithmetic, what they solve, and weights that are missing or altered."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from suite_rows import simulator

if find_spec("gymnasium_robotics") is None:
    pytest.skip("the MuJoCo suites are an extra, which is not installed", allow_module_level=True)

from manicm_ms.demos.collect import collect
from manicm_ms.demos.expert_files import EXPERT_FILES, FOLDER_VARIABLE, fetch, load_arrays
from manicm_ms.demos.experts import EXPERTS
from manicm_ms.demos.store import DemoStore
from manicm_ms.envs.simulator import ENVS
from manicm_ms.errors import ExpertFileError, UnknownNameError
from manicm_ms.paths import sha256
from manicm_ms.spec import STATE

GIVEN = Path(__file__).parents[3] / "shared" / "adroit_experts"
ENV_IDS = ("adroit/door", "adroit/hammer", "adroit/pen")
given = pytest.mark.skipif(
    not GIVEN.is_dir(), reason=f"the weights are not at {GIVEN}, nothing is downloaded for a test"
)


@pytest.fixture(scope="module")
def fetched(tmp_path_factory):
    """The folder of experts, filled from the given one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(FOLDER_VARIABLE, str(tmp_path_factory.mktemp("experts")))
        yield fetch(ENV_IDS, source=GIVEN, report=lambda line: None)[0].parent


def expert_of(env_id, style=None):
    return EXPERTS.get(env_id)(ENVS.get(env_id).spec, 1, torch.device("cpu"), style)


def readme_act(p, obs):
    """The formula of the given folder's README."""
    h = (obs - p["in_shift"]) / (p["in_scale"] + 1e-8)
    for i in range(int(p["n_layers"])):
        h = p[f"w{i}"] @ h + p[f"b{i}"]
        if i < int(p["n_layers"]) - 1:
            h = np.tanh(h)
    return np.clip(h * p["out_scale"] + p["out_shift"], -1.0, 1.0)


def play(env_id, seed):
    """An episode by the expert: its states (L, S), its actions (L, Da), and the last step's result."""
    states, actions = [], []
    with simulator(env_id, seed=seed, obs=(STATE,)) as rows:
        expert = expert_of(env_id)
        for _ in range(rows.spec.max_episode_steps):
            states.append(rows.observe()[STATE])
            actions.append(expert.act(states[-1]))
            result = rows.step(actions[-1])
            if result.terminated.item():
                break
    return torch.cat(states), torch.cat(actions), result


def test_every_task_has_an_expert_and_a_file():
    assert set(ENV_IDS) == set(EXPERT_FILES.names()) == set(ENVS.names("adroit"))
    assert set(ENV_IDS) <= set(EXPERTS.names())


@given
@pytest.mark.parametrize("env_id", ENV_IDS)
def test_fetched_weights_are_the_given_ones_with_their_licence(fetched, env_id):
    name = env_id.removeprefix("adroit/")
    with np.load(GIVEN / f"{name}.npz", allow_pickle=False) as archive:
        theirs = dict(archive)
    ours = load_arrays(env_id)
    assert ours.keys() == theirs.keys()
    for key, array in theirs.items():
        np.testing.assert_array_equal(ours[key], array, strict=True)
    assert sha256(fetched / "LICENSE") == sha256(GIVEN / "LICENSE") == EXPERT_FILES.get(env_id).licence_sha256
    readme = (GIVEN / "README.md").read_text()
    assert f"| {name} | `{EXPERT_FILES.get(env_id).sha256}`" in readme, "the pickle that they were read from"
    commit = "9a1de23df6574e1b94e1da742e3326eb1f61c013"
    assert commit in readme
    assert commit in EXPERT_FILES.get(env_id).url
    assert commit in EXPERT_FILES.get(env_id).licence_url


@given
@pytest.mark.parametrize(
    ("env_id", "seeds"), [("adroit/door", (0, 4)), ("adroit/hammer", (1, 4)), ("adroit/pen", (1, 8))]
)
def test_it_acts_by_the_published_formula_and_solves_the_task(fetched, env_id, seeds):
    with np.load(GIVEN / f"{env_id.removeprefix('adroit/')}.npz") as archive:
        weights = {name: array.astype(np.float64) for name, array in archive.items()}
    for seed in seeds:
        states, actions, result = play(env_id, seed)
        expected = np.stack([readme_act(weights, state) for state in states.numpy().astype(np.float64)])
        np.testing.assert_allclose(actions.numpy(), expected, atol=1e-6)
        assert actions.dtype == torch.float32
        assert actions.abs().max() <= 1
        assert result.info["success"].item(), "at the last step"
        assert len(states) == ENVS.get(env_id).spec.max_episode_steps
        assert result.info["success_steps"].item() >= ENVS.get(env_id).demos.success_steps == 10
    together = expert_of(env_id).act(states)
    torch.testing.assert_close(together, actions, rtol=0, atol=0, msg="a row's action hangs on its own state alone")


@given
def test_a_demonstration_is_the_whole_episode(fetched, tmp_path):
    made = collect("adroit/pen", 1, tmp_path / "pen.zarr", seed=17, num_envs=2)
    assert made.attempts > 1, "seed 17 is not solved"
    with DemoStore.open(made.path) as store:
        assert store.lengths.tolist() == [ENVS.get("adroit/pen").spec.max_episode_steps]
        assert store.seeds[0] > 17
        assert (store.provenance["expert"], store.provenance["style"]) == ("DAPG policy", "dapg")
        assert (store.provenance["success_steps"], store.provenance["tail_steps"]) == (10, 50)


@given
def test_altered_weights_are_refused(tmp_path, monkeypatch):
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    (path,) = fetch(["adroit/pen"], source=GIVEN, report=lambda line: None)
    arrays = load_arrays("adroit/pen")
    arrays["b2"] = arrays["b2"] + np.float32(1e-3)
    np.savez(path, **arrays)
    with pytest.raises(ExpertFileError, match=r"pen\.npz is not the expert of adroit/pen: the SHA-256"):
        expert_of("adroit/pen")


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_missing_weights_are_told_with_the_command(tmp_path, monkeypatch, env_id):
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "none"))
    with pytest.raises(ExpertFileError, match=rf"{env_id}\.npz: 'manicm-ms experts fetch' gets it, or .*--from FOLDER"):
        expert_of(env_id)
    with pytest.raises(UnknownNameError, match="dapg"):
        expert_of(env_id, style="dagp")
    assert not (tmp_path / "none").exists()
