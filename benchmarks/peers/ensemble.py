"""MAX's ensemble (Shyam et al. 2019) beside the same in plain PyTorch: a gradient step, and an imagined step.

Gaussian networks with swish, each on a batch of its own; a step of all actors in all models, the policy's action and
the Jensen-Renyi divergence included. Theirs is written here as nnaisense/max computes it: layers of all members as one
batched product, all pairs of models at once in the divergence, Adam in one fused kernel, nothing compiled. It starts
from our parameters, and a test holds its numbers against ours.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import flops
from benchmarks.kernels import ACTION, OBS, random_data
from benchmarks.peers.common import Line, torch_on_one_thread
from benchmarks.result import widths
from benchmarks.timing import measure_pairs
from experiments.runs.presets import preset_config
from jaxplore import ExplorationConfig, Seen, World, dynamics, make_ensemble_belief, make_sac, rewards, rollout
from jaxplore.beliefs import Belief
from jaxplore.dynamics import LOG_VAR_BOUNDS
from jaxplore.signals.rewards import MAX_VAR

ROWS = 4096
"""Transitions in the replays."""
HORIZON = 10
"""Imagined steps of one call."""


def lines() -> Iterator[Line]:
    """Both steps at the laptop's and the paper's shape, the latter MAX's own."""
    torch = torch_on_one_thread()
    for preset, pairs, calls in (("laptop", 15, 5), ("paper", 7, 1)):
        config = preset_config(preset, method="max").explorer
        yield gradient_line(config, torch, pairs, calls)
        yield imagined_line(config, torch, pairs)


def gradient_line(config: ExplorationConfig, torch: Any, pairs: int, calls: int) -> Line:
    """A gradient step of all members."""
    times = measure_pairs(ours_step(config), theirs_step(torch, config), pairs=pairs, calls=calls)
    flop = flops.ensemble_step(_target(config), config.ensemble.num_members, config.fit.batch_size)
    shape = f"{config.ensemble.num_members} x {widths(config.dynamics.hidden)}, batch {config.fit.batch_size}"
    return Line("ensemble's gradient step", shape, "PyTorch", times, flop, flop)


def imagined_line(config: ExplorationConfig, torch: Any, pairs: int) -> Line:
    """A step of all actors in all models."""
    times = measure_pairs(ours_imagined(config), theirs_imagined(torch, config), pairs=pairs, inner=HORIZON)
    members, actors = config.ensemble.num_members, config.imagination.num_actors
    flop = flops.imagined_step(_target(config), (OBS, *config.sac.hidden, 2 * ACTION), members, actors)
    shape = f"{members} x {widths(config.dynamics.hidden)}, {actors} actors"
    return Line("imagined step, divergence", shape, "PyTorch", times, flop, flop)


def _target(config: ExplorationConfig) -> tuple[int, ...]:
    return (OBS + ACTION, *config.dynamics.hidden, 2 * OBS)


def belief_of(config: ExplorationConfig) -> Belief:
    """Our ensemble."""
    settings = {"ensemble_config": config.ensemble, "fit_config": config.fit}
    return make_ensemble_belief(OBS, ACTION, gaussian=True, dynamics_config=config.dynamics, **settings)


def models_of(config: ExplorationConfig) -> Any:
    """Parameters that both sides start from."""
    belief = belief_of(config)
    return belief.sample(jax.random.key(1), belief.init(jax.random.key(0)), belief.num_models)


def ours_step(config: ExplorationConfig) -> Callable[[], Any]:
    """A gradient step on batches drawn from a replay, each from where the last one ended."""
    belief, normalizers = belief_of(config), dynamics.init_normalizers(OBS, ACTION)
    step = jax.jit(belief.update, donate_argnums=1)
    key, state, data = jax.random.key(1), belief.init(jax.random.key(0)), random_data(ROWS, ROWS)

    def call() -> Any:
        nonlocal key, state
        key, step_key = jax.random.split(key)
        state, metrics = step(step_key, state, data, normalizers)
        return state, metrics

    return call


def ours_imagined(config: ExplorationConfig) -> Callable[[], Any]:
    """`HORIZON` imagined steps."""
    belief, models, sac = belief_of(config), models_of(config), make_sac(OBS, ACTION, config.sac)
    start = jnp.zeros((config.imagination.num_actors, OBS))

    @jax.jit
    def roll(key: jax.Array, models: Any, actor: Any) -> Any:
        def score(seen: Seen) -> jax.Array:
            return rewards.jensen_renyi(seen.prediction, config.renyi_decay)

        world = World(belief, models, dynamics.init_normalizers(OBS, ACTION), score)
        return rollout(key, lambda act_key, obs: sac.act(act_key, actor, obs), world, start, HORIZON)

    actor = sac.actor(sac.init(jax.random.key(0)))
    return lambda: roll(jax.random.key(3), models, actor)


