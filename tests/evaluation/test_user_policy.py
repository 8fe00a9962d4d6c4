"""A policy of the user's own: loaded from a file, checked before anything is played, its memory restarted by rows."""

import io
import json
import textwrap
from dataclasses import replace

import numpy as np
import pytest
import torch
from point_mass import CHUNK, SPEC, PointMass, Proportional
from rich.console import Console

from manicm_ms.errors import ConfigError, UserPolicyError
from manicm_ms.evaluation.decisions import Decisions, decision_noise
from manicm_ms.evaluation.evaluate import evaluate_policies
from manicm_ms.evaluation.play import EnvMaker
from manicm_ms.evaluation.policies import with_users
from manicm_ms.evaluation.protocol import OTHER, TEACHER, EvaluatedPolicy, Protocol
from manicm_ms.evaluation.rollout import rollout
from manicm_ms.evaluation.screen import show
from manicm_ms.evaluation.user_policy import UserPolicy, load_user_policy

MINIMAL = """
    import torch
    from manicm_ms import ChunkSpec

    class Walk:
        chunk = ChunkSpec(n_obs_steps=2, horizon=4, n_action_steps=3)

        def act(self, obs, noise, state):
            position = obs["agent_pos"][:, -1]
            actions = (-3 * position[:, None] + 0.3 * noise[:, 1:4]).clamp(-1, 1)
            return actions, state

    def make_policy(spec):
        assert spec.action.dim == 2
        return Walk()
"""


def write(tmp_path, text, name="mine.py"):
    file = tmp_path / name
    file.write_text(textwrap.dedent(text))
    return f"{file}:make_policy"


def test_two_attributes_are_enough_and_it_plays_as_one_of_ours_does(tmp_path):
    policy = load_user_policy(write(tmp_path, MINIMAL), SPEC)
    assert (policy.name, policy.nfe, str(policy.device), policy.chunk) == ("mine", None, "cpu", CHUNK)
    seeds = range(50, 62)
    theirs = rollout(PointMass(3), policy, seeds)
    ours = rollout(PointMass(3), Proportional(gain=3.0, noise_scale=0.3, nan_above=9.0), seeds)
    assert [e.success for e in theirs] == [e.success for e in ours]
    for mine, own in zip(theirs, ours, strict=True):  # the noise is that of the seed and the decision
        np.testing.assert_array_equal(mine.actions, own.actions)


def test_it_stands_beside_checkpoints_paired_and_without_numbers_that_it_does_not_give(tmp_path):
    source = write(tmp_path, MINIMAL)
    checkpoint = EvaluatedPolicy("teacher", TEACHER, "runs/teacher", Proportional(gain=2.0, noise_scale=0.6))
    policies = with_users([checkpoint], [source, source], SPEC)
    assert [(p.name, p.role, p.checkpoint) for p in policies[1:]] == [(n, OTHER, source) for n in ("mine", "mine 2")]
    assert len(policies[1].digest) == 64
    protocol = Protocol(SPEC.env_id, tuple(range(70, 78)), num_envs=2, repetitions=1, videos=0)
    envs = EnvMaker(lambda policy, n, _: PointMass(n, policy.chunk), lambda n, _: PointMass(n, chunk=None))
    console, out = Console(file=io.StringIO(), width=160), tmp_path / "report"
    results = evaluate_policies(policies[:2], protocol, envs, out, {}, "the command", console)
    assert show(results, out, console)
    stored = json.loads((out / "results.json").read_text())
    assert [(p["nfe"], p["parameters"], p["dtype"]) for p in stored["policies"]] == [
        (1, 1, "float32"),
        (None, None, "-"),
    ]
    assert stored["paired"]["second"] == "mine"
    printed = console.file.getvalue()
    assert "network evaluations" not in printed
    assert "| mine | policy | - |" in (out / "report.md").read_text()


REMEMBERS = """
    import torch
    from manicm_ms import ChunkSpec

    class Counts:
        chunk = ChunkSpec(n_obs_steps=2, horizon=4, n_action_steps=3)
        nfe = 2
        name = "counting"

        def initial_state(self, n):
            return {"count": torch.full((n, 1), 5.0)}

        def act(self, obs, noise, state):
            state = state or self.initial_state(len(noise))
            actions = (state["count"][:, None] / 100).expand(-1, 3, 2)
            return actions, {"count": state["count"] + 1}

    def make_policy(spec):
        return Counts()
"""


def test_the_memory_of_a_row_begins_anew_with_its_episode_and_the_others_keep_theirs(tmp_path):
    policy = load_user_policy(write(tmp_path, REMEMBERS), SPEC)
    assert (policy.name, policy.nfe) == ("counting", 2)
    decisions, obs = (
        Decisions(policy, 3),
        PointMass(3).reset(seed=[1, 2, 3], options={"reset_mask": np.ones(3, bool)})[0],
    )
    told = []
    for decision, fresh in enumerate([[0, 1, 2], [], [1], []]):
        decisions.restart(fresh)
        told.append((decisions.actions(obs, [(k, decision) for k in range(3)])[:, 0, 0] * 100).round().int().tolist())
    assert told == [[5, 5, 5], [6, 6, 6], [7, 5, 7], [8, 6, 8]]
    played = rollout(PointMass(2), policy, range(5))
    assert all(round(float(e.actions[0, 0, 0]) * 100) == 5 for e in played)
    assert all(round(float(e.actions[-1, 0, 0]) * 100) == 4 + e.decisions for e in played)


def test_without_an_initial_state_the_state_stays_none(tmp_path):
    source = write(
        tmp_path, MINIMAL.replace("return actions, state", 'assert state is None; return actions, {"a": noise}')
    )
    policy = load_user_policy(source, SPEC)
    assert len(rollout(PointMass(2), policy, range(3))) == 3


