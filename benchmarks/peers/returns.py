"""Whole runs of SBX's or Stable-Baselines3's SAC on the half cheetah, to hold beside `--method=sac` and `sac_v2`:

    python -m benchmarks.peers.returns --library=sbx --seed=0 --steps=100000 --out=FILE.json

All settings are the library's own for `HalfCheetah-v5` (networks of 256-256, batch 256, an update a step, alpha
learned), but for the warm-up, which is as long as ours. Evaluated as `--eval-every` does it: deterministic episodes in
an environment of their own. One thread, as our command line has.
"""

import argparse
import importlib
import json
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from benchmarks.peers import EXTRA
from benchmarks.peers.common import torch_on_one_thread
from experiments import process
from experiments.runs.files import write_text
from experiments.runtime import set_cpu_switches

ENVIRONMENT = "HalfCheetah-v5"
LIBRARIES = {"sbx": "sbx", "sb3": "stable_baselines3"}
"""Flag -> package."""


def evaluate(model: Any, env: gymnasium.Env, episodes: int) -> list[float]:
    """Returns of whole episodes by what the policy holds for the best."""
    returns = []
    for _ in range(episodes):
        obs, earned, done = env.reset()[0], 0.0, False
        while not done:
            action = model.predict(obs, deterministic=True)[0]
            obs, reward, terminated, truncated, _ = env.step(action)
            earned, done = earned + float(reward), terminated or truncated
        returns.append(earned)
    return returns


def train(library: str, seed: int, steps: int, warm_up: int, every: int, episodes: int) -> dict[str, Any]:
    """A run: who, its settings, and a row `{env_steps, return, return_std, seconds}` for each evaluation.

    Raises:
        ModuleNotFoundError: the library is not installed; `pip install -e ".[peers]"`.
    """
    torch_on_one_thread()
    package = importlib.import_module(LIBRARIES[library])
    env, trial = gymnasium.make(ENVIRONMENT), gymnasium.make(ENVIRONMENT)
    trial.reset(seed=seed + 10_000)
    model = package.SAC("MlpPolicy", env, learning_starts=warm_up, seed=seed, device="cpu")
    rows, start = [], time.monotonic()
    for done in range(0, steps, every):
        model.learn(min(every, steps - done), reset_num_timesteps=False)
        returns = evaluate(model, trial, episodes)
        mean, spread = float(np.mean(returns)), float(np.std(returns))
        seconds = round(time.monotonic() - start, 1)
        row = {"env_steps": int(model.num_timesteps), "return": mean, "return_std": spread, "seconds": seconds}
        print(json.dumps(row), flush=True)
        rows.append(row)
    who = {"library": library, "version": package.__version__, "environment": ENVIRONMENT, "seed": seed}
    return {**who, "warm_up_steps": warm_up, "rows": rows}


def main() -> int:
    """The command line; the exit status is 0, or 2 for bad input."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--library", choices=sorted(LIBRARIES), required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--warm-up-steps", type=int, default=10_000)
    parser.add_argument("--eval-every", type=int, default=5_000)
    parser.add_argument("--eval-episodes", type=int, default=5)
    parser.add_argument("--out", type=Path, required=True, help="a JSON file")
    args = parser.parse_args()
    for name in ("steps", "eval_every", "eval_episodes"):
        if getattr(args, name) < 1:
            parser.error(f"--{name.replace('_', '-')}={getattr(args, name)}. Allowed: a whole number, 1 or more.")
    if not args.out.parent.is_dir():
        parser.error(f"--out={args.out}. Allowed: a file in a directory that is there.")
    set_cpu_switches()
    try:
        result = train(args.library, args.seed, args.steps, args.warm_up_steps, args.eval_every, args.eval_episodes)
    except ModuleNotFoundError as error:
        parser.error(f"--library={args.library}: {error.name} is not installed. What to do: {EXTRA}.")
    write_text(args.out, json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    process.carry_out(main)