def layers_of(torch: Any, params: Any) -> list[tuple[Any, Any]]:
    """Our parameters as PyTorch's: kernels `[..., in, out]` and biases `[..., 1, out]`, the last layer last."""
    names = [*sorted(name for name in params if name != "output"), "output"]
    as_tensor = lambda leaf: torch.from_numpy(np.array(leaf))  # noqa: E731
    return [(as_tensor(params[name]["kernel"]), as_tensor(params[name]["bias"])[..., None, :]) for name in names]


def predict(torch: Any, layers: list[tuple[Any, Any]], inputs: Any) -> tuple[Any, Any]:
    """Mean and log variance, each `[M, B, O]`, of all members for `inputs [M, B, O + A]`."""
    for kernel, bias in layers[:-1]:
        inputs = torch.nn.functional.silu(torch.baddbmm(bias, inputs, kernel))
    kernel, bias = layers[-1]
    mean, raw = torch.baddbmm(bias, inputs, kernel).chunk(2, dim=-1)
    low, high = LOG_VAR_BOUNDS
    return mean, low + (high - low) * torch.sigmoid(raw)


def divergence(torch: Any, mean: Any, log_var: Any, decay: float) -> Any:
    """Jensen-Renyi divergence `[N]` of predictions `[M, N, O]`, all pairs of models at once."""
    var = MAX_VAR - decay * (MAX_VAR - torch.exp(log_var))
    total = var[:, None] + var[None]
    distance = ((mean[:, None] - mean[None]) ** 2 / total).sum(-1)
    overlaps = -0.5 * (distance + torch.log(0.5 * total).sum(-1))
    own = -0.5 * torch.log(var).sum(-1)
    return 2.0 * math.log(len(mean)) - torch.logsumexp(overlaps.flatten(0, 1), dim=0) + own.mean(0)


def theirs_step(torch: Any, config: ExplorationConfig) -> Callable[[], Any]:
    """A gradient step on batches drawn from a replay."""
    layers, fit = layers_of(torch, models_of(config)), config.fit
    params = [leaf.requires_grad_() for layer in layers for leaf in layer]
    optimizer = torch.optim.Adam(params, fit.lr, weight_decay=fit.weight_decay, fused=True)
    generator = torch.Generator().manual_seed(0)
    obs, next_obs = torch.randn(2, ROWS, OBS, generator=generator)
    action, shape = torch.zeros(ROWS, ACTION), (config.ensemble.num_members, fit.batch_size)
    obs_mean, obs_std, delta_mean, delta_std = (torch.full((OBS,), value) for value in (0.0, 1.0, 0.0, 1.0))

    def call() -> Any:
        index = torch.randint(ROWS, shape, generator=generator)
        seen = obs[index]
        inputs = torch.cat([(seen - obs_mean) / obs_std, action[index]], dim=-1)
        target = (next_obs[index] - seen - delta_mean) / delta_std
        mean, log_var = predict(torch, layers, inputs)
        # Of each member the mean over its batch and entries; their sum, as their gradients do not mix.
        loss = ((mean - target) ** 2 * torch.exp(-log_var) + log_var).mean((1, 2)).sum()
        optimizer.zero_grad()
        loss.backward()
        if fit.clip_value:
            torch.nn.utils.clip_grad_value_(params, fit.clip_value)
        optimizer.step()
        return loss.item()

    return call


def theirs_imagined(torch: Any, config: ExplorationConfig) -> Callable[[], Any]:
    """`HORIZON` imagined steps."""
    layers, members = layers_of(torch, models_of(config)), config.ensemble.num_members
    sac = make_sac(OBS, ACTION, config.sac)
    policy = layers_of(torch, sac.actor(sac.init(jax.random.key(0)))["mlp"])
    num, low, high = config.imagination.num_actors, config.sac.log_std_min, config.sac.log_std_max
    obs_mean, obs_std, delta_mean, delta_std = (torch.full((OBS,), value) for value in (0.0, 1.0, 0.0, 1.0))
    actors = torch.arange(num)

    def act(obs: Any) -> Any:
        hidden = obs
        for kernel, bias in policy[:-1]:
            hidden = torch.nn.functional.leaky_relu(torch.addmm(bias, hidden, kernel))
        mean, head = torch.addmm(policy[-1][1], hidden, policy[-1][0]).chunk(2, dim=-1)
        log_std = low + 0.5 * (high - low) * (torch.tanh(head) + 1.0)
        return torch.tanh(mean + torch.exp(log_std) * torch.randn(mean.shape))

    @torch.inference_mode()
    def call() -> Any:
        obs, steps = torch.zeros(num, OBS), []
        for _ in range(HORIZON):
            action = act(obs)
            inputs = torch.cat([(obs - obs_mean) / obs_std, action], dim=-1)
            mean, log_var = predict(torch, layers, inputs.expand(members, *inputs.shape))
            chosen = torch.randint(members, (num,))
            delta = mean[chosen, actors] + torch.exp(0.5 * log_var[chosen, actors]) * torch.randn(num, OBS)
            next_obs = obs + delta_mean + delta_std * delta
            steps.append((obs, action, divergence(torch, mean, log_var, config.renyi_decay), next_obs))
            obs = next_obs
        return [torch.stack(leaves) for leaves in zip(*steps, strict=True)]

    return call
