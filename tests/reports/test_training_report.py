"""The report on a training: real small ones, finished, cut off, shipped, of format 1, evaluated on the way."""

import importlib
import io
import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from manicm_ms import tasks
from manicm_ms.cli import main
from manicm_ms.demos.collect import collect
from manicm_ms.errors import CheckpointError, ConfigError
from manicm_ms.evaluation.evaluate import evaluate
from manicm_ms.policies.checkpoint import load_checkpoint
from manicm_ms.reports.evaluations import named_evaluation
from manicm_ms.reports.training_report import report_training
from manicm_ms.training.distill import distill
from manicm_ms.training.log import read_log
from manicm_ms.training.presets import STUDENT_PRESETS, TEACHER_PRESETS
from manicm_ms.training.run_folder import snapshot_folders
from manicm_ms.training.train import train

REPO = Path(__file__).parents[2]
TOY_TASKS = REPO / "tests" / "benchmark" / "toy_tasks"
QUIET = {"device": "cpu", "precision": "32-true", "console": Console(file=io.StringIO())}
TEACHER = replace(
    TEACHER_PRESETS.get("smoke"), steps=12, warmup_steps=2, log_every=3,
    changes={"backbone": {"down_dims": (16, 32)}, "head": {"prediction_type": "epsilon"}},
)  # fmt: skip


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A teacher and its student on a toy task; the teacher evaluated, as it was halfway and in the end."""
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MANICM_MS_TASKS", str(TOY_TASKS))
        if str(TOY_TASKS) not in tasks.__path__:
            tasks.__path__.append(str(TOY_TASKS))
        importlib.import_module("manicm_ms.tasks.bench_points")
        data = collect("toy/near", 2, folder / "near.zarr", console=QUIET["console"]).path
        teacher = train(
            "simple_dp3", data, folder / "teacher", TEACHER, seed=3, snapshots=2, command="python x", **QUIET
        )
        student = replace(STUDENT_PRESETS.get("smoke"), steps=4, warmup_steps=1, solver_stride=20)
        distill(teacher, data, folder / "student", student, command="pytest", **QUIET)
        evaluate(
            [teacher, snapshot_folders(teacher)[6]], "toy/near", 3, 500, folder / "evaluated", num_envs=1, videos=0,
            repetitions=1, command="manicm-ms evaluate these", console=QUIET["console"],
        )  # fmt: skip
    return folder


def pages(checkpoint, out, *evaluations):
    """Both files of a report."""
    page = report_training(checkpoint, evaluations, out)
    return page.read_text(), page.with_suffix(".md").read_text()


def table(markdown, title):
    """The rows of the table of a section, cells stripped, without its head."""
    section = re.split(r"^## ", markdown, flags=re.MULTILINE)
    (mine,) = (text for text in section if text.startswith(title))
    lines = [line for line in mine.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_curves_and_numbers_are_those_of_the_log(runs, tmp_path):
    html, markdown = pages(runs / "teacher", tmp_path)
    log = read_log(runs / "teacher.train" / "log.jsonl")
    assert [(int(row[0]), row[1]) for row in table(markdown, "Loss")] == [
        (line["step"], f"{line['loss']:.4g}") for line in log
    ]
    assert [line["step"] for line in log] == [3, 6, 9, 12]
    assert "Finished: 12 steps." in markdown
    assert html.count("<svg") == 1
    assert not re.search(r"""(src|href)=["'](?!#)|https?://(?!www\.w3\.org|purl)""", html), "it loads nothing"


