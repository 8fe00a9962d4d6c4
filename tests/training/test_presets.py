"""Presets: what the presets are said to be, and combinations that are refused."""

from dataclasses import fields, replace

import pytest

from manicm_ms.errors import ConfigError, UnknownNameError
from manicm_ms.training.presets import STUDENT_PRESETS, TEACHER_PRESETS, StudentPreset, TeacherPreset, preset_identity


def test_paper_student_is_the_paper_s():
    """ManiCM, section 4.1: AdamW, batch 128, 5e-5, 3K epochs, cosine, 500 warm-up, mu 0.95, k = 10."""
    preset = STUDENT_PRESETS.get("paper")
    assert (preset.batch_size, preset.learning_rate, preset.epochs) == (128, 5e-5, 3000)
    assert (preset.warmup_steps, preset.mu, preset.skip) == (500, 0.95, 10)


def test_paper_teacher_observes_two_frames_predicts_four_actions_and_executes_two():
    preset = TEACHER_PRESETS.get("paper")
    assert (preset.chunk.n_obs_steps, preset.chunk.horizon, preset.chunk.n_action_steps) == (2, 4, 2)
    assert preset.points is None


@pytest.mark.parametrize("registry", [TEACHER_PRESETS, STUDENT_PRESETS])
def test_both_kinds_have_the_same_presets(registry):
    assert registry.names() == ("quick", "smoke", "paper")
    with pytest.raises(UnknownNameError, match="did you mean 'quick'"):
        registry.get("quik")


def test_a_field_added_later_does_not_make_an_older_run_another_one():
    quick = TEACHER_PRESETS.get("quick")
    older = replace(quick, min_state_range=0.0)
    assert not {"acting_points", "training_points", "min_state_range"} & set(preset_identity(older))
    assert preset_identity(quick)["min_state_range"] == 0.02
    assert preset_identity(replace(quick, acting_points="random"))["acting_points"] == "random"
    assert preset_identity(quick)["points"] == 128


@pytest.mark.parametrize("kind", [TeacherPreset, StudentPreset])
def test_every_field_is_documented(kind):
    documentation = "".join(cls.__doc__ for cls in kind.__mro__[:-1])
    assert [f.name for f in fields(kind) if f"        {f.name}: " not in documentation] == []


@pytest.mark.parametrize(
    ("registry", "change"),
    [
        (TEACHER_PRESETS, {"n_action_steps": 4}),
        (TEACHER_PRESETS, {"points": 0}),
        (TEACHER_PRESETS, {"cloud_scale": 0.0}),
        (TEACHER_PRESETS, {"epochs": 5}),
        (STUDENT_PRESETS, {"mu": 1.0}),
        (STUDENT_PRESETS, {"skip": 0}),
    ],
)
def test_fields_that_do_not_fit_are_refused(registry, change):
    with pytest.raises(ConfigError):
        replace(registry.get("quick"), **change)
