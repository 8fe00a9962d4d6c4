"""Results in words and formatted rows: what the screen and the report say alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from manicm_ms.evaluation.power import MOST_PLAYED, POWER
from manicm_ms.evaluation.results import INTERVALS, without_rate
from manicm_ms.evaluation.verdicts import NOT_WORSE, UNDERPOWERED, WORSE
from manicm_ms.wording import counted

NOTHING = "-"

HEADERS = (
    "Policy", "Role", "NFE", "Success", "95 % interval", "Once", "At the end", "Crashed", "Decision", "p95",
    "Measured on",
)  # fmt: skip
"""Headers of the fields of `Row`."""


class Row(NamedTuple):
    """One policy of the results, formatted for people."""

    name: str
    role: str
    nfe: str
    success: str
    interval: str
    once: str
    at_end: str
    crashed: str
    median: str
    p95: str
    where: str


def rows(results: Mapping[str, Any]) -> list[Row]:
    """Return one formatted row per policy, in the order of the results."""
    return [_row(policy) for policy in results["policies"]]


def _row(policy: Mapping[str, Any]) -> Row:
    threads = "1 thread" if policy["threads"] == 1 else f"{policy['threads']} threads"
    return Row(
        name=policy["name"],
        role=policy["role"],
        nfe=NOTHING if policy["nfe"] is None else str(policy["nfe"]),
        success=success_text(policy),
        interval=interval_text(policy["ci95"]),
        once=count_text(policy.get("success_once")),
        at_end=count_text(policy.get("success_at_end")),
        crashed=str(policy["crashed"]),
        median=format_ms(policy["latency_ms"]["median"]),
        p95=format_ms(policy["latency_ms"]["p95"]),
        where=f"{policy['device']}, {threads}, {policy['dtype']}",
    )


def success_text(entry: Mapping[str, Any]) -> str:
    """Return successes, episodes and rate; a dash for the rate where nothing was measured."""
    rate = NOTHING if entry["success_rate"] is None else f"{100 * entry['success_rate']:.1f} %"
    return f"{entry['successes']}/{entry['n']} = {rate}"


def interval_text(ci95: Sequence[float] | None) -> str:
    """Return an interval of a rate in percent; a dash where nothing was measured."""
    return NOTHING if ci95 is None else f"{100 * ci95[0]:.1f} to {100 * ci95[1]:.1f} %"


def count_text(entry: Mapping[str, Any] | None) -> str:
    """Return successes of episodes; a dash where they are not known."""
    return NOTHING if entry is None else f"{entry['successes']}/{entry['n']}"


def format_ms(milliseconds: float) -> str:
    """Return a time with three significant digits, one decimal at least above 1 ms."""
    return f"{milliseconds:.3g} ms" if milliseconds < 10 else f"{milliseconds:.1f} ms"


def paired_sentences(results: Mapping[str, Any]) -> list[str]:
    """Return what the paired comparison says, in words; nothing where there is no pair."""
    pair = results["paired"]
    if pair is None:
        return []
    low, high = pair["difference_ci95"]
    method = results.get("intervals", INTERVALS)["difference"]
    n = pair["both"] + pair["only_first"] + pair["only_second"] + pair["neither"]
    sentences = [
        f"On the same {n} seeds both succeeded on {pair['both']}, only {pair['first']} on {pair['only_first']}, "
        f"only {pair['second']} on {pair['only_second']}, neither on {pair['neither']}.",
        f"Success rate of {pair['second']} minus that of {pair['first']}: {100 * pair['difference']:+.1f} points "
        f"({method}, 95 %: {100 * low:+.1f} to {100 * high:+.1f}; McNemar's exact test p = {pair['mcnemar_p']:.3g}).",
    ]
    first, second = results["policies"][0]["latency_ms"]["median"], results["policies"][-1]["latency_ms"]["median"]
    evaluations = [results["policies"][k]["nfe"] for k in (-1, 0)]
    why = "" if None in evaluations else ": {} against {} network evaluations a decision".format(*evaluations)
    sentences.append(f"The policy {pair['second']} decides {first / second:.1f} times as fast as {pair['first']}{why}.")
    return sentences


def decision_sentences(results: Mapping[str, Any]) -> list[str]:
    """Return how an evaluation that stops when it is decided ended, in words; nothing for any other."""
    found = results.get("until_decided")
    if found is None:
        return []
    margin = f"{100 * found['plan']['margin']:g} points"
    claim = {
        NOT_WORSE: f"{found['second']} is not worse than {found['first']} by more than {margin}",
        WORSE: f"{found['second']} is worse than {found['first']} by more than {margin}",
        UNDERPOWERED: f"underpowered: whether {found['second']} is worse than {found['first']} by more than {margin} "
        "is still open",
    }[found["verdict"]]
    lines = [
        f"Stopped after {counted(found['pairs'], 'pair')}: {claim}. "
        f"Capital of 'not worse' {found['capital_not_worse']:.3g}, of 'worse' {found['capital_worse']:.3g}; "
        f"either needed {found['capital_needed']:g}."
    ]
    if found["verdict"] == UNDERPOWERED and found["pairs"]:
        needed = found["pairs_that_would_do"]
        many = f"more than {MOST_PLAYED} pairs" if needed is None else f"about {needed} pairs"
        lines.append(
            f"If both are equally good and differ as often as here, {many} would do with a chance of {100 * POWER:g} %."
        )
    if found["left_out"] or found["repeats"]:
        lines.append(
            f"Left out of the decision: {counted(found['left_out'], 'pair')} with a crash, "
            f"{counted(found['repeats'], 'repeat')} of a start state."
        )
    lines.append(
        "The data decided the number of pairs: the decision above holds its level, the interval and the p value of the "
        "paired difference hold theirs at a planned number only."
    )
    return lines


def once_at_end_sentence(results: Mapping[str, Any]) -> str:
    """Return how often each policy succeeded at some step, and at the last one."""
    told = [f"{row.name} {row.once}, {row.at_end}" for row in rows(results)]
    return f"Success at some step, at the last step: {'; '.join(told)}."


def crash_lines(results: Mapping[str, Any]) -> list[str]:
    """Return a line for each policy without a rate, then one per crashed episode, of all realism presets."""
    silent = [f"{name}: every episode crashed, so there is no success rate." for name in without_rate(results)]
    entries = [(policy["name"], policy["episodes"]) for policy in results["policies"]]
    for row in results.get("realism", {"rows": []})["rows"]:
        if row["preset"] != results["realism"]["presets"][0]:  # those of the first stand among the policies
            entries.append((f"{row['policy']} under {row['preset']}", row["episodes"]))
    return silent + [
        f"{name}, seed {episode['seed']}: {episode['crashed']}"
        for name, episodes in entries
        for episode in episodes
        if episode["crashed"] is not None
    ]


class RealismRow(NamedTuple):
    """One policy under one realism preset, formatted for people."""

    preset: str
    policy: str
    success: str
    interval: str
    once_at_end: str
    difference: str
    p: str


def realism_headers(results: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the headers of `realism_rows`."""
    against = f"Against {results['realism']['reference']}"
    return ("Realism", "Policy", "Success", "95 % interval", "Once, at the end", against, "p")


