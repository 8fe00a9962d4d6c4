"""The environment benchmark: where a worker's time goes, and why it cannot run on a GPU where there is none."""

import pytest
import torch

from manicm_ms.bench.env import Timed, shares, shares_table
from manicm_ms.cli import main


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_a_missing_gpu_is_named_in_one_line(capsys):
    with pytest.raises(SystemExit) as end:
        main(["bench", "env", "--backend", "gpu", "--num-envs", "1", "16"])
    assert end.value.code == 2
    out, err = capsys.readouterr()
    (line,) = [line for line in err.splitlines() if line.startswith("manicm-ms: ")]
    assert "backend 'gpu' cannot run here: torch finds no CUDA device; use backend 'cpu'" in line
    assert "Traceback" not in err
    assert out == ""


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--env", "ur3e/slide-blok"], "did you mean 'ur3e/slide-block'"),
        (["--env", "adroit/door"], "adroit/door does not run on ManiSkill"),
        (["--num-envs", "2", "0"], "num_envs must be at least 1, got 0"),
        (["--repetitions", "0"], "--repetitions must be at least 1"),
    ],
)
def test_bad_input_is_one_line_and_measures_nothing(words, said, capsys):
    with pytest.raises(SystemExit) as end:
        main(["bench", "env", *words])
    assert end.value.code == 2
    out, err = capsys.readouterr()
    (line,) = [line for line in err.splitlines() if line.startswith("manicm-ms: ")]
    assert said in line
    assert out == ""


def test_the_parts_of_a_workers_step_are_all_found():
    """They are watched by name: one that has another name now must not drop out of the table unseen."""
    parts = shares("ur3e/slide-block", steps=3)
    assert {name.split(" (")[0] for name in parts} == {
        "controller", "physics", "evaluate", "rendering", "cloud", "rest",
    }  # fmt: skip
    assert all(ms > 0 for ms in parts.values())
    assert shares_table(parts).splitlines()[-1] == f"| all | {sum(parts.values()):.2f} | |"


def test_a_rate_counts_the_steps_of_all_rows():
    played, timed = [], Timed()
    timed.take(played.append, 5, 3)
    assert played == [5]
    assert timed.rates[0] > 0
    assert timed.cpu_ms[0] >= 0
