"""Methods with overrides: names, folders, presets, and what is refused before anything runs."""

import pytest
from test_plan import plan

from manicm_ms.benchmark.jobs import all_jobs
from manicm_ms.benchmark.method_names import folder_name, read_name
from manicm_ms.benchmark.methods import parse_methods
from manicm_ms.benchmark.plan import split_names
from manicm_ms.benchmark.summary import summarised
from manicm_ms.errors import ConfigError, UnknownNameError
from manicm_ms.training.presets import STUDENT_PRESETS, preset_for

EPSILON = "simple_dp3[head.prediction_type=epsilon]"


def test_an_override_reaches_the_training_of_teacher_and_student():
    names = [EPSILON, f"manicm[training.solver_stride=20; training.ema_decay=0.9]:{EPSILON}"]
    teacher, student = parse_methods(names)
    changes = {"head": {"prediction_type": "epsilon"}}
    assert teacher.preset("quick") == preset_for("simple_dp3", "quick").with_changes(changes)
    assert teacher.preset("quick").configuration("simple_dp3")["head"]["prediction_type"] == "epsilon"
    changed, usual = student.preset("paper"), STUDENT_PRESETS.get("paper")
    assert (changed.solver_stride, changed.ema_decay, changed.epochs) == (20, 0.9, usual.epochs)
    assert student.made_from == teacher


def test_the_teacher_with_an_override_is_the_one_teacher_where_there_is_no_other():
    _, student, control = parse_methods([EPSILON, "manicm", "one_step"])
    assert student.made_from.name == control.made_from.name == EPSILON
    with pytest.raises(ConfigError, match=r"write manicm:simple_dp3 or manicm:simple_dp3\[head"):
        parse_methods(["simple_dp3", EPSILON, "manicm"])


@pytest.mark.parametrize(
    "text",
    ["dp3[b.x=1;a.y=2]:teacher", "dp3[a.y=2;b.x=1]:teacher", " dp3[ a.y = 2 ; b.x = 1; ]:teacher"],
)
def test_spellings_of_one_method_are_one(text):
    assert str(read_name(text)) == "dp3[a.y=2;b.x=1]:teacher"
    assert folder_name(read_name(text)) == "dp3+a.y=2+b.x=1"


def test_two_spellings_of_one_method_are_refused_as_one_named_twice():
    with pytest.raises(ConfigError, match="name each method once"):
        parse_methods(["dp3[training.steps=10;training.batch_size=4]", "dp3[training.batch_size=4; training.steps=10]"])


def test_folders_are_safe_and_tell_methods_apart():
    names = [
        "dp3", "dp3[a=1]", "dp3[a=2]", "dp3[a=x/y]", "dp3[a=x y]", "dp3[a=../..]",
        f"dp3[a={'x' * 300}]", f"dp3[a={'x' * 301}]",
    ]  # fmt: skip
    folders = [folder_name(read_name(name)) for name in names]
    assert len(set(folders)) == len(names)
    assert all("/" not in folder and len(folder) < 120 for folder in folders)
    assert folders[0] == "dp3", "where it always was"


def test_every_one_has_jobs_of_its_own_and_students_lie_with_their_teachers_name():
    names = ("simple_dp3", EPSILON, "manicm:simple_dp3", f"manicm:{EPSILON}", "manicm[training.nfe=2]:simple_dp3")
    jobs = [job.name for job in all_jobs(plan(env_ids=("adroit/door",), methods=names, seeds=(0,)))]
    assert len(set(jobs)) == len(jobs) == 1 + 2 * len(names)
    assert "adroit/door/seed0/manicm-simple_dp3+head.prediction_type=epsilon/train" in jobs
    assert "adroit/door/seed0/manicm+training.nfe=2-simple_dp3/judge" in jobs


def test_a_list_keeps_the_commas_of_brackets():
    text = f"simple_dp3[backbone.down_dims=64,128;training.steps=9], {EPSILON},manicm:dp3[training.betas=0.9,0.99]"
    assert split_names(text) == (
        "simple_dp3[backbone.down_dims=64,128;training.steps=9]", EPSILON, "manicm:dp3[training.betas=0.9,0.99]",
    )  # fmt: skip
    with pytest.raises(ConfigError, match="has no partner"):
        split_names("simple_dp3[head.nfe=1,manicm")


@pytest.mark.parametrize(
    ("names", "error", "text"),
    [
        (["simple_dp3[head.prediction_typ=epsilon]"], UnknownNameError, "did you mean 'head.prediction_type'"),
        (["simple_dp3[training.steps=many]"], ConfigError, "training.steps takes a whole number"),
        (["manicm[head.nfe=2]"], UnknownNameError, "unknown configuration key 'head'"),
        (["one_step[training.steps=3]"], ConfigError, "one_step is not trained"),
        (["simple_dp3[steps]"], ConfigError, "brackets of a method hold KEY=VALUE"),
        (["simple_dp3[training.steps=1;training.steps=2]"], ConfigError, "each key once"),
        (["simple_dp3[a=1][b=2]"], ConfigError, "a method is written NAME"),
        (["manicm:bc[a=1]"], UnknownNameError, "unknown teacher 'bc'"),
        (["voxel_manicm:simple_dp3"], ConfigError, "that of simple_dp3 is manicm: use 'manicm'"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_runs(names, error, text):
    with pytest.raises(error, match=text):
        plan(methods=tuple(names))


def test_no_more_evaluations_than_steps_that_an_override_leaves():
    plan(methods=("simple_dp3",), evaluations=20)
    with pytest.raises(ConfigError, match=r"from 5 .* to 8"):
        plan(methods=("simple_dp3[training.steps=8]",), evaluations=20)


def test_kept_results_with_overrides_are_summed_up_anew():
    cells = [
        {"env_id": "adroit/door", "group": "adroit", "method": name, "nfe": 10, "outcomes": {"0": [True, False]},
         "mean_of_5_highest": None, "latency_ms": None}
        for name in ("simple_dp3", EPSILON)
    ]  # fmt: skip
    rows = [{"method": name, "decision_ms": 1.0} for name in ("simple_dp3", EPSILON)]
    found = summarised({"cells": cells, "rows": rows, "env_ids": ["adroit/door"]})
    assert [row["method"] for row in found["rows"]] == ["simple_dp3", EPSILON]
