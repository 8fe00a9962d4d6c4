"""Lists fit the terminal that they are read on, and say what a user can choose."""

import io

import pytest
from rich.console import Console

from manicm_ms.cli import collecting, listing, main
from manicm_ms.demos.expert_files import EXPERT_FILES
from manicm_ms.demos.experts import EXPERTS
from manicm_ms.envs.simulator import ENVS
from manicm_ms.policies.methods import METHODS
from manicm_ms.training.presets import TEACHER_PRESETS


@pytest.fixture
def shown(monkeypatch):
    """Run a list command on a terminal of the given width; return what stands on it."""

    def run(width, *arguments):
        file = io.StringIO()
        terminal = Console(file=file, width=width, force_terminal=True, color_system=None)
        for module in (listing, collecting):
            monkeypatch.setattr(module, "console", lambda: terminal)
        with pytest.raises(SystemExit) as end:
            main(list(arguments))
        assert not end.value.code
        return file.getvalue()

    return run


NAMES = {
    ("list", "envs"): ENVS.names,
    ("list", "policies"): METHODS.names,
    ("list", "presets"): TEACHER_PRESETS.names,
    ("experts", "list"): EXPERT_FILES.names,
}


@pytest.mark.parametrize("width", [60, 80, 100, 200])
@pytest.mark.parametrize("command", NAMES)
def test_every_list_fits_and_cuts_nothing_off(shown, command, width):
    text = shown(width, *command)
    links = [line for line in text.splitlines() if "https://" in line]  # one word, which is not cut
    assert max(len(line) for line in text.splitlines() if line not in links) <= width
    assert all(len(line.split()) <= 2 for line in links if len(line) > width)
    assert "…" not in text
    assert "None" not in text
    words = " ".join(text.split())
    assert all(name in words for name in NAMES[command]())


def test_the_overview_fits_the_terminal(shown, capsys):
    shown(80, "--help")
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert any(line.startswith(" " * 12) for line in lines), "summaries go on in their own column"


def test_what_is_told_of_an_environment_is_the_same_in_any_width(shown):
    spec = ENVS.get("ur3e/slide-block").spec
    styles = ", ".join(EXPERTS.get("ur3e/slide-block").styles)
    narrow, wide = (" ".join(shown(width, "list", "envs", "--tag", "ur3e").split()) for width in (80, 200))
    for value in (f"{spec.obs.num_points}x3", str(spec.obs.agent_pos_dim), spec.obs.frame, styles):
        assert value in narrow
        assert value in wide
    assert f"agent_pos {spec.obs.agent_pos_dim}; action {spec.action.dim}; Hz {spec.action.control_hz:g};" in narrow


def test_every_policy_has_a_sentence_for_users(shown):
    text, words = shown(400, "list", "policies"), " ".join(shown(80, "list", "policies").split())
    assert "Build" not in text
    assert "`" not in text
    rows = {
        cells[0]: cells for cells in ([c.strip() for c in line.split("│")[1:]] for line in text.splitlines()) if cells
    }
    for name in METHODS.names():
        row = METHODS.get(name)
        assert row.sentence.endswith(".")
        assert row.reference
        assert row.sentence in rows[name]
        assert row.reference in rows[name]
        assert row.sentence in words
        assert row.reference in words


def test_the_table_of_policies_names_the_parts_the_lengths_and_the_evaluations(shown):
    lines = [[cell.strip() for cell in line.split("│")[1:-1]] for line in shown(400, "list", "policies").splitlines()]
    rows = {cells[0]: cells[1:7] for cells in lines if cells}
    assert rows["dp3"] == ["dp3", "unet1d", "diffusion", "averaged", "2, 4, 3", "10"]
    assert rows["manicm"] == ["dp3", "unet1d", "consistency", "consistency", "2, 4, 3", "1"]


def test_presets_say_what_leaving_a_field_out_means(shown):
    rows = {line.split("│")[1].strip(): line for line in shown(80, "list", "presets").splitlines() if "│" in line}
    assert "no clipping" in rows["clip_norm"]
    titles = [line.strip() for line in shown(80, "list", "presets").splitlines() if "presets" in line]
    assert titles == ["training presets, as for simple_dp3", "student presets"]
