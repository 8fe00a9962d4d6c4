"""Trains PPO (Stable-Baselines3, extra `rl`) on a task's dense reward from privileged state, and draws its curve.

python scripts/examples/train_ppo.py train --seed 0      # writes runs/ppo/0: settings, curve, weights
python scripts/examples/train_ppo.py evaluate runs/ppo/0 # plays new seeds, beside random actions, idling and the expert
python scripts/examples/train_ppo.py report runs/ppo/0   # a table, and docs/images/ppo_slide_block.png

After every few updates the policy plays episodes of its own; curve and weights are written then, so that a stopped run
(Ctrl-C, --minutes) keeps all it had done. It is not continued: `train` begins anew, in a folder that must not exist.
Weights are safetensors and read as such; Stable-Baselines3's own archive would be unpickled on reading.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
import tyro
from rich.console import Console
from rich.progress import Progress
from safetensors.torch import load_file, save_file
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
from torch import Tensor

from manicm_ms.demos.experts import EXPERTS
from manicm_ms.envs.sb3 import AbsorbingSuccess, StableBaselinesEnv, normalized_return
from manicm_ms.envs.vec_env import make_vec
from manicm_ms.envs.vector import VecEnv
from manicm_ms.errors import ConfigError, ManicmError
from manicm_ms.evaluation.intervals import rate_interval
from manicm_ms.machine.devices import torch_threads
from manicm_ms.paths import write_json
from manicm_ms.provenance import package_versions
from manicm_ms.spec import STATE, ChunkSpec
from manicm_ms.training.interrupt import StopRequest, stop_requests

PICTURE = Path(__file__).resolve().parents[2] / "docs" / "images" / "ppo_slide_block.png"
SETTINGS, CURVE, WEIGHTS, SCORES = "settings.json", "curve.json", "policy.safetensors", "scores.json"
REFERENCES = {"expert": "--", "random actions": ":", "idle": "-."}
"""Whom PPO is compared with, and the line that each is drawn with."""
TRAINING_SEEDS = 1_000_000  # training of seed s plays episodes from (s + 1) times this; what is evaluated starts at 0
FINAL_SEEDS = (
    10_000  # first seed of the episodes on which the trained policy is evaluated; those of the curve start at 0
)

HELD = 4  # control steps that an action is held: five decisions a second explore further than twenty
GAMMA = 0.9  # per decision: ten of them, two seconds; the dense reward leads the way
PPO_SETTINGS: dict[str, Any] = {
    "n_steps": 256,  # decisions of each row between updates
    "batch_size": 64,
    "n_epochs": 10,
    "learning_rate": 5e-4,
    "gamma": GAMMA,
    "target_kl": 0.05,
}
NETWORK: dict[str, Any] = {"net_arch": [128, 128], "log_std_init": -0.7}
CLIP_OBS, STD_FLOOR = 10.0, 1e-8  # of normalised observations; VecNormalize's own epsilon


@dataclass(frozen=True)
class Train:
    """Train one policy.

    Attributes:
        env: id of the environment.
        seed: fixes weights, noise and training episodes.
        steps: control steps of all rows.
        rows: worker processes.
        eval_every: control steps between two points of the curve.
        eval_episodes: of each point; the same seeds at every point.
        minutes: stop after so long; None for never.
        out: folder of the run; None for runs/ppo/<seed>.
    """

    env: str = "ur3e/slide-block"
    seed: int = 0
    steps: int = 250_000
    rows: int = 2
    eval_every: int = 16_000
    eval_episodes: int = 20
    minutes: float | None = None
    out: Path | None = None


@dataclass(frozen=True)
class Evaluate:
    """Play fresh seeds with a trained policy, random actions, no actions and the expert.

    Attributes:
        run: folder of the run.
        episodes: of each player, the same seeds.
    """

    run: tyro.conf.Positional[Path]
    episodes: int = 50


@dataclass(frozen=True)
class Report:
    """Print a table of evaluated runs and draw their curves.

    Attributes:
        runs: their folders.
        picture: where the picture goes.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    picture: Path = PICTURE


# ---- playing --------------------------------------------------------------------------------------------------


class Player(Protocol):
    """Plays rows from their privileged state."""

    def begin(self, state: Tensor, seeds: Sequence[int]) -> None:
        """Start episodes in all rows: first states (N, S), seeds (N)."""

    def act(self, state: Tensor) -> Tensor:
        """Return actions (N, Da) for states (N, S)."""


