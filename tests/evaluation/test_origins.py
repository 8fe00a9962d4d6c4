"""What checkpoints say of their making: the shipped ones, earlier ones, and records that say nothing."""

from pathlib import Path

import pytest
from point_mass import Proportional

from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.origins import Origin, remarks, require_unseen, seen_counts
from manicm_ms.evaluation.protocol import STUDENT, TEACHER, EvaluatedPolicy
from manicm_ms.policies.checkpoint import read_manifest

CHECKPOINTS = Path(__file__).parents[2] / "checkpoints"
ENV = "toy/point-mass"


def evaluated(name, provenance, env_id=ENV):
    role = STUDENT if "teacher" in provenance else TEACHER
    return EvaluatedPolicy(name, role, f"runs/{name}", Proportional(), Origin.read(env_id, provenance))


def trained(seeds, env_id=ENV, run="aa", **more):
    return {"run": run, "data": {"env_id": env_id, "episodes": len(seeds), "demo_seeds": seeds}, **more}


@pytest.mark.parametrize("task", ["slide_block", "stack_cube", "transfer_piece"])
@pytest.mark.parametrize("role", ["teacher", "student"])
def test_the_shipped_pairs_know_which_seeds_they_have_seen(task, role):
    env_id = f"ur3e/{task.replace('_', '-')}"
    provenance = read_manifest(CHECKPOINTS / task / role)["provenance"]
    origin = Origin.read(env_id, provenance)
    assert origin.tasks == (env_id,)
    assert origin.seen(env_id, [0, 49, 200_000]) == [0, 49]
    if "demo_seeds" not in provenance["data"]:  # 50 demonstrations from seed 0 on: twice as many seeds count
        assert origin.seen(env_id, range(98, 102)) == [98, 99]
    assert origin.seen("ur3e/another-task", range(100)) == []


def test_listed_seeds_are_taken_as_they_are_and_unknown_ones_left_out():
    origin = Origin.read(ENV, trained([3, 8, -1, -2]))
    assert origin.seen(ENV, range(-2, 20)) == [3, 8]


def test_a_student_has_seen_what_its_teacher_has():
    teacher = trained([1], env_id="toy/other", run="tt")
    origin = Origin.read(ENV, trained([7], teacher={"provenance": teacher}))
    assert origin.tasks == (ENV, "toy/other")
    assert (origin.seen(ENV, range(10)), origin.seen("toy/other", range(10))) == ([7], [1])
    assert (origin.run, origin.teacher_run) == ("aa", "tt")


@pytest.mark.parametrize(
    "provenance",
    [{}, {"data": None}, {"data": {"env_id": ENV}},
     {"data": {"env_id": ENV, "episodes": 3, "collection": {"seed": None}}},
     {"teacher": "runs/teacher"}, {"data": {"env_id": ENV, "episodes": 3, "collection": "dp3"}}],
)  # fmt: skip
def test_a_checkpoint_that_says_nothing_forbids_nothing(provenance):
    origin = Origin.read(ENV, provenance)
    assert origin.tasks == (ENV,)
    assert origin.seen(ENV, range(100)) == []


def test_seeds_of_the_demonstrations_are_refused_with_the_way_out():
    policies = [evaluated("teacher", trained([5, 6, 9])), evaluated("student", trained([5, 6, 9]))]
    with pytest.raises(
        ConfigError, match=r"2 of the 4 seeds \(6 is the first\) .*runs/teacher.*--seed 10 or more"
    ) as error:
        require_unseen(policies, ENV, range(6, 10))
    assert "--allow-seen-seeds" in str(error.value)
    assert "\n" not in str(error.value)
    require_unseen(policies, ENV, range(10, 20))
    require_unseen(policies, "toy/other", range(10))
    assert seen_counts(policies, ENV, range(6, 10)) == {"teacher": 2, "student": 2}
    assert "2 of the 4 seeds are those of its own demonstrations" in remarks(policies, ENV, range(6, 10))[0]


def test_demonstrations_of_unknown_seeds_are_told():
    imported = evaluated("teacher", trained([-1, -2]))
    require_unseen([imported], ENV, range(10))
    (line,) = remarks([imported], ENV, range(10))
    assert line.startswith("teacher: the seeds of its demonstrations are not known")
    assert remarks([evaluated("teacher", {})], ENV, range(10)) == []


def test_another_task_and_another_teacher_are_told():
    teacher = evaluated("teacher", trained([1], run="tt"))
    own = trained([1], teacher={"provenance": trained([1], run="tt")})
    assert remarks([teacher, evaluated("student", own)], ENV, [50]) == []
    (line,) = remarks([teacher, evaluated("student", trained([1], env_id="toy/b"), "toy/b")], ENV, [50])
    assert line == f"student was trained for toy/b and is evaluated on {ENV}."
    stranger = trained([1], teacher={"provenance": trained([1], run="ss")})
    (line,) = remarks([teacher, evaluated("student", stranger)], ENV, [50])
    assert line == "student was distilled from another training than teacher."
