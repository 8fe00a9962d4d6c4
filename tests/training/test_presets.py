"""Presets: what the presets are said to be, and combinations that are refused."""

from dataclasses import fields, replace

import pytest
from reach_demos import reach_spec

from manicm_ms.errors import ConfigError, UnknownNameError
from manicm_ms.policies.methods import METHODS, make_policy
from manicm_ms.spec import ChunkSpec
from manicm_ms.training.presets import STUDENT_PRESETS, TEACHER_PRESETS, StudentPreset, TeacherPreset, preset_for
from manicm_ms.training.settings import flag_values, preset_identity


def test_paper_student_is_the_paper_s():
    """ManiCM, section 4.1: AdamW, batch 128, 5e-5, 3K epochs, cosine, 500 warm-up, mu 0.95, k = 10."""
    preset = STUDENT_PRESETS.get("paper")
    assert (preset.batch_size, preset.learning_rate, preset.epochs) == (128, 5e-5, 3000)
    assert (preset.warmup_steps, preset.ema_decay, preset.solver_stride) == (500, 0.95, 10)


def test_paper_teacher_observes_two_frames_predicts_four_actions_and_executes_two():
    config = TEACHER_PRESETS.get("paper").configuration("dp3")
    assert config["chunk"] == {"n_obs_steps": 2, "horizon": 4, "n_action_steps": 2}
    assert METHODS.get("dp3").chunk_of("paper") == ChunkSpec(2, 4, 2)
    assert flag_values("dp3", TEACHER_PRESETS.get("paper"))["points"] is None


@pytest.mark.parametrize("registry", [TEACHER_PRESETS, STUDENT_PRESETS])
def test_both_kinds_have_the_same_presets(registry):
    assert registry.names() == ("quick", "smoke", "paper")
    with pytest.raises(UnknownNameError, match="did you mean 'quick'"):
        registry.get("quik")


def test_a_field_added_later_does_not_make_an_older_run_another_one():
    quick = TEACHER_PRESETS.get("quick")

    def identity(changes):
        return preset_identity(quick.with_changes(changes), "simple_dp3")

    older = identity({"normalizer": {"min_state_range": 0.0}})
    assert not {"acting_points", "training_points", "min_state_range"} & set(older)
    assert identity({})["min_state_range"] == 0.02
    assert identity({"inputs": {"points": {"acting": "random"}}})["acting_points"] == "random"
    assert identity({})["points"] == 128


FORMER_TEACHER = {
    "steps", "epochs", "batch_size", "learning_rate", "betas", "weight_decay", "warmup_steps", "clip_norm", "log_every",
    "save_every", "threads", "n_obs_steps", "horizon", "n_action_steps", "prediction_type", "cloud_frame",
    "cloud_scale", "points", "acting_points", "training_points", "min_state_range", "down_dims", "ema_power",
    "ema_max_decay", "precision",
}  # fmt: skip
"""Fields of a teacher's preset in the first release."""


@pytest.mark.parametrize("name", ["quick", "smoke", "paper"])
@pytest.mark.parametrize("method", ["dp3", "simple_dp3"])
def test_an_identity_has_the_words_of_the_first_release(name, method):
    """A run of that release goes on, or is found finished, where nothing but these words decides."""
    told = preset_identity(TEACHER_PRESETS.get(name), method)
    assert FORMER_TEACHER - {"acting_points", "training_points", "min_state_range"} <= set(told) <= FORMER_TEACHER
    frames = {"quick": "auto", "smoke": "auto", "paper": "base"}
    widths = {"quick": [64, 128, 256], "smoke": [32, 64], "paper": None}
    assert told["cloud_frame"] == frames[name]
    assert (None if told["down_dims"] is None else list(told["down_dims"])) == widths[name]
    assert (told["n_obs_steps"], told["horizon"]) == (2, 4)
    assert told["n_action_steps"] == (2 if name == "paper" else 3)
    student = preset_identity(STUDENT_PRESETS.get(name))
    assert (student["mu"], student["skip"]) == (0.95, 10)
    assert not {"ema_decay", "solver_stride", "size", "changes"} & {*student, *told}


def test_what_is_no_flag_tells_runs_apart_too():
    quick = TEACHER_PRESETS.get("quick")
    plain = preset_identity(quick, "simple_dp3")
    other = preset_identity(quick.with_changes({"backbone": {"mid_blocks": 3}}), "simple_dp3")
    assert "configuration" not in plain
    assert other["configuration"]["backbone"]["mid_blocks"] == 3
    assert {k: v for k, v in other.items() if k != "configuration"} == plain


