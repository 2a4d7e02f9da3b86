"""Monte-Carlo tree search over a finite model given as tables, as one jitted program.

One iteration descends from the root by UCB-1, adds one node, runs uniform random trajectories from it, and carries the
mean of their returns back along the path. A node is a sequence of actions together with the state that they led to: a
random one of the models moves each edge when it is made, and each step of a trajectory.

    UCB-1 of action a = Q(a) / c + w sqrt(ln n / n_a)

Q is the mean return through a, n_a how often a was tried, n the sum over actions, c the largest return seen in this
tree and w = sqrt(2). Without c the bonus would swamp intrinsic rewards, which are far below 1. Actions not yet tried
come first, ties are random.

Our own rather than `mctx.search`, which takes UCB-1 as a selection function and trajectories as a leaf's value: its
tree holds mean values only, not the largest return, and it draws random numbers in each simulation, where all can be
drawn in one call beforehand. With c as the largest *mean* the two agree: over 300 keys on a chain of 40 the root's
means are 0.2926 and 0.1549 here, 0.2922 and 0.1547 there (standard errors 0.0015, mctx 0.0.71).
`python -m benchmarks.run --only=peers` times both.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple, TypeAlias, get_args

import jax
import jax.numpy as jnp

from jaxplore import validate
from jaxplore.types import Array, Key, Metrics
from jaxplore.validate import Checks, FieldError

ModelStep: TypeAlias = Literal["arg_max", "sample"]

UNROLL = 7
"""Steps of a trajectory per turn of its loop: turning costs more than a step."""


@dataclass(frozen=True)
class MCTSConfig:
    """Settings of tree search. The defaults are the paper's for the chain, or say where they are from."""

    num_iterations: int = 25
    """Nodes added to a tree. Paper: 25."""
    num_trajectories: int = 10
    """Random trajectories from each. Paper: 10."""
    horizon: int = 49
    """Depth that nothing is looked at beyond. The chain's episode; the paper is silent."""
    discount: float = 1.0
    """gamma per step. The paper is silent."""
    ucb_weight: float = math.sqrt(2.0)
    """w of the bonus. UCB-1: sqrt(2)."""
    model_step: ModelStep = "arg_max"
    """Where a model goes: its most likely next state, or one drawn by its probabilities (`sample`)."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        for field in ("num_iterations", "num_trajectories", "horizon"):
            checks.at_least(field, 1)
        checks.in_range("discount", 0.0, 1.0)
        checks.in_range("ucb_weight", 0.0)
        checks.one_of("model_step", get_args(ModelStep))


class Tables(NamedTuple):
    """A finite model: `X` states, `A` actions."""

    next_state: Array
    """Where each of m models goes, int32 `[M, X, A]`."""
    utility: Array
    """Reward of a state and action, at least 0, `[X, A]`."""


class Tree(NamedTuple):
    """What a search leaves behind. Node 0 is the root, node i + 1 was added in iteration i; `T` nodes."""

    children: Array
    """Node that an action leads to, 0 where it was not tried, int32 `[T, A]`."""
    parent: Array
    """int32 `[T]`"""
    state: Array
    """int32 `[T]`"""
    depth: Array
    """Actions from the root, int32 `[T]`."""
    reward: Array
    """Utility of the edge into the node, `[T]`."""
    visits: Array
    """Returns carried through the node, `[T]`."""
    total: Array
    """Their sum, the edge into the node included, `[T]`."""
    largest: Array
    """Largest of all of them, scalar."""


class Draws(NamedTuple):
    """All chance in one search; `T` iterations."""

    ties: Array
    """Which of equal actions wins (the largest), by iteration and depth, `[T, T, A]`."""
    model: Array
    """Which model moves the edge that an iteration adds, int32 `[T]`."""
    moves: Array
    """Model and action of each step of each trajectory, `model * A + action`, int32 `[T, H, trajectories]`."""


class MCTS(NamedTuple):
    """Tree search as pure functions."""

    draw: Callable[[Key, int], Draws]
    """`draw(key, num_models) -> draws`."""
    search: Callable[[Draws, Tables, Array], Tree]
    """`search(draws, tables, root_state) -> tree`."""
    plan: Callable[[Key, Tables, Array], tuple[Array, Metrics]]
    """`plan(key, tables, root_state) -> (action, metrics)`: search, and take the action of the highest mean return,
    int32. The metrics are that return, `value`, and the deepest node's `depth`."""


class MCTSSpec(NamedTuple):
    """The fixed parts of a search, which its functions take first."""

    num_actions: int
    """`A`"""
    config: MCTSConfig


WORD_BIAS = 2.0**-14
"""How much likelier, at most and relative to one another, small numbers cut out of a random word may be."""