def test_a_row_whose_action_is_nan_is_a_failed_episode_and_the_others_go_on(tmp_path):
    fragile = MINIMAL.replace("return actions", "actions[position[:, 0] < -0.5] = float('nan'); return actions")
    results = rollout(PointMass(4), load_user_policy(write(tmp_path, fragile), SPEC), range(40))
    crashed = [e for e in results if e.crashed]
    assert 0 < len(crashed) < 40
    assert all("is not finite" in e.crashed for e in crashed)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            ("actions, state\n", "actions\n"),
            r"act of .*mine\.py:make_policy returned a Tensor: return \(actions, state\)",
        ),
        (
            ("return actions, state", "return actions[:, :2], state"),
            r"have shape \(2, 2, 2\), and \(N, Ta, Da\) is \(2, 3, 2\)",
        ),
        (("return actions, state", "return actions.long(), state"), r"are torch\.int64: return floating point"),
        (("return actions, state", "return actions.tolist(), state"), r"are a list: return a tensor"),
        (("return actions, state", "return actions * float('nan'), state"), r"hold NaN or infinity"),
        (
            ("return actions, state", "return 1 / 0, state"),
            r"mine\.py, line 11: its first decision failed with ZeroDivision",
        ),
        (("return Walk()", "return 3"), r"returned a int without a chunk"),
        (("return Walk()", "return {}['weights']"), r"mine\.py, line 15: make_policy\(spec\) failed with KeyError"),
        (("def act(", "def choose("), r"without act\(obs, noise, state\)"),
        (("import torch", "import torhc"), r"mine\.py, line 2: its import failed with ModuleNotFoundError"),
        (("import torch", "def broken(:"), r"mine\.py, line 2: its import failed with SyntaxError"),
        (("def make_policy", "def make_polciy"), r"has no function make_policy: it defines Walk, make_polciy"),
    ],
)
def test_an_unfit_policy_is_refused_in_one_line(tmp_path, change, words):
    text = textwrap.dedent(MINIMAL)
    assert change[0] in text
    source = write(tmp_path, text.replace(*change))
    with pytest.raises(UserPolicyError, match=words) as error:
        load_user_policy(source, SPEC)
    assert "\n" not in str(error.value)


def test_a_state_of_another_form_is_refused(tmp_path):
    source = write(tmp_path, REMEMBERS.replace('{"count": state["count"] + 1}', "[1]"))
    with pytest.raises(UserPolicyError, match=r"must be None or a dictionary of tensors \(2, \.\.\.\)"):
        load_user_policy(source, SPEC)


def test_names_that_would_share_their_files_are_told_apart(tmp_path):
    sources = [write(tmp_path, MINIMAL.replace("class Walk:", f"class Walk:\n        name = {n!r}"), f) for n, f in
               (("my policy", "a.py"), ("my-policy", "b.py"))]  # fmt: skip
    assert [p.name for p in with_users([], sources, SPEC)] == ["my policy", "my-policy 2"]


def test_the_form_of_the_option_is_told_and_no_policy_at_all_is_refused(tmp_path):
    with pytest.raises(UserPolicyError, match=r"must name a file and a function in it, as in FILE\.py:FUNCTION"):
        load_user_policy(str(tmp_path / "mine.py"), SPEC)
    with pytest.raises(UserPolicyError, match="there is no file"):
        load_user_policy(f"{tmp_path}/mine.py:make_policy", SPEC)
    with pytest.raises(ConfigError, match="or a policy of your own by --policy"):
        with_users([], [], SPEC)


def test_what_lies_beside_the_file_can_be_imported(tmp_path):
    (tmp_path / "beside_it.py").write_text("GAIN = 3")
    text = textwrap.dedent(MINIMAL).replace("import torch", "import torch\nfrom beside_it import GAIN")
    assert isinstance(load_user_policy(write(tmp_path, text), SPEC), UserPolicy)


def test_numpy_actions_are_taken_and_a_deterministic_policy_gets_no_noise():
    class Still:
        chunk = CHUNK

        def act(self, obs, noise, state):
            return np.zeros((len(noise), 3, 2)), state

    actions, state = UserPolicy("x.py:f", Still(), SPEC).decide({}, torch.zeros(1, 4, 4, 2), None)
    assert (actions.dtype, tuple(actions.shape), state) == (torch.float32, (4, 3, 2), None)
    assert decision_noise(3, 0, (0, 4, 2)).shape == (0, 4, 2)


class Deterministic(Proportional):
    noise_draws = 0

    def decide(self, obs, noise, state):
        assert tuple(noise.shape) == (0, len(obs["agent_pos"]), 4, 2)
        return (-3 * obs["agent_pos"][:, -1:]).clamp(-1, 1).expand(-1, 3, -1), state


def test_a_policy_of_ours_may_draw_nothing():
    results = rollout(PointMass(2), Deterministic(), range(4))
    assert [e.crashed for e in results] == [None] * 4


def test_it_may_name_what_it_reads(tmp_path):
    named = MINIMAL.replace("chunk =", 'keys = ["state", "image"]\n        chunk =').replace(
        'obs["agent_pos"][:, -1]', 'obs["state"][:, -1, :2] + 0 * obs["image"].float().mean()'
    )
    spec = replace(SPEC, state_layout={"position": (0, 2)})
    assert load_user_policy(write(tmp_path, named), spec).keys == ("state", "image")
    with pytest.raises(
        UserPolicyError, match=r"keys of .* are \['sound'\]: name some of point_cloud, agent_pos, image"
    ):
        load_user_policy(write(tmp_path, MINIMAL.replace("chunk =", 'keys = ["sound"]\n        chunk =')), SPEC)