class RandomPlayer:
    """Draws every entry uniformly from [-1, 1]."""

    def __init__(self, action_dim: int, seed: int) -> None:
        self._dim, self._generator = action_dim, torch.Generator().manual_seed(seed)

    def begin(self, state: Tensor, seeds: Sequence[int]) -> None:
        """Nothing to prepare."""

    def act(self, state: Tensor) -> Tensor:
        """See `Player.act`."""
        return torch.rand(len(state), self._dim, generator=self._generator) * 2 - 1


class IdlePlayer:
    """Leaves the arm where it is."""

    def __init__(self, action_dim: int) -> None:
        self._dim = action_dim

    def begin(self, state: Tensor, seeds: Sequence[int]) -> None:
        """Nothing to prepare."""

    def act(self, state: Tensor) -> Tensor:
        """See `Player.act`."""
        return torch.zeros(len(state), self._dim)


class ExpertPlayer:
    """Plays the task's scripted expert."""

    def __init__(self, env: VecEnv) -> None:
        spec = env.env_spec
        self._expert = EXPERTS.get(spec.env_id)(spec, env.num_envs, torch.device("cpu"), None)

    def begin(self, state: Tensor, seeds: Sequence[int]) -> None:
        """See `Player.begin`."""
        self._expert.reset(state, seeds, torch.ones(len(state), dtype=torch.bool))

    def act(self, state: Tensor) -> Tensor:
        """See `Player.act`."""
        return self._expert.act(state)


class PpoPlayer:
    """Plays the mean action of a PPO policy.

    Args:
        policy: takes normalised states.
        mean: (S,) of the states.
        variance: (S,) of the states.
    """

    def __init__(self, policy: ActorCriticPolicy, mean: Tensor, variance: Tensor) -> None:
        self._policy, self._mean, self._std = policy, mean, (variance + STD_FLOOR).sqrt()

    def begin(self, state: Tensor, seeds: Sequence[int]) -> None:
        """Nothing to prepare."""

    def act(self, state: Tensor) -> Tensor:
        """See `Player.act`."""
        normal = ((state - self._mean) / self._std).clamp(-CLIP_OBS, CLIP_OBS).float()
        action, _ = self._policy.predict(normal.numpy(), deterministic=True)
        return torch.from_numpy(action)


class Held:
    """Lets a player decide at every `HELD`-th control step, as PPO does in training, and hold the action between."""

    def __init__(self, player: Player) -> None:
        self._player, self._played, self._action = player, 0, torch.empty(0)

    def begin(self, state: Tensor, seeds: Sequence[int]) -> None:
        """See `Player.begin`."""
        self._played = 0
        self._player.begin(state, seeds)

    def act(self, state: Tensor) -> Tensor:
        """See `Player.act`."""
        if self._played % HELD == 0:
            self._action = self._player.act(state)
        self._played += 1
        return self._action


def save_policy(path: Path, model: PPO, normal: VecNormalize) -> None:
    """Write a policy's weights and the statistics of its observations."""
    fresh = path.with_suffix(".part")
    statistics = {f"obs.{name}": torch.from_numpy(getattr(normal.obs_rms, name).copy()) for name in ("mean", "var")}
    save_file({f"policy.{k}": v.contiguous() for k, v in model.policy.state_dict().items()} | statistics, fresh)
    fresh.replace(path)


def load_player(path: Path, env: VecEnv) -> PpoPlayer:
    """Read what `save_policy` wrote for an environment with states of the same width."""
    tensors = load_file(path)
    venv = StableBaselinesEnv(env)
    policy = ActorCriticPolicy(venv.observation_space, venv.action_space, lambda _: 0.0, **NETWORK)
    policy.load_state_dict({k.removeprefix("policy."): v for k, v in tensors.items() if k.startswith("policy.")})
    return PpoPlayer(policy, tensors["obs.mean"], tensors["obs.var"])


@dataclass(frozen=True)
class Score:
    """Episodes of one player.

    Attributes:
        episodes: how many.
        successes: of them.
        mean_return: `normalized_return`, mean over the episodes, in [0, 1].
        mean_steps: control steps played.
    """

    episodes: int
    successes: int
    mean_return: float
    mean_steps: float


