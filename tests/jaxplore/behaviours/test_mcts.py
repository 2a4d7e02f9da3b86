"""Tree search: against a plain one in NumPy that gets the same draws, by hand, and on tasks with one right answer."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxplore.behaviours.mcts import MCTSConfig, Tables, make_mcts, small_integers

ROOT = jnp.int32(0)


class Node:
    """A node of the oracle."""

    def __init__(self, state, depth, reward=0.0):
        self.state, self.depth, self.reward = state, depth, reward
        self.children, self.returns = {}, []


def oracle(draws, tables, root_state, config):
    """The search as one would write it down: nodes that hold their children and every return."""
    next_state, utility = (np.asarray(leaf) for leaf in tables)
    ties, models, moves = (np.asarray(leaf) for leaf in draws)
    num_actions = utility.shape[1]
    root, seen = Node(int(root_state), 0), []

    def choose(node, ties):
        c, n = (
            (max(seen) if seen and max(seen) > 0 else 1.0),
            sum(len(child.returns) for child in node.children.values()),
        )

        def score(action):
            if action not in node.children:
                return math.inf
            returns = node.children[action].returns
            return np.mean(returns) / c + config.ucb_weight * math.sqrt(math.log(n) / len(returns))

        return max(range(num_actions), key=lambda action: (score(action), ties[action]))

    for i in range(config.num_iterations):
        path = [root]
        while path[-1].depth < config.horizon:
            node = path[-1]
            action = choose(node, ties[i, node.depth])
            new = action not in node.children
            if new:
                pair = node.state, action
                node.children[action] = Node(next_state[(models[i], *pair)], node.depth + 1, utility[pair])
            path.append(node.children[action])
            if new:
                break
        returns = []
        for trajectory in range(config.num_trajectories):
            state, total = path[-1].state, 0.0
            for t in range(config.horizon - path[-1].depth):
                model, action = divmod(int(moves[i, t, trajectory]), num_actions)
                total += config.discount**t * utility[state, action]
                state = next_state[model, state, action]
            returns.append(total)
        value = np.mean(returns)
        for node in reversed(path[1:]):
            value = node.reward + config.discount * value
            node.returns.append(value)
            seen.append(value)
    return root


def assert_same(tree, index, node):
    """Tree and oracle agree from here down: states, edges, visits and returns."""
    assert int(tree.state[index]) == node.state
    assert int(tree.depth[index]) == node.depth
    for action, child in enumerate(tree.children[index]):
        assert (child > 0) == (action in node.children)
        if child > 0:
            twin = node.children[action]
            assert int(tree.visits[child]) == len(twin.returns)
            assert float(tree.total[child]) == pytest.approx(sum(twin.returns), rel=1e-4)
            assert_same(tree, child, twin)


@pytest.mark.parametrize(
    ("num_actions", "config"),
    [
        (2, MCTSConfig()),
        (3, MCTSConfig(num_iterations=40, horizon=4, discount=0.9, num_trajectories=3)),
        (2, MCTSConfig(num_iterations=60, horizon=3, ucb_weight=0.3)),
    ],
    ids=["paper", "discounted", "deeper than the horizon"],
)
def test_tree_is_that_of_a_plain_search(num_actions, config):
    # the same draws, random tables of 5 models and 12 states, three keys: the same tree, node by node
    mcts = make_mcts(num_actions, config)
    draw, search = jax.jit(mcts.draw, static_argnums=1), jax.jit(mcts.search)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        tables = Tables(
            jnp.asarray(rng.integers(0, 12, (5, 12, num_actions)), jnp.int32),
            jnp.asarray(0.01 * rng.uniform(size=(12, num_actions)) ** 3, jnp.float32),
        )
        draws = draw(jax.random.key(seed), 5)
        tree = jax.device_get(search(draws, tables, jnp.int32(seed)))
        assert_same(tree, 0, oracle(draws, tables, seed, config))


@pytest.mark.parametrize(
    ("num_iterations", "visits", "scale"),
    [(4, (3, 1), 1.0), (5, (3, 2), 1e-4), (8, (5, 3), 1e-4)],
)
def test_visits_by_hand(num_iterations, visits, scale):
    # horizon 1: UCB-1 on two arms that give 1 and 1/2, whatever their unit. After (3, 1) visits, for example,
    # 1 + sqrt(2 ln 4 / 3) = 1.96 < 0.5 + sqrt(2 ln 4) = 2.17, so the worse arm is next
    mcts = make_mcts(2, MCTSConfig(num_iterations=num_iterations, horizon=1))
    tables = Tables(jnp.zeros((1, 1, 2), jnp.int32), scale * jnp.array([[1.0, 0.5]]))
    tree = jax.jit(mcts.search)(mcts.draw(jax.random.key(0), 1), tables, ROOT)
    assert tuple(int(tree.visits[child]) for child in tree.children[0]) == visits


def chain_tables(num_states, flips=()):
    """A chain of forward (0) and backward (1) moves, clamped at its ends, with flip-states."""
    states = np.arange(num_states)
    forward = np.where(np.isin(states, flips), -1, 1)
    moves = np.stack([states + forward, states - forward], axis=1)
    return jnp.asarray(np.clip(moves, 0, num_states - 1), jnp.int32)[None]


def test_the_only_way_to_a_reward_is_taken():
    # from state 4 of 9, horizon 5: only state 8, four steps ahead, gives anything. So the first step must be ahead,
    # which is backward in a flip-state, for every key
    plan = jax.jit(jax.vmap(make_mcts(2, MCTSConfig(num_iterations=60, horizon=5)).plan, in_axes=(0, None, None)))
    for flips, want in (((), 0), ((4,), 1), ((5, 6), 0)):
        tables = Tables(chain_tables(9, flips), jnp.zeros((9, 2)).at[8].set(1.0))
        actions, metrics = plan(jax.random.split(jax.random.key(0), 50), tables, jnp.int32(4))
        assert actions.tolist() == [want] * 50
        # A mean over returns of 0 and 1; the tree is no deeper than the horizon.
        assert np.all((metrics["value"] > 0) & (metrics["value"] < 1)) and int(metrics["depth"].max()) == 5


@pytest.mark.parametrize("discount", [1.0, 0.5])
def test_constant_reward_is_summed_to_the_horizon(discount):
    # utility 1 everywhere, horizon 49: every return is the sum of discount^t, 49 or 2
    tables = Tables(chain_tables(9), jnp.ones((9, 2)))
    plan = make_mcts(2, MCTSConfig(discount=discount)).plan
    _, metrics = plan(jax.random.key(0), tables, jnp.int32(3))
    assert float(metrics["value"]) == pytest.approx(sum(discount**t for t in range(49)), rel=1e-5)


def test_equal_actions_are_tied_at_random():
    # no utility at all: of 200 actions half are each, within 5 standard deviations
    tables = Tables(chain_tables(9), jnp.zeros((9, 2)))
    plan = make_mcts(2, MCTSConfig(num_iterations=4, horizon=3)).plan
    actions, _ = jax.vmap(plan, in_axes=(0, None, None))(jax.random.split(jax.random.key(1), 200), tables, jnp.int32(3))
    assert abs(float(jnp.mean(actions)) - 0.5) < 5 * 0.5 / math.sqrt(200)


@pytest.mark.parametrize("limit", [1, 2, 10, 192])
def test_integers_cut_out_of_words_are_uniform_and_independent(limit):
    # chi-squared of the values, and of numbers that may come of one word: these lie a quarter apart, or a half, ...
    shape = (6, 10, 130)
    drawn = np.asarray(small_integers(jax.random.key(0), shape, limit))
    assert drawn.shape == shape and drawn.dtype == np.int32 and 0 <= drawn.min() <= drawn.max() < limit
    values = drawn.ravel()
    if limit > 1:
        assert stats.chisquare(np.bincount(values, minlength=limit)).pvalue > 1e-3
        high = values >= limit / 2
        for apart in (1, *(len(high) // parts for parts in range(2, 19))):
            table = np.histogram2d(high[:-apart], high[apart:], 2)[0]
            assert stats.chi2_contingency(table).pvalue > 1e-4


def test_a_random_model_moves_each_edge_and_each_step():
    # model 0 leads to state 1, model 1 to state 2: over 400 edges, and over trajectories from state 0, half and half
    ahead = jnp.stack([jnp.full((3, 2), 1), jnp.full((3, 2), 2)]).astype(jnp.int32)
    tables = Tables(ahead, jnp.zeros((3, 2)).at[1].set(1.0))
    mcts = make_mcts(2, MCTSConfig(num_iterations=2, horizon=11, num_trajectories=20))
    search = jax.vmap(lambda key: mcts.search(mcts.draw(key, 2), tables, ROOT))
    trees = search(jax.random.split(jax.random.key(2), 200))
    first = np.asarray(trees.state)[:, 1:].ravel()
    assert set(first) == {1, 2} and abs(np.mean(first == 1) - 0.5) < 5 * 0.5 / math.sqrt(400)
    # The edge gives 0, the child's first step 1 in state 1, and each of nine further steps 1 with probability 1/2.
    value = np.asarray(trees.total)[:, 1:].ravel()
    assert np.mean(value - (first == 1)) == pytest.approx(4.5, abs=5 * math.sqrt(9 / 4 / 20 / 400))


def test_plan_is_traced_once_and_batched_by_vmap():
    # other tables, roots and keys are the same program; vmap over all three gives the numbers of a loop
    traces = []
    mcts = make_mcts(2, MCTSConfig(num_iterations=10, horizon=6))

    @jax.jit
    def plan(key, tables, root):
        traces.append(1)
        return mcts.plan(key, tables, root)

    rng = np.random.default_rng(0)
    tables = Tables(
        jnp.asarray(rng.integers(0, 7, (4, 5, 7, 2)), jnp.int32), jnp.asarray(rng.uniform(size=(4, 7, 2)), jnp.float32)
    )
    keys, roots = jax.random.split(jax.random.key(0), 4), jnp.arange(4, dtype=jnp.int32)
    alone = [plan(keys[i], jax.tree.map(lambda leaf, i=i: leaf[i], tables), roots[i]) for i in range(4)]
    assert len(traces) == 1
    actions, metrics = jax.vmap(mcts.plan)(keys, tables, roots)
    assert actions.tolist() == [int(action) for action, _ in alone]
    np.testing.assert_allclose(metrics["value"], [float(seen["value"]) for _, seen in alone], rtol=1e-5)


def test_bad_settings_are_refused():
    # the field, the value, and what is allowed
    with pytest.raises(ValueError, match=r"MCTSConfig\.num_trajectories=0 .*1 or more"):
        MCTSConfig(num_trajectories=0)
    with pytest.raises(ValueError, match=r"MCTSConfig\.discount=1\.1 .*\[0, 1\]"):
        MCTSConfig(discount=1.1)
    with pytest.raises(ValueError, match=r"MCTSConfig\.model_step='argmax' .*Did you mean 'arg_max'"):
        MCTSConfig(model_step="argmax")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"num_iterations=3 leaves actions untried\. Allowed: at least 4"):
        make_mcts(4, MCTSConfig(num_iterations=3))
