"""What results.json holds: every count in it is derived from the records of the episodes, here and nowhere else."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch

from manicm_ms.evaluation.intervals import (
    CONFIDENCE,
    DIFFERENCE_METHOD,
    RATE_METHOD,
    PairedCounts,
    paired_difference_interval,
)
from manicm_ms.evaluation.latency import Latency
from manicm_ms.evaluation.machine import machine
from manicm_ms.evaluation.origins import remarks, seen_counts
from manicm_ms.evaluation.play import Played
from manicm_ms.evaluation.protocol import CLEAN, Conditions, EvaluatedPolicy, Protocol
from manicm_ms.evaluation.rollout import EpisodeResult
from manicm_ms.evaluation.statistics import compare_paired, mcnemar_exact, success_rate
from manicm_ms.provenance import package_versions
from manicm_ms.sensing.realism import RealismSample

SCHEMA_VERSION = 2
"""2: Clopper-Pearson and Tango's intervals, success once and at the end, remarks. 1 had Wilson's and Newcombe's."""
INTERVALS = {"confidence": CONFIDENCE, "rate": RATE_METHOD, "difference": DIFFERENCE_METHOD}


def compile_results(
    policies: Sequence[EvaluatedPolicy],
    protocol: Protocol,
    played: Played,
    latencies: Mapping[str, Latency],
    command: str,
    conditions: Conditions = lambda preset, seed: {},
) -> dict[str, Any]:
    """Return the content of results.json, no videos yet.

    Args:
        policies: the first and the last are compared.
        protocol: seeds and sizes.
        played: results under every preset; the first preset's are the main ones.
        latencies: policy -> time of a decision.
        command: the command line that reproduces it.
        conditions: what was drawn for an episode.
    """
    drawn, episodes = partial(conditions, protocol.realism[0]), played.by_preset[protocol.realism[0]]
    results = {
        "schema_version": SCHEMA_VERSION,
        "env_id": protocol.env_id,
        "seeds": list(protocol.seeds),
        "seen_seeds": seen_counts(policies, protocol.env_id, protocol.seeds),
        "remarks": remarks(policies, protocol.env_id, protocol.seeds),
        "intervals": INTERVALS,
        "command": command,
        "versions": package_versions(),
        "machine": machine(),
        "num_envs": protocol.num_envs,
        "policies": [_policy_entry(p, episodes[p.name], latencies[p.name], drawn) for p in policies],
        "paired": _paired_entry(policies[0], policies[-1], episodes) if len(policies) > 1 else None,
    }
    if protocol.realism != (CLEAN,):
        results["realism"] = _realism_entry(policies, protocol, played.by_preset, conditions)
    return {**results, "success_rule": played.spec.success_rule, "videos": []}


def _realism_entry(
    policies: Sequence[EvaluatedPolicy],
    protocol: Protocol,
    by_preset: Mapping[str, Mapping[str, Sequence[EpisodeResult]]],
    conditions: Conditions,
) -> dict[str, Any]:
    """Return how every policy fared under every preset, each against the same policy in the ideal world."""
    presets = protocol.realism
    reference = CLEAN if CLEAN in presets else presets[0]
    rows = []
    for preset in presets:
        for evaluated in policies:
            ideal, episodes = (by_preset[name][evaluated.name] for name in (reference, preset))
            rows.append({
                "preset": preset,
                "policy": evaluated.name,
                "role": evaluated.role,
                **rate_entry(episodes),
                "against_reference": None if preset == reference else pair_entry(ideal, episodes),
                "episodes": _episode_entries(episodes, partial(conditions, preset)),
            })  # fmt: skip
    return {"presets": list(presets), "reference": reference, "rows": rows}


def rate_entry(episodes: Sequence[EpisodeResult]) -> dict[str, Any]:
    """Return how often the episodes succeeded; where every one crashed nothing was measured and there is no rate."""
    crashed = sum(e.crashed is not None for e in episodes)
    return {
        **_counted([e.success for e in episodes], crashed == len(episodes)),
        "success_once": _measured([e.success_once for e in episodes], crashed),
        "success_at_end": _measured([e.success_at_end for e in episodes], crashed),
        "crashed": crashed,
    }


def _counted(outcomes: Sequence[bool], nothing_measured: bool = False) -> dict[str, Any]:
    rate = success_rate(outcomes)
    return {
        "n": rate.n,
        "successes": rate.successes,
        "success_rate": None if nothing_measured else rate.rate,
        "ci95": None if nothing_measured else list(rate.ci95),
    }