def realism_rows(results: Mapping[str, Any]) -> list[RealismRow]:
    """Return one formatted row per preset and policy where several presets were played, else nothing."""
    realism = results.get("realism")
    return [_realism_row(row) for row in realism["rows"]] if realism and len(realism["presets"]) > 1 else []


def _realism_row(row: Mapping[str, Any]) -> RealismRow:
    pair = row["against_reference"]
    difference, p = "", ""
    if pair is not None:
        least, most = (100 * bound for bound in pair["difference_ci95"])
        difference = f"{100 * pair['difference']:+.1f} points ({least:+.1f} to {most:+.1f})"
        p = f"{pair['mcnemar_p']:.3g}"
    both = f"{count_text(row.get('success_once'))}, {count_text(row.get('success_at_end'))}"
    interval = interval_text(row["ci95"])
    return RealismRow(row["preset"], row["policy"], success_text(row), interval, both, difference, p)


def realism_sentence(results: Mapping[str, Any]) -> str:
    """Return under which preset the main results were obtained; nothing in the ideal world."""
    realism = results.get("realism")
    return f"Realism preset of these episodes: {realism['presets'][0]}." if realism else ""


def episodes_title(results: Mapping[str, Any]) -> str:
    """Return what was played: held-out seeds, or seeds of which some were seen in training."""
    count = len(results["seeds"])
    kind = "seeds, some of them seen in training" if results.get("seen_seeds") else "held-out seeds"
    return f"{count} {kind}"