def test_parts_configuration_and_data_are_told(runs, tmp_path):
    html, markdown = pages(runs / "teacher", tmp_path)
    policy = load_checkpoint(runs / "teacher")
    of = lambda prefix: sum(p.numel() for name, p in policy.named_parameters() if name.startswith(prefix))  # noqa: E731
    assert table(markdown, "Parameters") == [
        ["encoder", f"{of('encoder'):,}"], ["backbone", f"{of('head.backbone'):,}"], ["total", f"{of(''):,}"],
    ]  # fmt: skip
    configuration = dict(table(markdown, "Configuration"))
    assert (configuration["backbone.down_dims"], configuration["head.prediction_type"]) == ("16, 32", "epsilon")
    assert (configuration["training.batch_size"], configuration["chunk.horizon"]) == ("16", "4")
    data = dict(table(markdown, "Demonstrations"))
    manifest = json.loads((runs / "teacher" / "manifest.json").read_text())
    assert (data["episodes"], data["seeds"]) == ("2", "0 to 1")
    assert data["sha256"] == manifest["provenance"]["data"]["sha256"]
    assert "manicm-ms collect toy/near" in data["command"]
    assert data["sha256"] in html
    assert "Changed from the preset: backbone.down_dims, head.prediction_type." in markdown


def commands(markdown):
    """The command lines of the report's last section."""
    return re.search(r"^## Reproduce.*?```\n(.*?)\n```", markdown, re.MULTILINE | re.DOTALL)[1].splitlines()


@pytest.mark.parametrize(("name", "works"), [("teacher", "train"), ("student", "distill")])
def test_the_command_of_the_report_is_that_very_training(runs, tmp_path, capsys, name, works):
    """Given again it finds the run done: no field of its identity differs."""
    shown = commands(pages(runs / name, tmp_path)[1])
    words = shlex.split(next(line for line in shown if line.startswith(f"manicm-ms {works}")))[1:]
    with pytest.raises(SystemExit) as end:
        main(words)
    assert end.value.code == 0
    assert "is finished: nothing to do" in capsys.readouterr().err
    assert shown[0].endswith(f"--out {runs / 'near.zarr'}")


def test_a_student_names_its_teacher(runs, tmp_path):
    teacher = dict(table(pages(runs / "student", tmp_path)[1], "Teacher"))
    digest = json.loads((runs / "teacher" / "manifest.json").read_text())["files"]["model.safetensors"]["sha256"]
    assert teacher["SHA-256 of its weights"] == digest
    assert (teacher["steps"], teacher["seed"], teacher["checkpoint"]) == ("12", "3", str(runs / "teacher"))


def test_evaluations_that_are_named_stand_in_it_and_over_time(runs, tmp_path):
    html, markdown = pages(runs / "teacher", tmp_path, runs / "evaluated")
    last, _, early = json.loads((runs / "evaluated" / "results.json").read_text())["policies"]
    rows = table(markdown, f"Evaluation {runs / 'evaluated'}")
    assert [row[0] for row in rows] == [f"{name} (this one)" for name in ("teacher", "teacher, one step", "00000006")]
    assert rows[0][3].startswith(f"{last['successes']}/3 = ")
    assert [row[:2] for row in table(markdown, "Success over the training")] == [
        ["6", f"{early['successes']}/3"], ["12", f"{last['successes']}/3"],
    ]  # fmt: skip
    assert html.count("<svg") == 2
    assert "manicm-ms evaluate these" in commands(markdown)


def test_what_a_benchmark_found_on_the_way_is_shown(runs, tmp_path):
    job = tmp_path / "simple_dp3"
    shutil.copytree(runs / "teacher", job / "checkpoint")
    found = [{"step": 6, "n": 20, "successes": 3}, {"step": 12, "n": 20, "successes": 11}]
    (job / "judge.json").write_text(json.dumps({"evaluations": found}))
    rows = table(pages(job / "checkpoint", tmp_path / "out")[1], "Success over the training")
    assert [row[:3] for row in rows] == [["6", "3/20", "15.0 %"], ["12", "11/20", "55.0 %"]]


