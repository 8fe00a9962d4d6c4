"""What a benchmark may be asked: names, seeds, methods and their teachers."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from manicm_ms.benchmark.jobs import CollectJob, all_jobs
from manicm_ms.benchmark.methods import OneStep, Steps, Student, Trained, parse_methods
from manicm_ms.benchmark.plan import Plan, parse_envs, parse_seeds
from manicm_ms.demos.store import DemoStore
from manicm_ms.envs.simulator import ENVS
from manicm_ms.errors import ConfigError, UnknownNameError
from manicm_ms.policies.checkpoint import save_checkpoint
from manicm_ms.policies.methods import make_policy


def plan(**changes):
    fields = {
        "env_ids": ("metaworld/reach", "adroit/door"), "methods": ("simple_dp3", "one_step", "manicm"), "seeds": (0, 1),
        "preset": "smoke", "out": Path("runs/x"), "data": Path("data"),
    }  # fmt: skip
    return Plan(**{**fields, **changes})


def test_students_and_controls_come_from_the_one_teacher_named_or_from_the_default():
    assert parse_methods(["dp3", "manicm", "one_step"]) == (
        Trained("dp3"), Student("manicm", Trained("dp3")), OneStep("one_step", Trained("dp3")),
    )  # fmt: skip
    assert parse_methods(["manicm"]) == (Student("manicm", Trained("simple_dp3")),)
    both = parse_methods(["dp3", "simple_dp3", "manicm:dp3", "manicm:simple_dp3"])
    assert [m.made_from.name for m in both if m.made_from] == ["dp3", "simple_dp3"]


def test_a_student_is_made_from_the_teacher_of_its_row():
    names = ["simple_dp3", "pocket_dp3", "manicm", "pocket_manicm"]
    assert [m.made_from.name for m in parse_methods(names)[2:]] == ["simple_dp3", "pocket_dp3"]
    assert parse_methods(["dp3", "pocket_manicm"])[1] == Student("pocket_manicm", Trained("pocket_dp3"))
    assert parse_methods(["pocket_dp3", "manicm"])[1] == Student("manicm", Trained("simple_dp3"))


def test_a_number_behind_a_name_is_that_of_network_evaluations():
    four, student, of_dp3 = parse_methods(["simple_dp3_4", "manicm_4", "manicm_2:dp3"])
    assert four == Steps("simple_dp3_4", Trained("simple_dp3"), 4)
    assert student == Steps("manicm_4", Student("manicm", Trained("simple_dp3")), 4)
    assert of_dp3 == Steps("manicm_2:dp3", Student("manicm:dp3", Trained("dp3")), 2)
    assert [m.folder for m in (four, student, of_dp3)] == [
        "simple_dp3_4-simple_dp3", "manicm_4-simple_dp3", "manicm_2-dp3",
    ]  # fmt: skip
    assert parse_methods(["meanflow_4"]) == (Steps("meanflow_4", Trained("meanflow"), 4),)
    assert [m.owner.name for m in (four, student, of_dp3)] == ["simple_dp3", "manicm", "manicm:dp3"]


def test_such_a_method_plays_with_the_checkpoint_of_the_method_itself(tmp_path):
    spec = ENVS.get("adroit/door").spec
    save_checkpoint(make_policy("simple_dp3", spec, size="smoke", seed=0), tmp_path / "teacher", {})
    four, whole = (m.load(tmp_path / "teacher", "cpu") for m in parse_methods(["simple_dp3_4", "simple_dp3"]))
    assert (four.nfe, whole.nfe) == (4, 10)
    own = dict(whole.head.backbone.named_parameters())
    assert all(torch.equal(p, own[name]) for name, p in four.head.backbone.named_parameters())


@pytest.mark.parametrize(
    ("names", "error", "text"),
    [
        (["simple_dp3_101"], ConfigError, "num_inference_steps=101 must lie between 1"),
        (["manicm_11"], ConfigError, "nfe=11 must lie between 1 and num_solver_steps=10"),
        (["bc_gmm_3d_2"], ConfigError, "bc_gmm_3d takes 1 network evaluations a decision"),
        (["simple_dp3_50[head.num_train_timesteps=20]"], ConfigError, "num_train_timesteps=20"),
        (["manicm_8[training.solver_stride=20]"], ConfigError, "nfe=8 must lie between 1 and num_solver_steps=5"),
        (["dp", "manicm:dp"], ConfigError, "that of dp is image_manicm: use 'image_manicm'"),
        (["one_step_4"], ConfigError, "write TEACHER_4"),
        (["simple_dp3_0"], UnknownNameError, "unknown method 'simple_dp3_0'"),
        ([], ConfigError, "name each method once"),
        (["manicm", "manicm"], ConfigError, "name each method once"),
        (["dp3", "simple_dp3", "manicm"], ConfigError, "manicm:dp3 or manicm:simple_dp3"),
        (["dp3:simple_dp3"], ConfigError, "trained on demonstrations"),
        (["manicm:bc"], UnknownNameError, "unknown teacher 'bc'"),
        (["simple_dp"], UnknownNameError, "did you mean 'simple_dp3'"),
    ],
)
def test_methods_that_cannot_be_are_refused_with_a_way_out(names, error, text):
    with pytest.raises(error, match=text):
        parse_methods(names)


def test_tags_and_ids_mix_and_each_task_comes_once():
    assert parse_envs("adroit") == ("adroit/door", "adroit/hammer", "adroit/pen")
    assert parse_envs("metaworld/soccer, adroit,adroit/door") == ("metaworld/soccer", *parse_envs("adroit"))
    assert len(parse_envs("benchmark31")) == 31
    with pytest.raises(UnknownNameError, match="did you mean 'metaworld/soccer'"):
        parse_envs("metaworld/socker")
    with pytest.raises(UnknownNameError, match="called 'metaworld/button-press' here"):
        parse_envs("button-press-v2")


def test_seeds_are_whole_numbers():
    assert parse_seeds("0, 1,22") == (0, 1, 22)
    for text in ("", "0,x", "-1", "0.5"):
        with pytest.raises(ConfigError, match="whole numbers"):
            parse_seeds(text)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"episodes": 0}, "at least 1"),
        ({"evaluations": -1}, "at least 0"),
        ({"evaluations": 4}, "from 5"),
        ({"evaluations": 21}, "to 20 .steps of the preset smoke"),
        ({"seeds": (0, 0)}, "once"),
        ({"env_ids": ()}, "at least one task"),
        ({"eval_seed": -5}, "negative"),
    ],
)
def test_numbers_out_of_range_are_refused(changes, text):
    with pytest.raises(ConfigError, match=text):
        plan(**changes)
    with pytest.raises(UnknownNameError, match="preset"):
        plan(preset="papers")


def test_a_plan_survives_its_way_through_json():
    there = plan(colors=True, evaluations=5)
    back = Plan.from_json(there.to_json())
    assert back.identity == there.identity
    assert (back.env_ids, back.methods, back.seeds) == (there.env_ids, there.methods, there.seeds)
    assert back.out == there.out.resolve()


def test_no_episode_of_an_evaluation_is_played_by_another_one_or_among_the_fresh_ones():
    asked = plan(evaluations=12)
    seeds = [s for number in range(12) for s in asked.evaluation_seeds(number)]
    assert len(set(seeds)) == len(seeds) == 12 * 20
    assert not set(seeds) & set(asked.fresh_seeds)


def test_every_job_stands_after_those_it_needs_and_once():
    jobs = all_jobs(plan())
    names = [job.name for job in jobs]
    assert len(set(names)) == len(names) == 2 + 2 * 2 * (2 + 3), "collect per task; 2 trainings, 3 evaluated per seed"
    for k, job in enumerate(jobs):
        assert {need.name for need in job.needs} <= set(names[:k])
    student = next(job for job in jobs if job.name == "adroit/door/seed1/manicm-simple_dp3/train")
    assert {need.name for need in student.needs} == {"adroit/door/collect", "adroit/door/seed1/simple_dp3/train"}


def test_a_student_alone_brings_its_teachers_training_but_not_its_judgement():
    names = {job.name for job in all_jobs(plan(env_ids=("adroit/door",), methods=("manicm",), seeds=(0,)))}
    assert names == {
        "adroit/door/collect",
        "adroit/door/seed0/simple_dp3/train",
        "adroit/door/seed0/manicm-simple_dp3/train",
        "adroit/door/seed0/manicm-simple_dp3/judge",
    }


def test_students_of_two_teachers_have_folders_of_their_own():
    asked = plan(methods=("dp3", "simple_dp3", "manicm:dp3", "manicm:simple_dp3", "one_step:dp3"))
    folders = [asked.folder("adroit/door", 0, method) for method in asked.parsed_methods]
    assert len(set(folders)) == 5
    alone = plan(methods=("simple_dp3", "manicm"))
    assert alone.folder("adroit/door", 0, alone.parsed_methods[1]) == folders[3], "however it is called"


@pytest.mark.parametrize(
    ("methods", "extras"),
    [
        (("simple_dp3", "one_step", "manicm"), ()),
        (("dp", "one_step"), ("image",)),
        (("simple_dp3", "voxel_manicm_2", "dp"), ("image", "voxel_grid")),
    ],
)
def test_what_the_methods_read_is_collected_and_a_store_that_holds_more_is_taken(tmp_path, methods, extras):
    spec = ENVS.get("metaworld/reach").spec
    asked = plan(methods=methods, data=tmp_path)
    assert asked.extras(spec) == extras
    collection = next(job for job in all_jobs(asked) if isinstance(job, CollectJob))
    path = tmp_path / "metaworld" / "reach.zarr"
    assert collection._extras(path) == {"extras": extras}
    fine = replace(spec, obs=replace(spec.obs, voxel_size=64))
    DemoStore.create(path, fine, {}, extras=("image", "depth", "voxel_grid")).close()
    assert collection._extras(path) == {"extras": ("image", "depth", "voxel_grid"), "voxel_size": 64}


def test_no_demonstration_judges_a_policy():
    asked = plan(eval_seed=100, episodes=10, evaluations=5)
    asked.require_unseen([0, 99, 110])
    for seen in (100, 109, asked.evaluation_seeds(4)[-1]):
        with pytest.raises(ConfigError, match=f"seed {seen} is that of a demonstration"):
            asked.require_unseen([0, seen])


def test_seeds_that_an_environment_does_not_take_are_refused_before_anything_is_played():
    thirty_two, sixty_four = ENVS.get("ur3e/slide-block"), ENVS.get("metaworld/reach")
    plan(eval_seed=2**32 - 50, episodes=50).require_seeds_of(thirty_two)
    beyond = plan(eval_seed=2**32 - 50, episodes=51)
    with pytest.raises(ConfigError, match=r"ur3e/slide-block end at 4294967295, .* run to 4294967296: .*--eval-seed"):
        beyond.require_seeds_of(thirty_two)
    beyond.require_seeds_of(sixty_four)
    with pytest.raises(ConfigError, match="those of the evaluations run to"):
        plan(eval_seed=2**32 - 50, episodes=50, evaluations=5).require_seeds_of(thirty_two)


def test_playing_to_the_end_is_another_benchmark_and_earlier_folders_stay_readable():
    assert "to_the_end" not in plan().identity
    assert plan(to_the_end=True).identity["to_the_end"]