def small_integers(key: Key, shape: tuple[int, ...], limit: int) -> Array:
    """Uniform integers below `limit`, int32 `shape`, several of each random word: most of a search's time is chance.

    A word modulo limit^k is k of them. As 2^32 is no multiple of that, some values are limit^k / 2^32 likelier, which
    is at most `WORD_BIAS`.
    """
    total, count = math.prod(shape), 1
    while limit ** (count + 1) <= WORD_BIAS * 2**32 and limit > 1:
        count += 1
    words = jax.random.bits(key, (-(-total // count),), jnp.uint32)
    digits = []
    for _ in range(count):
        digits.append((words % limit).astype(jnp.int32))
        words = words // limit
    return jnp.stack(digits).reshape(-1)[:total].reshape(shape)


def draw(spec: MCTSSpec, key: Key, num_models: int) -> Draws:
    """All chance in one search over tables of `num_models` models."""
    ties_key, model_key, moves_key = jax.random.split(key, 3)
    config, num, num_actions = spec.config, spec.config.num_iterations, spec.num_actions
    shape = (num, config.horizon, config.num_trajectories)
    return Draws(
        ties=jax.random.uniform(ties_key, (num, num, num_actions)),
        model=jax.random.randint(model_key, (num,), 0, num_models),
        moves=small_integers(moves_key, shape, num_models * num_actions),
    )


def ucb(spec: MCTSSpec, tree: Tree, node: Array) -> Array:
    """UCB-1 of the actions at a node, `[A]`; infinite where an action was not tried."""
    child = tree.children[node]
    visits = tree.visits[child]
    scale = jnp.where(tree.largest > 0, tree.largest, 1.0)
    tried = child > 0
    count = jnp.maximum(visits, 1.0)
    parent_count = jnp.maximum(jnp.sum(jnp.where(tried, visits, 0.0)), 1.0)
    score = tree.total[child] / count / scale + spec.config.ucb_weight * jnp.sqrt(jnp.log(parent_count) / count)
    return jnp.where(tried, score, jnp.inf)


def _best(score: Array, ties: Array) -> Array:
    """Place of the largest of `score [A]`; among equals that of the largest of `ties [A]`."""
    return jnp.argmax(jnp.where(score == jnp.max(score), ties, -1.0))


def random_return(spec: MCTSSpec, moves: Array, tables: Tables, state: Array, num_steps: Array) -> Array:
    """Mean return of random trajectories, a scalar.

    Args:
        spec: the fixed parts.
        moves: model and action of each step, as in `Draws.moves`, `[H, trajectories]`.
        tables: the model.
        state: where all trajectories start, int32.
        num_steps: their length, int32, at most `H`.
    """
    horizon, num_actions, num_states = spec.config.horizon, spec.num_actions, tables.utility.shape[0]
    next_state, utility = tables.next_state.reshape(-1), tables.utility.reshape(-1)

    def step(carry: tuple[Array, Array, Array], row: tuple[Array, Array]):
        states, returns, factor = carry
        move, t = row
        pair = states * num_actions + move % num_actions
        weight = jnp.where(t < num_steps, factor, 0.0)
        returns = returns + weight * utility[pair]
        states = next_state[move // num_actions * (num_states * num_actions) + pair]
        return (states, returns, spec.config.discount * factor), None

    start = (jnp.full(moves.shape[1], state), jnp.zeros(moves.shape[1]), jnp.ones(()))
    rows = (moves, jnp.arange(horizon))
    (_, returns, _), _ = jax.lax.scan(step, start, rows, unroll=min(UNROLL, horizon))
    return jnp.mean(returns)


def init_tree(spec: MCTSSpec, root_state: Array) -> Tree:
    """A tree of nothing but a root in `root_state`, int32, with room for a node per iteration."""
    size = spec.config.num_iterations + 1
    whole, number = jnp.zeros(size, jnp.int32), jnp.zeros(size)
    return Tree(
        children=jnp.zeros((size, spec.num_actions), jnp.int32),
        parent=whole,
        state=whole.at[0].set(root_state),
        depth=whole,
        reward=number,
        visits=number,
        total=number,
        largest=jnp.zeros(()),
    )


def select(spec: MCTSSpec, tree: Tree, ties: Array) -> tuple[Array, Array]:
    """Descend by UCB-1 to the edge to add: `(parent, action)`, int32. `ties` are an iteration's of `Draws`, `[T, A]`.

    At the horizon the edge is one that is not to be added.
    """

    def inside(edge: tuple[Array, Array]) -> Array:
        node, action = edge
        return (tree.children[node, action] > 0) & (tree.depth[node] < spec.config.horizon)

    def descend(edge: tuple[Array, Array]) -> tuple[Array, Array]:
        node = tree.children[edge]
        return node, _best(ucb(spec, tree, node), ties[tree.depth[node]])

    root = jnp.int32(0)
    return jax.lax.while_loop(inside, descend, (root, _best(ucb(spec, tree, root), ties[0])))


def expand(
    spec: MCTSSpec, draws: Draws, tables: Tables, tree: Tree, iteration: Array, edge: tuple[Array, Array]
) -> tuple[Tree, Array]:
    """Add the node that `edge`, from `select`, leads to.

    Returns:
        `(tree, node)`: the tree with the new node, and its number. At the horizon nothing is added, and the node is the
        edge's parent.
    """
    parent, action = edge
    # At the horizon the last node's own return, 0 from there on, is carried back again.
    grows = tree.depth[parent] < spec.config.horizon
    node = jnp.where(grows, iteration + 1, parent)
    pair = tree.state[parent], action

    def put(leaf: Array, value: Array) -> Array:
        return leaf.at[node].set(jnp.where(grows, value, leaf[node]))

    tree = tree._replace(
        children=tree.children.at[parent, action].set(jnp.where(grows, node, tree.children[parent, action])),
        parent=put(tree.parent, parent),
        state=put(tree.state, tables.next_state[draws.model[iteration], *pair]),
        depth=put(tree.depth, tree.depth[parent] + 1),
        reward=put(tree.reward, tables.utility[pair]),
    )
    return tree, node


def carry_back(spec: MCTSSpec, tree: Tree, node: Array, value: Array) -> Tree:
    """Count the return `value`, a scalar, from `node` on in every node on the path to the root."""

    def step(carry: tuple[Array, Array, Tree]) -> tuple[Array, Array, Tree]:
        node, value, tree = carry
        value = tree.reward[node] + spec.config.discount * value
        return (
            tree.parent[node],
            value,
            tree._replace(
                visits=tree.visits.at[node].add(1.0),
                total=tree.total.at[node].add(value),
                largest=jnp.maximum(tree.largest, value),
            ),
        )

    return jax.lax.while_loop(lambda carry: carry[0] > 0, step, (node, value, tree))[2]


def search(spec: MCTSSpec, draws: Draws, tables: Tables, root_state: Array) -> Tree:
    """The tree of a whole search from `root_state`, int32; see `MCTS.search`."""

    def iterate(i: Array, tree: Tree) -> Tree:
        edge = select(spec, tree, draws.ties[i])
        tree, node = expand(spec, draws, tables, tree, i, edge)
        moves, state = draws.moves[i], tree.state[node]
        value = random_return(spec, moves, tables, state, spec.config.horizon - tree.depth[node])
        return carry_back(spec, tree, node, value)

    return jax.lax.fori_loop(0, spec.config.num_iterations, iterate, init_tree(spec, root_state))


def plan(spec: MCTSSpec, key: Key, tables: Tables, root_state: Array) -> tuple[Array, Metrics]:
    """The action of the highest mean return after a search from `root_state`; see `MCTS.plan`."""
    search_key, tie_key = jax.random.split(key)
    tree = search(spec, draw(spec, search_key, tables.next_state.shape[0]), tables, root_state)
    child = tree.children[0]
    means = tree.total[child] / tree.visits[child]
    action = _best(means, jax.random.uniform(tie_key, (spec.num_actions,)))
    return action.astype(jnp.int32), {"value": means[action], "depth": jnp.max(tree.depth)}


def make_mcts(num_actions: int, config: MCTSConfig | None = None) -> MCTS:
    """Make the search.

    Args:
        num_actions: `A`.
        config: the paper's settings by default.

    Returns:
        An `MCTS`. Its functions are unbatched: `vmap` them over keys, tables and states.

    Raises:
        ValueError: `num_actions` below 1, or more actions than iterations to try them in.

    Example:
        In a ring of 10 states, something is to be had 3 steps to the right:

        >>> import jax, jax.numpy as jnp
        >>> states = jnp.arange(10)
        >>> ring = jnp.stack([(states - 1) % 10, (states + 1) % 10], axis=1)
        >>> tables = Tables(ring[None], jnp.zeros((10, 2)).at[3].set(1.0))
        >>> action, metrics = make_mcts(2, MCTSConfig(horizon=5)).plan(jax.random.key(0), tables, jnp.int32(0))
        >>> int(action)
        1
    """
    config = config or MCTSConfig()
    validate.at_least("num_actions", num_actions, 1)
    num = config.num_iterations
    if num < num_actions:
        raise FieldError("num_iterations", num, f"at least {num_actions}", "leaves actions untried", "MCTSConfig")
    spec = MCTSSpec(num_actions, config)
    return MCTS(draw=partial(draw, spec), search=partial(search, spec), plan=jax.jit(partial(plan, spec)))