def test_a_run_that_was_cut_off_says_how_far_it_is(runs, tmp_path):
    """What a kill leaves: no checkpoint yet, and a log whose last line it tore."""
    shutil.copytree(runs / "teacher.train", tmp_path / "t.train")
    log = tmp_path / "t.train" / "log.jsonl"
    log.write_text("\n".join(log.read_text().splitlines()[:2]) + '\n{"step": 9, "lo')
    html, markdown = pages(tmp_path / "t", tmp_path / "out")
    assert "Not finished: 6 of 12 steps logged so far (50 %)." in markdown
    assert table(markdown, "Parameters") == table(pages(runs / "teacher", tmp_path / "whole")[1], "Parameters")
    assert dict(table(markdown, "Configuration"))["head.prediction_type"] == "epsilon"
    assert html.count("<svg") == 1
    assert not (tmp_path / "t").exists(), "it is not disturbed"


def test_a_run_under_way_of_a_former_version_tells_what_it_can(runs, tmp_path):
    shutil.copytree(runs / "teacher.train", tmp_path / "t.train")
    (tmp_path / "t.train" / "record.json").unlink()
    (tmp_path / "t.train" / "log.jsonl").unlink()
    _, markdown = pages(tmp_path / "t", tmp_path / "out")
    assert "Not finished: 0 of 12 steps logged so far (0 %)." in markdown
    assert "Nothing is logged yet." in markdown
    assert "The commands were not written down." in markdown


@pytest.mark.parametrize(
    "folder",
    ["checkpoints/slide_block/student", *(f"tests/policies/data/format_1/{k}" for k in ("teacher", "student"))],
)
def test_a_checkpoint_alone_says_that_there_is_no_log(folder, tmp_path):
    _, markdown = pages(REPO / folder, tmp_path)
    assert "There is no log" in markdown
    assert dict(table(markdown, "Configuration"))["encoder.name"] == "dp3"
    assert table(markdown, "Parameters")[-1][0] == "total"


def test_the_log_of_another_run_is_not_taken_for_its_own(runs, tmp_path):
    shutil.copytree(runs / "student", tmp_path / "x")
    shutil.copytree(runs / "teacher.train", tmp_path / "x.train")
    assert "There is no log" in pages(tmp_path / "x", tmp_path / "out")[1]


def test_bad_input_is_refused_and_nothing_is_written(runs, tmp_path):
    with pytest.raises(CheckpointError, match="there is no checkpoint folder"):
        report_training(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="no finished evaluation"):
        report_training(runs / "teacher", [runs / "teacher.train"], tmp_path / "out")
    with pytest.raises(ConfigError, match="no evaluation of this training's checkpoint"):
        report_training(runs / "student", [runs / "evaluated"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("results", "run"), [("[]", "{}"), ("{}", "[1]"), ('{"policies": [1]}', '{"policies": [1]}')])
def test_a_damaged_evaluation_is_refused_in_one_line(tmp_path, results, run):
    (tmp_path / "results.json").write_text(results)
    (tmp_path / "run.json").write_text(run)
    with pytest.raises(ConfigError, match="cannot be read as an evaluation's"):
        named_evaluation(tmp_path, {})


def test_a_checkpoint_evaluated_otherwise_is_shown_but_no_point_of_the_training(runs, tmp_path):
    folder = shutil.copytree(runs / "evaluated", tmp_path / "evaluated")
    for name in ("results.json", "run.json"):
        (folder / name).write_text((folder / name).read_text().replace('"teacher"', '"teacher@4"'))
    results = json.loads((folder / "results.json").read_text())
    for policy in results["policies"]:
        policy["role"] = "teacher" if policy["role"] == "teacher@4" else policy["role"]
    (folder / "results.json").write_text(json.dumps(results))
    steps = {digest: k for k, (_, _, digest) in enumerate(json.loads((folder / "run.json").read_text())["policies"])}
    found = named_evaluation(folder, steps)
    assert any(row[0] == "teacher@4 (this one)" for row in found.rows)
    assert len(found.points) == 1
