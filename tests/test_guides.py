"""Every command that the README and the docs show is one that `manicm-ms` takes; the guide's Python runs."""

import functools
import json
import re
import shlex
from pathlib import Path

import pytest
import tyro

from manicm_ms.cli import GROUPS, PLAIN, WITH_PRESET, bench, command_of
from manicm_ms.cli.messages import PROGRAM
from manicm_ms.evaluation.user_policy import load_user_policy
from manicm_ms.spec import EnvSpec

REPO = Path(__file__).parents[1]
PAGES = [REPO / "README.md", *sorted((REPO / "docs").rglob("*.md"))]
PLACEHOLDERS = {"TASK": "reach", "N": "2", "ENV_ID": "ur3e/slide-block"}


def code(page, languages):
    """Return the text of the page's fenced blocks in one of these languages, "" for a fence that names none."""
    blocks = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    return [text for language, text in blocks if language in languages]


def commands(page):
    """Return the words of each command line of `PROGRAM` that the page shows, comments and "..." taken off."""
    indented = re.findall(r"^ {4}(\S.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    lines = "\n".join([*code(page, ("", "console", "bash", "sh")), *indented]).replace("\\\n", " ").splitlines()
    stripped = (line.strip().removeprefix("$ ").replace(" ... ", " ") for line in lines)
    return [shlex.split(line, comments=True)[1:] for line in stripped if line.startswith(f"{PROGRAM} ")]


DOCUMENTED = [
    pytest.param(words, id=f"{page.relative_to(REPO)}:{number}")
    for page in PAGES
    for number, words in enumerate(commands(page))
]


def parse(words):
    """Parse a command line as the program does, and run nothing; a bad one ends in SystemExit."""
    name, rest = words[0], [PLACEHOLDERS.get(word, word) for word in words[1:]]
    if name in GROUPS:
        command, rest = bench.COMMANDS[rest[0]], rest[1:]
    else:
        command = command_of(name, rest)

    @functools.wraps(command)
    def accept(*args, **kwargs):
        return "accepted"

    return tyro.cli(accept, args=rest, config=(tyro.conf.OmitArgPrefixes,))


@pytest.mark.parametrize("words", DOCUMENTED)
def test_a_documented_command_is_accepted(words):
    assert parse(words) == "accepted"


def test_a_wrong_command_is_not_accepted():
    with pytest.raises(SystemExit):
        parse(["collect", "ur3e/slide-block", "--no-such-option", "1"])


def test_the_docs_show_all_commands():
    assert {words.values[0][0] for words in DOCUMENTED} >= {*PLAIN, *WITH_PRESET, *GROUPS} - {"experts"}


def test_the_python_of_train_and_evaluate_runs(monkeypatch, capsys):
    (block,) = code(REPO / "docs/guides/train_and_evaluate.md", ("python",))
    monkeypatch.chdir(REPO)
    exec(block, {})
    assert capsys.readouterr().out.strip() == "(1, 3, 7)"


def test_the_policy_of_the_guide_is_one_that_evaluate_takes(tmp_path):
    (block,) = code(REPO / "docs/guides/evaluate_your_own_policy.md", ("python",))
    (tmp_path / "push_forward.py").write_text(block)
    spec = EnvSpec.from_dict(json.loads((REPO / "checkpoints/slide_block/student/config.json").read_text())["env_spec"])
    policy = load_user_policy(f"{tmp_path}/push_forward.py:make_policy", spec)
    assert (policy.name, policy.chunk.n_action_steps) == ("push_forward", 3)
