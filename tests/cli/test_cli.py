"""`manicm-ms` as its users meet it: exit statuses, one-line errors, presets as options, and going on after Ctrl-C."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from typing import get_type_hints

import point_mass_env
import pytest
from reach_demos import make_store

from manicm_ms import __version__
from manicm_ms.cli import INTERRUPTED, USER_ERROR, command_of, main
from manicm_ms.cli.counts import least_values
from manicm_ms.cli.messages import explain
from manicm_ms.policies.checkpoint import read_manifest, verify_checkpoint
from manicm_ms.training.log import read_log
from manicm_ms.training.run_folder import training_folder

COMMANDS = (
    "list", "check", "collect", "experts", "inspect", "convert", "evaluate", "compare", "report", "benchmark",
    "calibrate", "board", "cloud", "doctor", "train", "distill",
)  # fmt: skip
STEPS = 200
TINY = f"--steps {STEPS} --warmup-steps 2 --batch-size 4 --down-dims 8 16 --points 8 --save-every 50 --log-every 1"


def program(*arguments):
    """Start `manicm-ms` in a process of its own, with room for help texts and no colours."""
    command = [sys.executable, "-m", "manicm_ms.cli", *map(str, arguments)]
    env = {**os.environ, "COLUMNS": "200", "NO_COLOR": "1", "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env)


def outcome(process):
    """Wait for a process; return its exit status, output and errors."""
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


@pytest.fixture
def told(capsys):
    """Run a command in this process; return its exit status, output and errors."""

    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main([str(word) for word in arguments])
        return end.value.code, *capsys.readouterr()

    return run


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return make_store(tmp_path_factory.mktemp("demos") / "reach.zarr", episodes=3)


def assert_one_line(result, *parts):
    """The command ended as a user error with one line that holds every part."""
    status, _, err = result
    assert status == USER_ERROR
    assert err.startswith("manicm-ms: ")
    assert err.count("\n") == 1, err
    assert not re.search(r"[A-Z]\w+\(\w+=", err), "no dataclass is shown as Python writes it"
    for part in parts:
        assert part in err


# ---- overview, help, version


def test_without_a_command_it_shows_all_of_them_and_fails():
    status, out, _ = outcome(program())
    assert status == USER_ERROR
    assert [line.split()[0] for line in out.splitlines()[2:]] == [*COMMANDS, "bench"]


def test_help_shows_the_same_and_succeeds(told):
    assert told("--help")[:2] == (0, told()[1])


def test_version():
    assert outcome(program("--version")) == (0, f"{__version__}\n", "")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(told, command):
    status, out, _ = told(command, "--help")
    assert status == 0
    assert f"usage: manicm-ms {command}" in out


def test_the_named_preset_gives_the_defaults(told):
    def default(option, *arguments):
        words = " ".join(re.sub("[│╭╮╰╯─]", " ", told("train", *arguments, "--help")[1]).split())
        return re.search(rf"--{option} \S+ .*?\(default: (.*?)\)", words)[1]

    assert default("n-action-steps") == default("n-action-steps", "--preset", "quick") == "3"
    assert default("n-action-steps", "--preset=paper") == default("n-action-steps", "--preset", "paper") == "2"
    assert default("learning-rate", "--preset=paper") == "0.0001"


# ---- lists


def test_list_envs_and_their_tags():
    status, out, _ = outcome(program("list", "envs", "--tag", "ur3e"))
    assert status == 0
    assert re.search(r"ur3e/slide-block .*512x3", out)


@pytest.mark.parametrize(("kind", "names"), [("policies", ("dp3", "simple_dp3", "manicm")), ("presets", ("paper",))])
def test_list(told, kind, names):
    status, out, _ = told("list", kind)
    assert status == 0
    assert all(name in out for name in names)


def test_list_refuses_an_unknown_tag(told):
    assert_one_line(told("list", "envs", "--tag", "ur3"), "unknown tag 'ur3'", "did you mean 'ur3e'?", "real-robot")


@pytest.mark.parametrize("kind", ["policies", "presets"])
def test_list_refuses_a_tag_of_what_has_none(told, kind):
    assert_one_line(told("list", kind, "--tag", "ur3e"), "--tag", kind)


# ---- what a user can get wrong


def test_unknown_command_in_a_real_process():
    assert_one_line(outcome(program("colect")), "unknown command 'colect': did you mean 'collect'?")


@pytest.mark.parametrize(
    ("line", "hint"),
    [
        ("train dp3 --data DATA --out OUT --preset quik", "unknown teacher preset 'quik': did you mean 'quick'?"),
        ("distill --teacher T --data DATA --out OUT --preset=papr", "'papr': did you mean 'paper'?"),
        ("train dp33 --data DATA --out OUT --preset smoke", "unknown method 'dp33': did you mean 'dp3'?"),
        ("collect ur3e/slide-blok --out OUT", "'ur3e/slide-blok': did you mean 'ur3e/slide-block'?"),
        ("collect button-press-v2", "unknown env id 'button-press-v2': it is called 'metaworld/button-press' here"),
        ("collect metaworld/hamer", "did you mean 'metaworld/hammer'?"),
        ("collect", "name one environment id, or --tag"),
        ("collect ur3e/slide-block --tag ur3e", "name one environment id, or --tag"),
        ("collect --tag benchmark3", "unknown tag 'benchmark3': did you mean 'benchmark31'?"),
        ("collect --tag adroit --style dapg", "--style belongs to one environment"),
        ("experts fetch adroit/dor", "unknown expert file 'adroit/dor': did you mean 'adroit/door'?"),
        ("experts fetch --from OUT", "name a folder that holds door.npz"),
        ("experts list --from OUT", "--from goes with 'experts fetch'"),
        ("benchmark --envs AdroitHandPen-v1 --out OUT", "it is called 'adroit/pen' here"),
        ("benchmark --methods simple_dp --out OUT", "unknown method 'simple_dp': did you mean 'simple_dp3'?"),
        ("benchmark --preset papr --out OUT", "unknown teacher preset 'papr': did you mean 'paper'?"),
        ("benchmark --seeds one --out OUT", "--seeds takes whole numbers separated by commas"),
        ("check ur3e/slide-blok", "'ur3e/slide-blok': did you mean 'ur3e/slide-block'?"),
        ("collect ur3e/slide-block --out OUT --extras img", "choose from image, depth, privileged_state"),
        (
            "train dp3 --data DATA --out OUT --n-action-steps 4",
            "n_action_steps=4 exceeds horizon - n_obs_steps + 1 = 3",
        ),
        ("train dp3 --data DATA --out OUT --steps 20", "warmup_steps=100 leaves nothing of steps=20"),
        ("train manicm --data DATA --out OUT --points 8", "manicm learns from a teacher, not from demonstrations"),
        ("train dp3 --data DATA --out OUT --points 8 --set head.steps=4", "unknown configuration key 'head.steps'"),
        ("train dp3 --data DATA --out OUT --points 8 --set unet.width=4", "unknown configuration key 'unet'"),
        ("train dp3 --data DATA --out OUT --set head", "an override is written KEY=VALUE"),
        ("train dp3 --data DATA --out OUT --set head=difusion", "unknown head 'difusion': did you mean 'diffusion'?"),
        ("train dp3 --data DATA --out OUT --set chunk.horizon=wide", "chunk.horizon takes a whole number, got 'wide'"),
        ("train dp3 --data DATA --out OUT --set training.step=4", "did you mean 'training.steps'?"),
        ("train dp3 --data DATA --out OUT --config NOWHERE", "there is no configuration file NOWHERE: check the path"),
        ("train dp3 --data DATA --out OUT --config DATA", "cannot be read"),
        ("distill --teacher T --data DATA --out OUT --set head.nfe=4", "unknown configuration key 'head'"),
        ("distill --teacher T --data DATA --out OUT --set training.nfe=many", "training.nfe takes a whole number"),
        ("distill --teacher T --data DATA --out OUT --ema-decay 1.0", "ema_decay must lie in [0, 1), got 1.0"),
        ("check", "name at least one environment id"),
        ("evaluate --env ur3e/slide-block", "name at least one checkpoint folder"),
    ],
)
def test_one_line_says_what_is_wrong(told, demos, tmp_path, line, hint, monkeypatch):
    monkeypatch.setenv("MANICM_MS_EXPERTS", str(tmp_path / "experts"))
    places = {"DATA": demos, "OUT": tmp_path / "out", "T": tmp_path / "teacher"}
    assert_one_line(told(*(places.get(word, word) for word in line.split())), hint)
    assert not (tmp_path / "out").exists()


def test_unknown_style_of_an_expert():
    arguments = ("collect", "ur3e/slide-block", "--out", os.devnull + "/x.zarr", "--style", "one-side", "--num-envs", 1)
    assert_one_line(outcome(program(*arguments)), "unknown expert style 'one-side': did you mean 'one-sided'?")


def test_an_option_of_no_command_is_refused(told):
    status, _, err = told("inspect", "x.zarr", "--htlm", "page.html")
    assert status == USER_ERROR
    assert "--htlm" in err
    assert "Traceback" not in err


# ---- files


def test_a_folder_that_cannot_be_made_is_one_line(told, demos, tmp_path):
    (tmp_path / "file").touch()
    result = told("train", "dp3", "--data", demos, "--out", tmp_path / "file" / "teacher", *TINY.split())
    assert_one_line(result, str(tmp_path / "file"))


def test_a_file_in_a_folder_that_takes_none_is_one_line(demos):
    assert_one_line(outcome(program("inspect", demos, "--html", "/proc/page.html")), "/proc/", "No such file", "path")


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to root")
def test_a_folder_without_write_permission_is_one_line(told, demos, tmp_path):
    tmp_path.chmod(0o500)
    assert_one_line(told("inspect", demos, "--html", tmp_path / "page.html"), "Permission denied", "permissions")


def test_an_error_about_no_file_is_not_hidden():
    with pytest.raises(ConnectionError, match="a defect"):
        explain(ConnectionError("a defect"))


@pytest.mark.parametrize(
    ("line", "hint"),
    [
        ("collect ur3e/slide-block --out FILE", "FILE is a file: choose a folder for --out"),
        ("train simple_dp3 --data DATA --out FILE", "FILE already holds something else: choose another --out"),
        ("board --out FILE.pdf", "FILE.pdf exists: choose another --out or add --overwrite"),
        ("board --out FOLDER.pdf --overwrite", "FOLDER.pdf is a folder: name a file for --out"),
        ("board --out FILE.pdf/board.pdf", "FILE.pdf is a file, so that FILE.pdf/board.pdf cannot lie in it"),
        ("inspect DATA --html FOLDER", "FOLDER: Is a directory: this is a folder where a file is wanted"),
        ("calibrate NOWHERE --out camera.yaml", "NOWHERE does not exist: name the folder of the recorded views"),
        ("calibrate FILE --out camera.yaml", "FILE is a file: name the folder of the recorded views"),
        ("calibrate FOLDER --out camera.yaml", "FOLDER holds neither poses.json nor poses.csv"),
        ("train simple_dp3 --data NOWHERE --out out", "no store at NOWHERE"),
        ("inspect NOWHERE", "no store at NOWHERE"),
    ],
)
def test_places_that_do_not_fit_are_refused_with_advice_that_helps(told, demos, tmp_path, monkeypatch, line, hint):
    monkeypatch.chdir(tmp_path)
    for name in ("FILE", "FILE.pdf"):
        (tmp_path / name).touch()
    for name in ("FOLDER", "FOLDER.pdf"):
        (tmp_path / name).mkdir()
    result = told(*(str(demos) if word == "DATA" else word for word in line.split()))
    assert_one_line((result[0], "", result[2].splitlines(keepends=True)[-1]), hint)
    assert ".tmp" not in result[2]
    assert f"manicm-ms {line}" not in result[2], "the refused command is no advice"


# ---- work


def test_check_passes_a_sound_environment(told):
    status, out, _ = told("check", point_mass_env.SOUND, "--backend", "cpu")
    assert status == 0
    assert out.count("  ok  ") > 5
    assert "FAIL" not in out


def test_check_fails_a_broken_environment_and_names_the_promise(told):
    env_id, (_, promise) = "toy/ignores-seed", point_mass_env.BROKEN["toy/ignores-seed"]
    status, out, _ = told("check", env_id, "--backend", "cpu")
    assert status == 1
    assert f"FAIL {promise}" in out


def test_ctrl_c_ends_with_130_and_the_same_command_goes_on(told, demos, tmp_path):
    teacher = tmp_path / "teacher"
    command = ("train", "simple_dp3", "--data", demos, "--out", teacher, "--device", "cpu", *TINY.split())
    log = training_folder(teacher) / "log.jsonl"
    process = program(*command)
    while process.poll() is None and not read_log(log):
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    status, _, err = outcome(process)
    assert status == INTERRUPTED, err
    assert err.endswith("stopped; the same command goes on from here\n")
    assert "Traceback" not in err
    reached = len(read_log(log))
    assert 0 < reached < STEPS
    assert not teacher.exists()

    status, _, err = outcome(program(*command))
    assert status == 0, err
    verify_checkpoint(teacher)
    assert [line["step"] for line in read_log(log)] == list(range(1, STEPS + 1))
    assert read_manifest(teacher)["provenance"]["command"].startswith("manicm-ms train simple_dp3 --data ")
    assert f"{teacher} is finished: nothing to do" in told(*command)[2]


# ---- configuration: fields by name, files, overrides


def trained(told, demos, out, *options):
    """Train some steps; return the checkpoint's configuration and the manifest's provenance."""
    small = f"--steps 3 --warmup-steps 1 --batch-size 4 --save-every 50 --device cpu --out {out} --data {demos}"
    status, _, err = told("train", "simple_dp3", *small.split(), *options)
    assert status == 0, err
    return json.loads((out / "config.json").read_text()), read_manifest(out)["provenance"]


def test_a_file_an_option_and_an_override_name_the_same_key_and_the_last_of_them_stands(told, demos, tmp_path):
    path = tmp_path / "small.yaml"
    path.write_text(
        "backbone: {down_dims: [8, 16], mid_blocks: 2}\n"
        "inputs:\n  points: {max_points: 8}\n"
        "head: {num_inference_steps: 5}\nchunk: {horizon: 8}\ntraining: {ema_power: 0.5}\n"
    )
    options = (
        "--config",
        path,
        "--points",
        16,
        "--set",
        "head.num_inference_steps=2",
        "--set",
        "chunk.n_action_steps=5",
    )
    described, made = trained(told, demos, tmp_path / "out", *options)
    config = described["config"]
    assert (config["backbone"]["down_dims"], config["backbone"]["mid_blocks"]) == ([8, 16], 2)
    assert config["inputs"]["points"]["max_points"] == 16
    assert config["head"]["num_inference_steps"] == 2
    assert described["chunk"] == {"n_obs_steps": 2, "horizon": 8, "n_action_steps": 5}
    assert made["preset"]["steps"] == 3


def test_a_short_option_and_its_key_are_the_same_run(told, demos, tmp_path):
    out = tmp_path / "out"
    trained(told, demos, out, "--down-dims", 8, 16, "--points", 8)
    small = ("--steps", 3, "--warmup-steps", 1, "--batch-size", 4, "--save-every", 50, "--device", "cpu")
    keys = ("--set", "backbone.down_dims=8,16", "--set", "inputs.points.max_points=8")
    status, _, err = told("train", "simple_dp3", "--data", demos, "--out", out, *small, *keys)
    assert status == 0
    assert "is finished: nothing to do" in err


def test_a_field_of_a_file_is_not_undone_by_the_presets_value(told, demos, tmp_path):
    path = tmp_path / "decay.yaml"
    path.write_text("training: {weight_decay: 0.25, learning_rate: 0.02}\n")
    options = ("--config", path, "--down-dims", 8, 16, "--points", 8, "--learning-rate", 0.03)
    made = trained(told, demos, tmp_path / "out", *options)[1]
    assert (made["preset"]["weight_decay"], made["preset"]["learning_rate"]) == (0.25, 0.03)


def test_fields_of_a_distillation_have_their_former_names_for_one_release(told, demos, tmp_path):
    trained(told, demos, tmp_path / "teacher", "--down-dims", 8, 16, "--points", 8)
    path = tmp_path / "student.yaml"
    path.write_text("training: {draws: 2, nfe: 2, ema_decay: 0.3}\n")
    small = f"--steps 3 --warmup-steps 1 --batch-size 4 --device cpu --teacher {tmp_path / 'teacher'} --data {demos}"
    former = ("--mu=0.5", "--skip", 20, "--config", path, "--set", "training.nfe=4")
    status, _, err = told("distill", *small.split(), "--out", tmp_path / "student", *former)
    assert status == 0, err
    notices = [line for line in err.splitlines() if line.startswith("manicm-ms: warning: ")]
    assert notices == [
        "manicm-ms: warning: --mu is --ema-decay now; the former name goes with the next release",
        "manicm-ms: warning: --skip is --solver-stride now; the former name goes with the next release",
    ]
    preset = read_manifest(tmp_path / "student")["provenance"]["preset"]
    assert (preset["ema_decay"], preset["solver_stride"], preset["draws"], preset["nfe"]) == (0.5, 20, 2, 4)
    head = json.loads((tmp_path / "student" / "config.json").read_text())["config"]["head"]
    assert (head["name"], head["nfe"], head["num_solver_steps"]) == ("consistency", 4, 5)


# ---- counts


REQUIRED = {
    "evaluate": ("x", "--env", "ur3e/slide-block"),
    "convert": ("x", "--out", "y"),
    "cloud": ("x", "--camera", "y", "--out", "z.ply"),
    "train": ("dp3", "--data", "x", "--out", "y"),
    "distill": ("--teacher", "x", "--data", "y", "--out", "z"),
}
"""What the commands that take whole numbers cannot be called without."""
WHOLE_NUMBERS = [
    (command, option, least)
    for command in COMMANDS
    for option, least in least_values(command_of(command, [])).items()
]  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS)
def test_every_whole_number_says_the_least_that_it_takes(command):
    hints = get_type_hints(command_of(command, []))
    whole = {name for name, hint in hints.items() if int in (hint, *getattr(hint, "__args__", ()))}
    pairs = {"squares"}  # of a board, which says itself what it may have
    assert whole - pairs - {"return"} == set(least_values(command_of(command, [])))


@pytest.mark.parametrize(("command", "option", "least"), WHOLE_NUMBERS)
def test_less_than_the_least_is_refused(told, command, option, least):
    name = f"--{option.replace('_', '-')}"
    result = told(command, *REQUIRED.get(command, ()), name, least - 1)
    assert_one_line(result, f"{name} must be at least {least}, got {least - 1}")


@pytest.mark.parametrize("option", ["steps", "batch-size", "points", "save-every", "log-every", "n-action-steps"])
def test_counts_of_a_recipe_are_refused_too(told, demos, tmp_path, option):
    result = told("train", "dp3", "--data", demos, "--out", tmp_path / "out", f"--{option}", 0)
    assert_one_line(result, option.replace("-", "_"), "at least 1")


def test_more_points_than_the_clouds_have_are_refused(told, demos, tmp_path):
    result = told("train", "dp3", "--data", demos, "--out", tmp_path / "out", "--points", 65)
    assert_one_line(result, "--points 65 exceeds the 64 points of each cloud", "reach.zarr", "give 64 or less")
    assert not (tmp_path / "out").exists()
    small = TINY.replace("--points 8 ", "").replace(f"--steps {STEPS}", "--steps 3")
    status, _, err = told("train", "simple_dp3", "--data", demos, "--out", tmp_path / "out", *small.split())
    assert status == 0
    told_of = [line for line in err.splitlines() if line.startswith("manicm-ms: warning: ")]
    assert len(told_of) == 1
    assert told_of[0].endswith("reach.zarr have 64 points: all are read, where the preset names 128")