def play(env: VecEnv, player: Player, seeds: Sequence[int]) -> Score:
    """Play every seed once, N of them at a time."""
    limit, parts = env.env_spec.max_episode_steps, []
    for first in range(0, len(seeds), env.num_envs):
        wanted = list(seeds[first : first + env.num_envs])
        padded = wanted + wanted[-1:] * (env.num_envs - len(wanted))
        obs, info = env.reset(seed=padded)
        player.begin(obs[STATE], padded)
        total, ended = torch.zeros(env.num_envs), torch.zeros(env.num_envs, dtype=torch.bool)
        while not ended.all():
            obs, reward, terminated, truncated, info = env.step(player.act(obs[STATE]).clamp(-1, 1))
            total, ended = total + reward, terminated | truncated
        success, steps = info["success_once"], info["elapsed_steps"]
        value = normalized_return(total, steps, success, limit)
        parts.append(torch.stack([success.float(), value, steps.float()], dim=1)[: len(wanted)])
    success, value, steps = torch.cat(parts).double().T
    return Score(len(seeds), int(success.sum()), float(value.mean()), float(steps.mean()))


# ---- training -------------------------------------------------------------------------------------------------


class CurveCallback(BaseCallback):
    """Evaluates the policy every `eval_every` control steps, keeps curve and weights, and stops when asked."""

    def __init__(self, args: Train, out: Path, held_out: VecEnv, normal: VecNormalize, stop: StopRequest) -> None:
        super().__init__()
        self._args, self._out, self._held_out, self._normal, self._stop = args, out, held_out, normal, stop
        self._points: list[dict[str, Any]] = []
        self._began = time.monotonic()
        self._progress = Progress(console=Console(file=sys.stderr))
        self._task = self._progress.add_task(f"{args.env} seed {args.seed}", total=args.steps)

    def _on_training_start(self) -> None:
        self._progress.start()
        self._evaluate()

    def _on_step(self) -> bool:
        self._progress.update(self._task, completed=HELD * self.num_timesteps)
        limit = self._args.minutes
        late = limit is not None and time.monotonic() - self._began > 60 * limit
        return not (self._stop.asked or late)

    def _on_rollout_start(self) -> None:  # the update that used the last rollout has been done
        if HELD * self.num_timesteps - self._points[-1]["steps"] >= self._args.eval_every:
            self._evaluate()

    def _on_training_end(self) -> None:
        self._evaluate()
        self._progress.stop()

    def _evaluate(self) -> None:
        """Add a point to the curve, and write curve and weights."""
        save_policy(self._out / WEIGHTS, self.model, self._normal)  # type: ignore[arg-type]  # made by `train`
        score = play(
            self._held_out, Held(load_player(self._out / WEIGHTS, self._held_out)), range(self._args.eval_episodes)
        )
        minutes, steps = (time.monotonic() - self._began) / 60, HELD * self.num_timesteps
        self._points.append({"steps": steps, "minutes": round(minutes, 2), **asdict(score)})
        write_json(self._out / CURVE, self._points)
        self._progress.console.print(
            f"{steps} control steps, {minutes:.1f} min: return {score.mean_return:.3f}, "
            f"success {score.successes}/{score.episodes}"
        )


