"""An evaluation that stops when it is decided: what is planned, sealed before the first episode, and what it says."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manicm_ms.errors import ConfigError, OutputExistsError
from manicm_ms.evaluation.anytime import ALPHA, EACH_ALPHA, decide, difference_evidence, require_margin
from manicm_ms.evaluation.pairs import differences, pair_up, without_repeats
from manicm_ms.evaluation.power import LOOK, pairs_until_not_worse
from manicm_ms.evaluation.protocol import EvaluatedPolicy, Protocol
from manicm_ms.evaluation.rollout import EpisodeResult
from manicm_ms.evaluation.verdicts import NOT_WORSE, UNDERPOWERED, WORSE
from manicm_ms.paths import write_json

PLAN_FILE = "plan.json"
_RULE = (
    "after each block of pairs, stop where the capital of 'second not worse than first by more than the margin' or "
    "that of 'worse by more than the margin' has reached 1 / alpha_each; else at the last seed, as underpowered"
)


@dataclass(frozen=True)
class StoppingRule:
    """When an evaluation of a first and a last policy stops.

    Attributes:
        margin: difference of success rates that does not matter, in (0, 1).
        block: pairs played between two looks.
    """

    margin: float
    block: int = LOOK

    def __post_init__(self) -> None:
        require_margin(self.margin)

    def identity(self) -> dict[str, Any]:
        """Return what identifies the rule in the request of a folder."""
        return {"until_decided": True, "margin": self.margin, "alpha_each": EACH_ALPHA, "block": self.block}

    def plan(
        self, protocol: Protocol, policies: Sequence[EvaluatedPolicy], request: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return everything that is fixed before the first episode, with its SHA-256."""
        fixed = {
            **request,
            "first": policies[0].name,
            "second": policies[-1].name,
            "seeds": [protocol.seeds[0], protocol.seeds[-1]],
            "margin": self.margin,
            "alpha": ALPHA,
            "alpha_each": EACH_ALPHA,
            "block": self.block,
            "rule": _RULE,
        }
        return {**fixed, "sha256": _digest(fixed)}

    def require_possible(self, policies: Sequence[EvaluatedPolicy], protocol: Protocol) -> None:
        """Raise ConfigError unless there are two policies to compare under one realism preset."""
        if len(policies) < 2:
            raise ConfigError("--until-decided compares the first policy with the last: name at least two")
        if len(protocol.realism) > 1:
            raise ConfigError(
                f"--until-decided stops by the pairs of one realism preset, and --realism names "
                f"{len(protocol.realism)} ({', '.join(protocol.realism)}): give each an evaluation of its own"
            )

    def decided(self, first: Sequence[EpisodeResult], second: Sequence[EpisodeResult]) -> bool:
        """Return whether the episodes so far are enough."""
        found = decide(differences(without_repeats(pair_up(first, second).pairs)), self.margin)
        return found.shows_not_worse or found.shows_worse

    def outcome(
        self, plan: Mapping[str, Any], first: Sequence[EpisodeResult], second: Sequence[EpisodeResult]
    ) -> dict[str, Any]:
        """Return what results.json holds of the decision.

        Args:
            plan: as `plan` returned it.
            first: episodes of the first policy, all that were played.
            second: those of the last one, of the same seeds.
        """
        paired = pair_up(first, second)
        pairs = without_repeats(paired.pairs)
        found = decide(differences(pairs), self.margin)
        only_second = sum(p.second and not p.first for p in pairs)
        only_first = sum(p.first and not p.second for p in pairs)
        word = NOT_WORSE if found.shows_not_worse else WORSE if found.shows_worse else UNDERPOWERED
        discordant = (only_first + only_second) / len(pairs) if pairs else None
        needed = None
        if word == UNDERPOWERED and discordant is not None:
            needed = pairs_until_not_worse(discordant, self.margin)
        return {
            "plan": {**plan},
            "first": plan["first"],
            "second": plan["second"],
            "verdict": word,
            "pairs": len(pairs),
            "left_out": paired.left_out,
            "repeats": len(paired.pairs) - len(pairs),
            "only_first": only_first,
            "only_second": only_second,
            "capital_not_worse": found.not_worse,
            "capital_worse": found.worse,
            "capital_needed": 1 / EACH_ALPHA,
            "evidence_of_a_difference": difference_evidence(only_second, only_first),
            "pairs_that_would_do": needed,
        }


def seal(plan: Mapping[str, Any], out: Path) -> None:
    """Write the plan into `out`, before the first episode; where it is there already it must be the same, whole.

    Raises OutputExistsError where it is another one or was changed.
    """
    file = out / PLAN_FILE
    if not file.exists():
        write_json(file, dict(plan))
        return
    try:
        before = json.loads(file.read_text(encoding="utf-8"))
        digest = _digest({key: value for key, value in before.items() if key != "sha256"})
    except (ValueError, AttributeError):
        before, digest = {}, ""
    if digest != before.get("sha256") or digest != plan["sha256"]:
        raise OutputExistsError(
            f"{file} is not the plan that this evaluation began with: it may not change once episodes were played; "
            "restore it or choose another --out"
        )


def _digest(fixed: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(fixed, sort_keys=True, allow_nan=False).encode()).hexdigest()
