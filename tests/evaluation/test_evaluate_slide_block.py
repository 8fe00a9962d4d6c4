"""`evaluate` on the real environment, from real checkpoint folders, and what it refuses before it writes."""

import dataclasses
import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from manicm_ms.envs.env_request import EnvRequest
from manicm_ms.envs.simulator import ENVS
from manicm_ms.errors import CheckpointError, ConfigError, NotComparableError, SpecMismatchError, UnknownNameError
from manicm_ms.evaluation.compare import Playing, compare
from manicm_ms.evaluation.evaluate import evaluate
from manicm_ms.evaluation.policies import checkpoint_digest, load_policies
from manicm_ms.evaluation.protocol import Protocol
from manicm_ms.evaluation.request import identity_of
from manicm_ms.policies.checkpoint import save_checkpoint
from manicm_ms.policies.methods import make_policy, student_of
from manicm_ms.spec import ChunkSpec

ENV = "ur3e/slide-block"
SHIPPED = Path(__file__).parents[2] / "checkpoints" / "slide_block"
CONFIG = {"inputs": {"points": {"max_points": 64}}, "backbone": {"down_dims": (16, 32, 48)}}


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pair")
    teacher = make_policy("simple_dp3", ENVS.get(ENV).spec, ChunkSpec(2, 4, 3), CONFIG, seed=0)
    save_checkpoint(teacher, folder / "teacher", {"data": {"env_id": ENV, "demo_seeds": [0, 7]}})
    save_checkpoint(student_of(teacher), folder / "student", {})
    return [folder / "teacher", folder / "student"]


def run(checkpoints, out, env_id=ENV, episodes=2, seed=100_000, **options):
    console = Console(file=io.StringIO(), width=120)
    return evaluate(
        checkpoints,
        env_id,
        episodes,
        seed,
        out,
        num_envs=2,
        backend="cpu",
        repetitions=2,
        console=console,
        **options,
    )


def test_a_pair_of_checkpoints_is_evaluated_with_its_control_and_filmed(pair, tmp_path):
    results = run(pair, tmp_path / "report", videos=1)
    stored = json.loads((tmp_path / "report" / "results.json").read_text())
    assert stored == json.loads(json.dumps(results))
    assert [(p["name"], p["role"], p["nfe"]) for p in stored["policies"]] == [
        ("teacher", "teacher", 10),
        ("teacher, one step", "control", 1),
        ("student", "student", 1),
    ]
    assert stored["seeds"] == [100_000, 100_001]
    assert all(p["n"] == 2 and p["crashed"] == 0 for p in stored["policies"])
    assert all(e["steps"] > 0 for p in stored["policies"] for e in p["episodes"])
    films = [(v["policy"], v["seed"]) for v in stored["videos"]]
    assert films == [("teacher", 100_000), ("student", 100_000)]
    assert str(pair[0]) in stored["command"]


def test_without_control_only_the_checkpoints_are_played_and_seen_seeds_may_be_meant(pair, tmp_path):
    results = run(pair, tmp_path / "report", episodes=1, seed=0, control=False, videos=0, allow_seen_seeds=True)
    assert [p["name"] for p in results["policies"]] == ["teacher", "student"]
    assert results["seen_seeds"] == {"teacher": 1}
    assert results["command"].endswith("--allow-seen-seeds")
    assert [p["success_at_end"]["n"] for p in results["policies"]] == [1, 1]


def test_a_number_behind_a_folder_is_that_of_network_evaluations(pair):
    few = load_policies([pair[0], Path(f"{pair[0]}@4"), Path(f"{pair[1]}@2")], control=False)
    assert [(c.name, c.role, c.policy.nfe) for c in few] == [
        ("teacher", "teacher", 10), ("teacher@4", "teacher", 4), ("student@2", "student", 2),
    ]  # fmt: skip
    assert few[0].digest == few[1].digest
    with pytest.raises(ConfigError, match="num_inference_steps=101 must lie between"):
        load_policies([Path(f"{pair[0]}@101")])
    with pytest.raises(ConfigError, match="two checkpoints have one name"):
        load_policies([Path(f"{pair[0]}@4")] * 2)


def test_the_role_is_the_checkpoints_own(pair):
    assert [(c.name, c.role) for c in load_policies([pair[1]])] == [("student", "student")]
    roles = [(c.name, c.role) for c in load_policies(pair[::-1])]
    assert roles == [("student", "student"), ("teacher", "teacher")]