def train(args: Train) -> None:
    """Train, and write curve and weights as they come."""
    out = args.out or Path("runs") / "ppo" / str(args.seed)
    if out.exists():
        raise ConfigError(f"{out} exists: choose another --out, or remove it")
    out.mkdir(parents=True)
    held = ChunkSpec(horizon=HELD, n_obs_steps=1, n_action_steps=HELD)
    settings = {k: str(v) if isinstance(v, Path) else v for k, v in asdict(args).items()}
    write_json(out / SETTINGS, settings | {"ppo": PPO_SETTINGS, "network": NETWORK, "versions": package_versions()})
    training, playing = (
        make_vec(args.env, args.rows, "cpu", obs=(STATE,), chunk=chunk, reward_mode="normalized_dense")
        for chunk in (held, None)
    )
    rows = AbsorbingSuccess(VecMonitor(StableBaselinesEnv(training)), GAMMA, largest=HELD)
    # Rewards are scaled by the spread of the discounted return, and not clipped: a success is far from the others.
    normal = VecNormalize(rows, clip_obs=CLIP_OBS, clip_reward=np.inf, gamma=GAMMA, epsilon=STD_FLOOR)
    model = PPO("MlpPolicy", normal, seed=args.seed, device="cpu", policy_kwargs=NETWORK, **PPO_SETTINGS)
    normal.seed((args.seed + 1) * TRAINING_SEEDS)  # PPO passes its own seed, which the evaluated episodes have too
    try:
        with stop_requests() as stop:
            model.learn(args.steps // HELD, callback=CurveCallback(args, out, playing, normal, stop))
    finally:
        training.close()
        playing.close()


def evaluate(args: Evaluate) -> None:
    """Write the scores of a trained policy and of those that it is compared with."""
    if not (args.run / WEIGHTS).is_file():
        raise ConfigError(f"{args.run} holds no {WEIGHTS}: give the folder of a run of 'train'")
    settings = json.loads((args.run / SETTINGS).read_text(encoding="utf-8"))
    env = make_vec(settings["env"], settings["rows"], "cpu", obs=(STATE,), reward_mode="normalized_dense")
    dim = env.env_spec.action.dim
    seeds = range(FINAL_SEEDS, FINAL_SEEDS + args.episodes)
    try:
        players: dict[str, Player] = {
            "PPO": Held(load_player(args.run / WEIGHTS, env)),
            "expert": ExpertPlayer(env),
            "random actions": Held(RandomPlayer(dim, settings["seed"])),
            "idle": IdlePlayer(dim),
        }
        scores = {name: asdict(play(env, player, seeds)) for name, player in players.items()}
    finally:
        env.close()
    write_json(args.run / SCORES, scores)
    print(json.dumps(scores, indent=2))


# ---- the report -----------------------------------------------------------------------------------------------


def report(args: Report) -> None:
    """Print a Markdown table of the runs and draw the picture."""
    settings, curves, scores = (
        [json.loads((run / name).read_text(encoding="utf-8")) for run in args.runs]
        for name in (SETTINGS, CURVE, SCORES)
    )
    labels = [f"PPO, seed {s['seed']}" for s in settings]
    print("| player | mean normalised return | success | 95 % interval (Clopper-Pearson) | control steps played |")
    print("|---|---|---|---|---|")
    for label, curve, score in zip(labels, curves, scores, strict=True):
        print(_row(f"{label}, after {curve[-1]['steps']} control steps", score["PPO"]))
    for name in REFERENCES:
        print(_row(name, scores[0][name]))
    _draw(labels, curves, scores[0], args.picture)


def _row(name: str, score: dict[str, Any]) -> str:
    low, high = (100 * bound for bound in rate_interval(score["successes"], score["episodes"]))
    success = f"{score['successes']}/{score['episodes']} | {low:.1f} to {high:.1f} %"
    return f"| {name} | {score['mean_return']:.3f} | {success} | {score['mean_steps']:.0f} |"


def _draw(labels: list[str], curves: list[list[dict[str, Any]]], others: dict[str, Any], picture: Path) -> None:
    """Draw return and success rate against control steps; those of the other players as lines."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    for label, curve in zip(labels, curves, strict=True):
        steps = [point["steps"] for point in curve]
        left.plot(steps, [point["mean_return"] for point in curve], ".-", label=label)
        right.plot(steps, [point["successes"] / point["episodes"] for point in curve], ".-", label=label)
    for name, style in REFERENCES.items():
        score = others[name]
        left.axhline(score["mean_return"], color="black", linestyle=style, linewidth=1, label=name)
        right.axhline(score["successes"] / score["episodes"], color="black", linestyle=style, linewidth=1)
    episodes = curves[0][0]["episodes"]
    for axes, title in ((left, "mean normalised return"), (right, f"success rate over {episodes} episodes")):
        axes.set(xlabel="control steps", ylabel=title, ylim=(-0.02, 1.02))
        axes.grid(alpha=0.3)
    left.legend(fontsize="small")
    picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(picture, dpi=130)
    print(picture)


def _present_words(words: Sequence[str]) -> list[str]:
    """Return the command line with `judge`, as `evaluate` was called before, under its present name."""
    if words[:1] == ["judge"]:
        print("judge is evaluate now; the former name goes with the next release", file=sys.stderr)
        return ["evaluate", *words[1:]]
    return list(words)


def main() -> None:
    """Parse the command line and run; one line for what a user can mend."""
    run: dict[type, Callable[[Any], None]] = {Train: train, Evaluate: evaluate, Report: report}
    args = tyro.cli(Train | Evaluate | Report, args=_present_words(sys.argv[1:]))
    try:
        with torch_threads(1):  # the workers need the cores
            run[type(args)](args)
    except ManicmError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