def _measured(outcomes: Sequence[bool | None], crashed: int) -> dict[str, Any] | None:
    """Return the rate of outcomes, or None where it is not known of all of them or nothing was measured."""
    known = [outcome for outcome in outcomes if outcome is not None]
    return _counted(known) if len(known) == len(outcomes) and crashed < len(outcomes) else None


def pair_entry(first: Sequence[EpisodeResult], second: Sequence[EpisodeResult]) -> dict[str, Any] | None:
    """Return the comparison of two lists of episodes on the same seeds; `difference` is second minus first.

    None where every episode of one of them crashed.
    """
    if any(all(e.crashed is not None for e in episodes) for episodes in (first, second)):
        return None
    pair = compare_paired([e.success for e in first], [e.success for e in second])
    return {
        **pair.counts._asdict(),
        "difference": pair.difference,
        "difference_ci95": list(pair.difference_ci95),
        "mcnemar_p": pair.mcnemar_p,
    }


def renewed(results: Mapping[str, Any]) -> dict[str, Any]:
    """Return results of any version with the present intervals, computed anew from their counts."""
    found = {**results, "intervals": INTERVALS}
    if "policies" in results:
        found["policies"] = [_renewed_rate(policy) for policy in results["policies"]]
    if results.get("paired") is not None:
        found["paired"] = _renewed_pair(results["paired"])
    if "realism" in results:
        found["realism"] = {**results["realism"], "rows": [_renewed_row(row) for row in results["realism"]["rows"]]}
    return found


def _renewed_row(row: Mapping[str, Any]) -> dict[str, Any]:
    pair = row["against_reference"]
    return {**_renewed_rate(row), "against_reference": None if pair is None else _renewed_pair(pair)}


def _renewed_rate(entry: Mapping[str, Any]) -> dict[str, Any]:
    won, n = entry["successes"], entry["n"]
    unknown = {"success_once": None, "success_at_end": None}
    return {**unknown, **entry, **_counted([True] * won + [False] * (n - won), entry["crashed"] == n)}


def _renewed_pair(pair: Mapping[str, Any]) -> dict[str, Any]:
    counts = PairedCounts(*(pair[name] for name in PairedCounts._fields))
    interval = list(paired_difference_interval(counts))
    return {**pair, "difference": counts.difference, "difference_ci95": interval, "mcnemar_p": mcnemar_exact(counts)}


def without_rate(results: Mapping[str, Any]) -> list[str]:
    """Return the policies, with their preset where it is not the first, of which every episode crashed."""
    found = [p["name"] for p in results["policies"] if p["success_rate"] is None]
    for row in results.get("realism", {"rows": []})["rows"]:
        if row["success_rate"] is None and row["preset"] != results["realism"]["presets"][0]:
            found.append(f"{row['policy']} under {row['preset']}")
    return found


def _policy_entry(
    evaluated: EvaluatedPolicy,
    episodes: Sequence[EpisodeResult],
    latency: Latency,
    drawn: Callable[[int], RealismSample],
) -> dict[str, Any]:
    return {
        "name": evaluated.name,
        "role": evaluated.role,
        "checkpoint": evaluated.checkpoint,
        "trained_for": list(evaluated.origin.tasks),
        "nfe": evaluated.policy.nfe,
        **rate_entry(episodes),
        "latency_ms": {"median": latency.median_ms, "p95": latency.p95_ms, "n": latency.n},
        "device": latency.device,
        "threads": latency.threads,
        "dtype": latency.dtype,
        "parameters": _parameters(evaluated.policy),
        "episodes": _episode_entries(episodes, drawn),
    }


def _parameters(policy: object) -> int | None:
    """Return the number of parameters; None where the policy is no torch module."""
    return sum(p.numel() for p in policy.parameters()) if isinstance(policy, torch.nn.Module) else None


def _episode_entries(episodes: Sequence[EpisodeResult], drawn: Callable[[int], RealismSample]) -> list[dict[str, Any]]:
    """Return the records of episodes, each with what was drawn for it where something was."""
    return [e.summary() | ({"realism": values} if (values := drawn(e.seed)) else {}) for e in episodes]


def _paired_entry(
    first: EvaluatedPolicy, second: EvaluatedPolicy, episodes: Mapping[str, Sequence[EpisodeResult]]
) -> dict[str, Any] | None:
    pair = pair_entry(episodes[first.name], episodes[second.name])
    if pair is None:
        return None
    named = {"first": first.name, "second": second.name}
    return {**named, "difference_is": "success rate of the second minus that of the first", **pair}