def test_an_evaluation_that_an_earlier_version_began_goes_on(pair):
    def identified(checkpoints):
        protocol = Protocol(ENV, (5, 6), num_envs=1)
        return identity_of(protocol, load_policies(checkpoints), EnvRequest(env_id=ENV, backend="cpu"), "cpu")

    teacher, student = (checkpoint_digest(str(path)) for path in pair)
    earlier = {"env_id": ENV, "seed": 5, "episodes": 2, "backend": "cpu", "device": "cpu"}
    three = [
        ["teacher", "teacher", teacher],
        ["teacher, one step", "control", teacher],
        ["student", "student", student],
    ]
    assert identified(pair) == earlier | {"policies": three}
    alone = [["student", "teacher", student]]  # by its place in the list
    assert identified(pair[1:]) == earlier | {"policies": alone}


def test_seeds_of_its_own_demonstrations_are_refused_before_anything_is_written(tmp_path):
    shipped = [SHIPPED / "teacher", SHIPPED / "student"]
    with pytest.raises(ConfigError, match=r"are those of the demonstrations that checkpoint .*--allow-seen-seeds"):
        run(shipped, tmp_path / "report", seed=0)
    with pytest.raises(ConfigError, match="choose a smaller --seed"):
        run(shipped, tmp_path / "report", seed=99_999_999_999)
    assert not (tmp_path / "report").exists()


def test_bad_input_is_refused_before_anything_is_written(pair, tmp_path):
    out = tmp_path / "report"
    with pytest.raises(UnknownNameError, match="did you mean 'ur3e/slide-block'"):
        run(pair, out, env_id="ur3e/slide-blok")
    with pytest.raises(CheckpointError, match="nowhere"):
        run([tmp_path / "nowhere"], out)
    with pytest.raises(ConfigError, match="--episodes"):
        run(pair, out, episodes=0)
    with pytest.raises(ConfigError, match="unknown device 'foo'"):
        run(pair, out, device="foo")
    with pytest.raises(ConfigError, match="CUDA devices found"):
        run(pair, out, device="cuda:99")
    with pytest.raises(ConfigError, match="at least one checkpoint"):
        run([], out)
    with pytest.raises(ConfigError, match="one name"):
        run([pair[0], pair[0]], out)
    spec = ENVS.get(ENV).spec
    stranger = dataclasses.replace(spec, action=dataclasses.replace(spec.action, control_hz=50.0))
    save_checkpoint(make_policy("simple_dp3", stranger, ChunkSpec(2, 4, 3), CONFIG, seed=0), tmp_path / "stranger", {})
    with pytest.raises(SpecMismatchError, match="control_hz"):
        run([tmp_path / "stranger"], out)
    assert not out.exists()


def test_checkpoints_are_compared_once_evaluated_on_the_same_start_states_and_go_on(pair, tmp_path):
    out, playing = tmp_path / "compare", Playing(ENV, episodes=1, num_envs=1, backend="cpu")
    found = compare(pair, out, playing, console=Console(file=io.StringIO(), width=120))
    assert [(p["name"], p["n"]) for p in found["policies"]] == [("teacher", 1), ("student", 1)]
    assert (found["start_states"], found["seeds"], found["pairs"][0]["verdict"]) == (
        "digest",
        [100_000],
        "underpowered",
    )
    logs = sorted((out / "evaluations").glob("*/episodes/*.jsonl"))
    before = [log.read_bytes() for log in logs]
    assert compare(pair, out, playing, console=Console(file=io.StringIO())) == found
    assert [log.read_bytes() for log in logs] == before, "nothing is played again"
    both = compare([out / "evaluations" / "teacher", pair[1]], tmp_path / "both", playing, console=Console(quiet=True))
    assert [p["name"] for p in both["policies"]] == ["teacher", "student"]


def test_checkpoints_that_cannot_be_compared_are_refused_before_anything_is_written(pair, tmp_path):
    out = tmp_path / "compare"
    with pytest.raises(ConfigError, match="is a checkpoint and has to be played: add --env"):
        compare(pair, out)
    spec = dataclasses.replace(ENVS.get(ENV).spec, env_id="ur3e/stack-cube")
    save_checkpoint(make_policy("simple_dp3", spec, ChunkSpec(2, 4, 3), CONFIG, seed=0), tmp_path / "other", {})
    with pytest.raises(
        NotComparableError, match=r"teacher was trained for ur3e/slide-block, .*other for ur3e/stack-cube"
    ):
        compare([pair[0], tmp_path / "other"], out, Playing(ENV))
    with pytest.raises(ConfigError, match="one realism preset, got clean, d435i"):
        compare(pair, out, Playing(ENV, realism="clean,d435i"))
    with pytest.raises(ConfigError, match="are those of the demonstrations"):
        compare(pair, out, Playing(ENV, seed=0))
    with pytest.raises(ConfigError, match="choose a smaller --seed"):
        compare(pair, out, Playing(ENV, seed=2**40))
    assert not out.exists()
