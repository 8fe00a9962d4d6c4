"""One evaluation enters each file of evaluation/ from one place only, helpers excepted: traced, not read."""

import functools
import importlib
import inspect
import io
import pkgutil
from collections import defaultdict
from pathlib import Path

from point_mass import SPEC, PointMass, Proportional
from rich.console import Console

from manicm_ms.evaluation import evaluate as entry
from manicm_ms.evaluation.play import EnvMaker
from manicm_ms.evaluation.protocol import STUDENT, TEACHER, EvaluatedPolicy, Protocol
from manicm_ms.evaluation.screen import show

ROOM = Path(entry.__file__).parent
HELPERS = {
    "protocol", "origins", "intervals", "statistics", "machine", "text", "plots",  # the ground: names, formulas, words
    "records", "rollout",  # entered from one file too, see below
    "results",  # compiled once; what is shown asks it which policies have a rate
}  # fmt: skip


def watch(monkeypatch):
    """Record which file of the room calls into which other one, by the functions that they import of each other."""
    entered = defaultdict(set)

    def recorded(function, caller):
        @functools.wraps(function)
        def call(*args, **options):
            entered[function.__module__.rpartition(".")[2]].add(caller)
            return function(*args, **options)

        return call

    for info in pkgutil.iter_modules([str(ROOM)]):
        module = importlib.import_module(f"manicm_ms.evaluation.{info.name}")
        for name, value in list(vars(module).items()):
            foreign = getattr(value, "__module__", "").startswith("manicm_ms.evaluation.")
            if inspect.isfunction(value) and foreign and value.__module__ != module.__name__:
                monkeypatch.setattr(module, name, recorded(value, info.name))
    return entered


def test_each_stage_is_entered_from_one_file(tmp_path, monkeypatch):
    entered = watch(monkeypatch)
    policies = [
        EvaluatedPolicy("teacher", TEACHER, "runs/teacher", Proportional(gain=2.0)),
        EvaluatedPolicy("student", STUDENT, "runs/student", Proportional(gain=2.5)),
    ]
    protocol = Protocol(SPEC.env_id, (1, 2), num_envs=2, repetitions=1, videos=1)
    envs = EnvMaker(lambda policy, n, _: PointMass(n, policy.chunk), lambda n, _: PointMass(n, chunk=None))
    console = Console(file=io.StringIO())
    results = entry.evaluate_policies(policies, protocol, envs, tmp_path / "report", {}, "the command", console)
    show(results, tmp_path / "report", console)
    stages = {name: callers for name, callers in entered.items() if name not in HELPERS}
    assert stages == {key: {"evaluate"} for key in ("latency", "play", "video", "eval_info", "report")}
    assert entered["records"] == {"evaluate"}
    assert entered["rollout"] == {"play"}