def test_changes_reach_the_policy_the_lengths_and_the_preset_itself():
    changes = {"training": {"steps": 700}, "chunk": {"horizon": 8}, "backbone": {"down_dims": [16, 32]}}
    preset = TEACHER_PRESETS.get("paper").with_changes(changes)
    assert (preset.steps, preset.epochs) == (700, None)
    config = preset.configuration("simple_dp3")
    assert config["chunk"] == {"n_obs_steps": 2, "horizon": 8, "n_action_steps": 2}
    assert config["backbone"]["down_dims"] == [16, 32]
    assert TEACHER_PRESETS.get("paper").changes == {}
    again = preset.with_changes({"backbone": {"mid_blocks": 2}}).configuration("simple_dp3")["backbone"]
    assert (again["down_dims"], again["mid_blocks"]) == ([16, 32], 2)
    student = STUDENT_PRESETS.get("quick").with_changes({"training": {"nfe": 4}})
    assert student == replace(STUDENT_PRESETS.get("quick"), nfe=4)


@pytest.mark.parametrize(
    ("registry", "changes", "message"),
    [
        (TEACHER_PRESETS, {"training": {"step": 7}}, "did you mean 'training.steps'"),
        (STUDENT_PRESETS, {"training": {"solver_strid": 7}}, "did you mean 'training.solver_stride'"),
        (STUDENT_PRESETS, {"backbone": {"down_dims": [8]}}, "unknown configuration key 'backbone'"),
        (TEACHER_PRESETS, {"training": {"size": "quik"}}, "unknown size 'quik': did you mean 'quick'"),
    ],
)
def test_a_field_that_does_not_exist_is_answered_with_the_nearest(registry, changes, message):
    with pytest.raises(UnknownNameError, match=message):
        registry.get("quick").with_changes(changes)


@pytest.mark.parametrize("kind", [TeacherPreset, StudentPreset])
def test_every_field_is_documented(kind):
    documentation = "".join(cls.__doc__ for cls in kind.__mro__[:-1])
    assert [f.name for f in fields(kind) if f"        {f.name}: " not in documentation] == []


@pytest.mark.parametrize(
    ("registry", "change"),
    [
        (TEACHER_PRESETS, {"epochs": 5}),
        (STUDENT_PRESETS, {"ema_decay": 1.0}),
        (STUDENT_PRESETS, {"solver_stride": 0}),
    ],
)
def test_fields_that_do_not_fit_are_refused(registry, change):
    with pytest.raises(ConfigError):
        replace(registry.get("quick"), **change)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"chunk": {"n_action_steps": 4}}, "exceeds"),
        ({"inputs": {"points": {"max_points": 0}}}, "max_points must be at least 1 or None, got 0"),
        ({"inputs": {"points": {"acting": "first"}}}, "unknown choice of points 'first'"),
        ({"inputs": {"points": {"training": "first"}}}, "unknown choice of points 'first'"),
        ({"inputs": {"cloud_frame": {"scale": 0.0}}}, "above 0 m, got 0.0"),
        ({"normalizer": {"min_state_range": -1.0}}, "min_state_range must be at least 0"),
        ({"chunk": 3}, "chunk takes keys of its own"),
        ({"training": {"steps": 2.5}}, "training.steps takes a whole number or null, got 2.5"),
    ],
)
def test_keys_of_the_policy_that_do_not_fit_are_refused(changes, message):
    def made():
        config = TEACHER_PRESETS.get("quick").with_changes(changes).configuration("simple_dp3")
        chunk = ChunkSpec(**config.pop("chunk"))
        return make_policy("simple_dp3", reach_spec(), chunk, config)

    with pytest.raises((ConfigError, UnknownNameError), match=message):
        made()


def test_the_identity_of_a_later_method_holds_what_its_row_and_parts_say(monkeypatch):
    """Else a run of a row that was edited would be found finished."""
    quick, row = preset_for("pocket_dp3", "quick"), METHODS.get("pocket_dp3")
    before = preset_identity(quick, "pocket_dp3")
    for change in ({"head": {"name": "diffusion", "num_inference_steps": 50}}, {"objective": "plain"}):
        monkeypatch.setitem(METHODS._entries, "pocket_dp3", replace(row, **change))
        assert preset_identity(quick, "pocket_dp3") != before
    monkeypatch.setitem(METHODS._entries, "pocket_dp3", row)
    assert preset_identity(quick, "pocket_dp3") == before
    assert preset_identity(quick.with_changes({"backbone": {"width": 64}}), "pocket_dp3") != before


def test_an_optimizer_of_a_row_is_checked_as_any_other_field(monkeypatch):
    monkeypatch.setitem(METHODS._entries, "dp3", replace(METHODS.get("dp3"), optimizer={"lr": 1}))
    with pytest.raises(UnknownNameError, match=r"training\.lr"):
        preset_for("dp3", "quick")
