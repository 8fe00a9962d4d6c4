"""Times one decision of DP3, Simple DP3 and their one-step and four-step students.

Random weights at the shapes of Adroit door (512 points, 24 proprioceptive values, 28 actions, To = 2, Tp = 4):
the operations of a decision do not depend on the weights. About two minutes a thread count on one CPU core.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from manicm_ms.errors import require_at_least
from manicm_ms.evaluation.latency import Latency, measure_latency
from manicm_ms.evaluation.machine import machine
from manicm_ms.machine.devices import resolve_device
from manicm_ms.paths import write_text
from manicm_ms.policies.methods import make_policy, student_of
from manicm_ms.policies.policy import Policy
from manicm_ms.spec import ActionSpec, ChunkSpec, EnvSpec, ObsSpec

PAGE = "latency.md"
CHUNK = ChunkSpec(n_obs_steps=2, horizon=4, n_action_steps=3)
TEACHERS = {"DP3": "dp3", "Simple DP3": "simple_dp3"}
STUDENT_NFE = (4, 1)

# ManiCM (arXiv:2406.01586), table of results: mean decision times on an RTX 4090.
PAPER = "The paper's figures on an RTX 4090: DP3 177.6 ms at 10 NFE, ManiCM 17.3 ms at 1 NFE, a ratio of 10.3."


def door_spec() -> EnvSpec:
    """Return a spec with the array shapes of Adroit door."""
    return EnvSpec(
        env_id="adroit/door",
        obs=ObsSpec(num_points=512, point_channels=3, agent_pos_dim=24, frame="world"),
        action=ActionSpec(names=tuple(f"a{i}" for i in range(28)), control_mode="position", control_hz=25.0),
        max_episode_steps=300,
        agent_pos_names=tuple(f"q{i}" for i in range(24)),
    )


def contestants(device: str) -> dict[str, Policy]:
    """Return each teacher followed by its students, name -> policy."""
    policies: dict[str, Policy] = {}
    for name, registered in TEACHERS.items():
        teacher = make_policy(registered, door_spec(), CHUNK, seed=0).to(device)
        policies[f"{name} teacher"] = teacher
        student = student_of(teacher)
        policies |= {f"{name} student, {nfe}-step": student.with_nfe(nfe) for nfe in STUDENT_NFE}
    return policies


def table(policies: Mapping[str, Policy], measured: Mapping[str, Latency]) -> str:
    """Return the Markdown table of one run; each ratio is to the teacher measured in the same run."""
    lines = [
        "| policy | parameters | NFE | median | p95 | teacher's median / its own |",
        "|---|---|---|---|---|---|",
    ]
    teacher_ms = 0.0
    for name, latency in measured.items():
        if name.endswith("teacher"):
            teacher_ms = latency.median_ms
        size = sum(p.numel() for p in policies[name].parameters()) / 1e6
        times = f"{latency.median_ms:.2f} ms | {latency.p95_ms:.2f} ms"
        lines.append(f"| {name} | {size:.2f} M | {latency.nfe} | {times} | {teacher_ms / latency.median_ms:.1f} |")
    return "\n".join(lines)


def section(device: str, threads: int, repetitions: int) -> str:
    """Measure on one device and return its heading and table."""
    policies = contestants(device)
    measured = measure_latency(policies, repetitions=repetitions, threads=threads)
    one = next(iter(measured.values()))
    count = "1 thread" if threads == 1 else f"{threads} threads"
    return f"## {one.device}, {count}, {one.dtype}\n\n{table(policies, measured)}\n"


def circumstances() -> str:
    """Return how busy the machine is now and whether this process yields to others."""
    load = f"load average at the start {os.getloadavg()[0]:.1f}"
    if os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR):
        load += ", real-time priority (`chrt -f 10`) against the other work on it"
    return load


def document(sections: list[str], repetitions: int, load: str, command: str) -> str:
    """Return the whole result page, which names `command` as its origin."""
    described = ", ".join(f"{key} {value}" for key, value in machine().items())
    intro = (
        "# Time of one decision\n\n"
        "Observation in the CPU's memory to action in the CPU's memory: transfers, encoder, noise and all network\n"
        f"evaluations. Batch 1, {repetitions} decisions after warm-up, policies in turn within one process, device\n"
        "synchronised. Random weights at the shapes of Adroit door (512 x 3 points, 24, 28; To = 2, Tp = 4).\n\n"
        f"{PAPER}\n"
    )
    versions = f"Python {platform.python_version()}, torch {torch.__version__}"
    outro = f"## Reproduce\n\n```\n{command}\n```\n\n{described}; {versions}; {load}.\n"
    return "\n".join([intro, *sections, outro])


def bench(device: str, threads: Sequence[int], repetitions: int, page: Path | None, command: str) -> None:
    """Measure, print a table for each number of `threads`, and write the whole page to `page` unless that is None.

    `command` is what the page names as its origin.
    """
    resolve_device(device)
    for count in threads:
        require_at_least(1, threads=count)
    sections, load = [], circumstances()
    for count in threads:
        sections.append(section(device, count, repetitions))
        print(sections[-1], flush=True)
    if page is not None:
        write_text(page, document(sections, repetitions, load, command))
        print(f"written to {page}")
