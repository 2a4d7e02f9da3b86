"""Tree search on the chain, beside `mctx.search` with the same rules.

A search of mctx gets UCB-1 as its selection and the mean of random trajectories as a leaf's value. One thing differs:
UCB-1's scale is the largest mean return in the tree there and the largest single return here, which mctx's tree does
not hold.
"""

import importlib
import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.peers.common import Line
from benchmarks.timing import measure_pairs
from experiments.runs.presets import preset_config
from jaxplore import MCTSConfig
from jaxplore.behaviours.mcts import Tables, make_mcts

STATES, ACTIONS, MODELS = 40, 2, 5
"""Of the paper's chain, and of its belief."""


def lines() -> Iterator[Line]:
    """One search at the paper's and the laptop's settings."""
    mctx, root = importlib.import_module("mctx"), jnp.int32(STATES // 2)
    for preset, calls in (("paper", 20), ("laptop", 3)):
        config, tables = preset_config(preset, "nchain").explorer.mcts, chain()
        ours, theirs = make_mcts(ACTIONS, config).plan, plan_of(mctx, config)
        pairs = measure_pairs(chained(ours, tables, root), chained(theirs, tables, root), calls=calls)
        shape = f"{config.num_iterations} nodes, {config.num_trajectories} trajectories of up to {config.horizon}"
        yield Line("tree search on the chain", shape, "mctx", pairs)


def chain() -> Tables:
    """A chain that half of the models have turned round in some states, with something to be had at its right end."""
    states = jnp.arange(STATES)
    ends = jnp.stack([jnp.maximum(states - 1, 0), jnp.minimum(states + 1, STATES - 1)], axis=1)
    flipped = jax.random.bernoulli(jax.random.key(0), 0.1, (MODELS, STATES, 1))
    return Tables(jnp.where(flipped, ends[None, :, ::-1], ends[None]), jnp.zeros((STATES, ACTIONS)).at[-1].set(1.0))


def chained(plan: Callable[..., Any], tables: Tables, root: jax.Array) -> Callable[[], Any]:
    """Searches from `root`, each with a key of its own."""
    split, key = jax.jit(jax.random.split), jax.random.key(1)

    def call() -> Any:
        nonlocal key
        key, search_key = split(key)
        return plan(search_key, tables, root)

    return call


def plan_of(mctx: Any, config: MCTSConfig) -> Callable[..., Any]:
    """`plan(key, tables, root_state) -> (action, means [A])` by mctx, compiled."""

    def means(tree: Any) -> Any:
        """Mean return `[T, A]` of every edge; that of one not tried says nothing."""
        return tree.children_rewards + tree.children_discounts * tree.children_values

    def select(key: jax.Array, tree: Any, node: jax.Array, depth: Any = 0) -> jax.Array:
        visits, edges = tree.children_visits[node], means(tree)
        largest = jnp.max(jnp.where(tree.children_visits > 0, edges, 0.0))
        scale, count = jnp.where(largest > 0, largest, 1.0), jnp.maximum(visits, 1)
        bonus = config.ucb_weight * jnp.sqrt(jnp.log(jnp.maximum(jnp.sum(visits), 1.0)) / count)
        score = jnp.where(visits > 0, edges[node] / scale + bonus, jnp.inf)
        ties = jax.random.uniform(key, score.shape)
        return jnp.argmax(jnp.where(score == jnp.max(score), ties, -1.0)).astype(jnp.int32)

    def value_of(moves: jax.Array, tables: Tables, state: jax.Array, num_steps: jax.Array) -> jax.Array:
        def step(carry: Any, row: Any) -> tuple[Any, None]:
            states, returns, factor = carry
            move, t = row
            model, action = move // ACTIONS, move % ACTIONS
            returns = returns + jnp.where(t < num_steps, factor, 0.0) * tables.utility[states, action]
            return (tables.next_state[model, states, action], returns, config.discount * factor), None

        start = jnp.full(moves.shape[1], state), jnp.zeros(moves.shape[1]), jnp.ones(())
        return jnp.mean(jax.lax.scan(step, start, (moves, jnp.arange(config.horizon)), unroll=7)[0][1])

    def recurrent(tables: Tables, key: jax.Array, action: jax.Array, embedding: Any) -> Any:
        state, depth = embedding
        model_key, moves_key = jax.random.split(key)
        num_models = tables.next_state.shape[0]
        model = jax.random.randint(model_key, state.shape, 0, num_models)
        shape = (state.shape[0], config.horizon, config.num_trajectories)
        moves = jax.random.randint(moves_key, shape, 0, num_models * ACTIONS)
        there = tables.next_state[model, state, action]
        value = jax.vmap(value_of, in_axes=(0, None, 0, 0))(moves, tables, there, config.horizon - depth - 1)
        logits, discount = jnp.zeros((state.shape[0], ACTIONS)), jnp.full(state.shape, config.discount)
        step = mctx.RecurrentFnOutput(
            reward=tables.utility[state, action], discount=discount, prior_logits=logits, value=value
        )
        return step, (there, depth + 1)

    @jax.jit
    def plan(key: jax.Array, tables: Tables, root_state: jax.Array) -> Any:
        embedding = root_state[None], jnp.zeros(1, jnp.int32)
        root = mctx.RootFnOutput(prior_logits=jnp.zeros((1, ACTIONS)), value=jnp.zeros(1), embedding=embedding)
        tree = mctx.search(
            tables,
            key,
            root=root,
            recurrent_fn=recurrent,
            root_action_selection_fn=select,
            interior_action_selection_fn=select,
            num_simulations=config.num_iterations,
            max_depth=config.horizon,
        )
        of_root = means(tree)[0, 0]
        return jnp.argmax(of_root), of_root

    return plan


def agreement(mctx: Any, config: MCTSConfig, num: int = 300) -> float:
    """How many standard errors our and their mean return of the right-hand action lie apart, over `num` keys."""
    keys, tables, root = jax.random.split(jax.random.key(2), num), chain(), jnp.int32(STATES - 5)
    search = make_mcts(ACTIONS, config)

    def ours(key: jax.Array) -> jax.Array:
        tree = search.search(search.draw(key, MODELS), tables, root)
        child = tree.children[0, 1]
        return tree.total[child] / tree.visits[child]

    theirs = plan_of(mctx, config)
    values = [jax.vmap(ours)(keys), jnp.stack([theirs(key, tables, root)[1][1] for key in keys])]
    errors = [jnp.std(one) / math.sqrt(num) for one in values]
    return float((jnp.mean(values[0]) - jnp.mean(values[1])) / jnp.hypot(*errors))
