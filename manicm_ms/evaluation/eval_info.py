"""What other tools read of an evaluation: `eval_info.json` in LeRobot's layout, and a JSON line for each episode."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from manicm_ms.evaluation.protocol import CLEAN, slug
from manicm_ms.paths import write_json, write_text

EVAL_INFO_FILE, EPISODES_FILE = "eval_info.json", "episodes.jsonl"
EVAL_INFO_FOLDER = "eval_info"
"""One file a policy, in the layout of `EVAL_INFO_FILE`."""


def write_exports(results: Mapping[str, Any], out: Path) -> None:
    """Write `eval_info.json` of the last policy, `eval_info/NAME.json` of each, and `episodes.jsonl` of all.

    Args:
        results: what results.json holds.
        out: folder of the evaluation.
    """
    infos = {policy["name"]: eval_info(results, policy) for policy in results["policies"]}
    for name, info in infos.items():
        write_json(out / EVAL_INFO_FOLDER / f"{slug(name)}.json", info)
    write_json(out / EVAL_INFO_FILE, infos[results["policies"][-1]["name"]])
    lines = [json.dumps(line, allow_nan=False) for line in episode_lines(results)]
    write_text(out / EPISODES_FILE, "".join(f"{line}\n" for line in lines))


def eval_info(results: Mapping[str, Any], policy: Mapping[str, Any]) -> dict[str, Any]:
    """Return the main episodes of one policy in LeRobot's layout.

    `per_task`, `per_group` and `overall` are what lerobot-eval writes today, `per_episode` and `aggregated` what it
    wrote for one task before; the environment is the one task and the one group. `success` is success at some step, as
    LeRobot counts. Left out is what is not measured here: `max_rewards` and their mean (of rewards the sum is kept),
    and `eval_s` and `eval_ep_s` (an evaluation may be stopped and go on). `policy` and `crashed` are ours.

    Source: lerobot/scripts/lerobot_eval.py of github.com/huggingface/lerobot, `eval_policy` and `eval_policy_all`.
    """
    episodes = policy["episodes"]
    videos = [video["file"] for video in results["videos"] if video["policy"] == policy["name"]]
    successes = [_succeeded(episode) for episode in episodes]
    rewards = [episode["return"] for episode in episodes]
    nothing = policy["success_rate"] is None  # every episode crashed
    aggregated = {
        "avg_sum_reward": None if nothing else sum(rewards) / len(rewards),
        "pc_success": None if nothing else 100 * sum(successes) / len(successes),
    }
    summary = {**aggregated, "n_episodes": len(episodes), "video_paths": videos}
    metrics = {"sum_rewards": rewards, "successes": successes, "video_paths": videos}
    return {
        "policy": policy["name"],
        "per_task": [{"task_group": results["env_id"], "task_id": 0, "metrics": metrics}],
        "per_group": {results["env_id"]: summary},
        "overall": summary,
        "per_episode": [
            {
                "episode_ix": index,
                "sum_reward": episode["return"],
                "success": won,
                "seed": episode["seed"],
                "crashed": episode["crashed"],
            }
            for index, (episode, won) in enumerate(zip(episodes, successes, strict=True))
        ],
        "aggregated": aggregated,
    }


def _succeeded(episode: Mapping[str, Any]) -> bool:
    once = episode.get("success_once")
    return bool(episode["success"] if once is None else once)


def episode_lines(results: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the record of every episode with its environment, realism preset and policy, in the order of the tables."""
    realism = results.get("realism")
    rows: Sequence[Mapping[str, Any]] = (
        realism["rows"]
        if realism
        else [{"preset": CLEAN, "policy": policy["name"], **policy} for policy in results["policies"]]
    )
    for row in rows:
        for episode in row["episodes"]:
            yield {"env_id": results["env_id"], "realism_preset": row["preset"], "policy": row["policy"], **episode}
