"""Models of finitely many states, and planning in them: with a belief whose every answer is known, and the real one."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxplore import dynamics, replay, rewards
from jaxplore.behaviours import Experience
from jaxplore.behaviours.mcts import MCTSConfig
from jaxplore.behaviours.tree_search import DRAWS_PER_MODEL, make_tree_search
from jaxplore.beliefs import Belief, FitConfig, make_generator_belief
from jaxplore.beliefs.generator import GeneratorConfig
from jaxplore.beliefs.svgd import SVGDConfig
from jaxplore.config import ExplorationConfig, Sizes
from jaxplore.dynamics import ONE_HOT, DynamicsConfig, Prediction
from jaxplore.exploration import make_explorer
from jaxplore.methods import METHODS
from jaxplore.signals import Reward, make_belief_signal
from jaxplore.types import Transition
from tests.jaxplore import programs

NUM_STATES, NUM_ACTIONS, NUM_MODELS = 4, 2, 3
SIZES = Sizes(NUM_STATES, NUM_ACTIONS, discrete=True, one_hot_obs=True)
NORMALIZERS = dynamics.init_normalizers(NUM_STATES, NUM_ACTIONS)


def chain(num_states=NUM_STATES):
    """All transitions of a chain without flips: `(obs, action, next_obs)`, one-hot, states first."""
    states, actions = np.divmod(np.arange(2 * num_states), 2)
    after = np.clip(states + np.where(actions == 0, 1, -1), 0, num_states - 1)
    return [np.eye(n, dtype=np.float32)[i] for n, i in ((num_states, states), (2, actions), (num_states, after))]


def known_belief(models_agree_in):
    """Three models that know the chain in the states of `models_agree_in`; elsewhere model k says state k, surely.

    Only their first answer to `[obs, action]` is kept: no parameters, nothing to learn.
    """
    obs, action, after = chain()
    pairs, after = jnp.asarray(np.hstack([obs, action])), jnp.asarray(after)

    def predict(models, inputs):
        row = jnp.argmax(inputs @ pairs.T, axis=1)
        known = jnp.isin(jnp.argmax(inputs[:, :NUM_STATES], axis=1), jnp.asarray(models_agree_in))[None, :, None]
        own = jnp.broadcast_to(jnp.eye(NUM_STATES)[models][:, None], (NUM_MODELS, len(inputs), NUM_STATES))
        return Prediction(jnp.where(known, after[row][None], own))

    return Belief(lambda key: (), lambda key, state, *rest: (state, {}), lambda *args: (), predict, ONE_HOT, NUM_MODELS)


def experience(models):
    flag = jnp.zeros((), bool)
    row = Transition(jnp.zeros(NUM_STATES), jnp.zeros(NUM_ACTIONS), jnp.zeros(()), jnp.zeros(NUM_STATES), flag, flag)
    return Experience(models, replay.init(row, 8), jnp.int32(0), NORMALIZERS, jnp.eye(NUM_STATES)[1])


def variance_of(belief):
    reward = Reward(lambda prediction, delta, normalizers: rewards.variance(prediction), "probability, squared")
    return make_belief_signal(belief, reward)


def improved(belief, models=None, **config):
    """`(behaviour, state, metrics)` after a round."""
    behaviour = make_tree_search(variance_of(belief), NUM_STATES, NUM_ACTIONS, MCTSConfig(**config))
    one_round = jax.jit(lambda key, models: behaviour.improve(key, behaviour.init(key), experience(models)))
    return behaviour, *one_round(jax.random.key(0), np.arange(NUM_MODELS) if models is None else models)


def test_tables_hold_what_the_models_say():
    # states 0 to 2 are known: their chain moves and utility 0. In state 3 three sure models differ: each of three
    # outputs has variance 1/3 - 1/9, in all 2/3
    _, state, metrics = improved(known_belief([0, 1, 2]))
    moves = np.array([[1, 0], [2, 0], [3, 1]])
    np.testing.assert_array_equal(state.next_state[:, :3], np.broadcast_to(moves, (NUM_MODELS, 3, 2)))
    np.testing.assert_array_equal(state.next_state[:, 3], [[0, 0], [1, 1], [2, 2]])
    np.testing.assert_allclose(state.utility, [[0, 0], [0, 0], [0, 0], [2 / 3, 2 / 3]], atol=1e-6)
    assert {name: float(value) for name, value in metrics.items()} == pytest.approx(
        {"utility": 1 / 6, "utility_max": 2 / 3, "agreement": 0.75}
    )


def test_identical_models_leave_nothing_to_explore():
    # three times model 2: variance 0 everywhere, all agree
    _, state, metrics = improved(known_belief([]), models=np.full(3, 2))
    np.testing.assert_array_equal(state.utility, np.zeros((NUM_STATES, NUM_ACTIONS)))
    assert float(metrics["agreement"]) == 1.0


def test_it_goes_where_the_models_differ():
    # they differ in state 3 alone: from 0, 1 and 2 it is straight ahead, action 0, within 3 steps; any leading axes
    behaviour, state, _ = improved(known_belief([0, 1, 2]), horizon=4, num_iterations=40)
    obs = np.tile(np.eye(NUM_STATES, dtype=np.float32)[:3], (5, 1, 1))
    actions = jax.jit(behaviour.act)(jax.random.key(1), behaviour.actor(state), NORMALIZERS, obs)
    np.testing.assert_array_equal(actions, np.tile([1.0, 0.0], (5, 3, 1)))


def test_sampled_models_go_by_their_probabilities():
    # one model whose answer is (1/2, 1/4, 1/4, 0) everywhere, asked at 8 pairs, 3 times over: multinomial counts
    chance = jnp.array([0.5, 0.25, 0.25, 0.0])
    predict = lambda models, inputs: Prediction(jnp.tile(chance, (NUM_MODELS, len(inputs), 1)))  # noqa: E731
    _, state, _ = improved(known_belief([])._replace(predict=predict), model_step="sample")
    drawn = np.asarray(state.next_state)
    assert drawn.shape == (DRAWS_PER_MODEL * NUM_MODELS, NUM_STATES, NUM_ACTIONS)
    share = np.bincount(drawn.ravel(), minlength=4) / drawn.size
    np.testing.assert_allclose(share, chance, atol=5 * 0.5 / np.sqrt(drawn.size))
    assert share[3] == 0.0


@pytest.fixture(scope="module")
def fitted():
    """Sixteen generators of networks, each after 800 updates of its own on a chain of 4, forward in all states and
    backward in the first 3; so one pair of 8 is not in the data. What 50 networks of each say: `[16, 50, 8, 4]`.
    """
    obs, action, after = (leaf[:7] for leaf in chain())
    flags, zeros = np.zeros(7, bool), np.zeros(7, np.float32)
    belief = make_generator_belief(
        NUM_STATES,
        NUM_ACTIONS,
        DynamicsConfig(hidden=(32,), activation="tanh", target="one_hot"),
        GeneratorConfig(noise_size=8, hidden=(16,)),
        SVGDConfig(num_particles=5),
        FitConfig(lr=5e-3, weight_decay=0.0, batch_size=14),
    )
    predict = belief.predict
    assert predict is not None
    row = Transition(obs[0], action[0], zeros[0], obs[0], flags[0], flags[0])
    data = jax.jit(lambda row, rows: replay.add(replay.init(row, 8), rows))(
        row, Transition(obs, action, zeros, after, flags, flags)
    )
    pairs = jnp.asarray(np.hstack(chain()[:2]))

    @programs.compiled
    @jax.vmap
    def answers(key):
        def update(i, state):
            return belief.update(jax.random.fold_in(key, i), state, data, NORMALIZERS)[0]

        state = jax.lax.fori_loop(0, 800, update, belief.init(key))
        return predict(belief.sample(jax.random.fold_in(key, 800), state, 50), pairs).mean

    return jax.device_get(answers(jax.random.split(jax.random.key(0), 16)))


def variances(fitted):
    """Of each generator and pair, `[16, 8]`."""
    return np.asarray(jax.jit(jax.vmap(lambda means: rewards.variance(Prediction(means))))(fitted))


def test_predictions_are_probabilities(fitted):
    # over states they sum to one, none is negative, and the variance of such is below 1
    np.testing.assert_allclose(np.sum(fitted, axis=-1), 1.0, rtol=1e-5)
    assert np.min(fitted) >= 0.0
    assert np.max(variances(fitted)) < 1.0


def test_fit_learns_the_chain_and_is_least_sure_of_what_it_has_not_seen(fitted):
    # nearly all networks put the 7 pairs in the data where they belong (chance is 0.25); the eighth has the largest
    # variance. Means over 16 generators: of a single one either hangs on rounding, so on the CPU
    _, _, after = chain()
    likely = np.asarray(ONE_HOT.next_obs(NORMALIZERS, np.zeros(()), fitted[:, :, :7]))
    assert np.mean(np.sum(likely * after[None, None, :7], axis=-1)) > 0.95
    spread = np.mean(variances(fitted), axis=0)
    assert np.argmax(spread) == 7 and spread[7] > 3 * spread[:7].mean()


def test_a_network_that_is_sure_and_wrong_learns_by_cross_entropy():
    # logits 20 above all others for the wrong one of 40 states: squared error's own gradient is 1e-7 and less; that of
    # 0.5 |y - p|^2 through `outputs` is p - y, which cross-entropy has
    @jax.jit
    def gradients(logits, target):
        def squared_error(outputs):
            return jax.grad(lambda last: 0.5 * jnp.sum((outputs(last) - target) ** 2))(logits)

        cross_entropy = jax.grad(lambda last: -jnp.sum(target * jax.nn.log_softmax(last)))(logits)
        return squared_error(jax.nn.softmax), squared_error(ONE_HOT.outputs), cross_entropy

    logits, target = np.full(40, -10.0, np.float32), np.eye(40, dtype=np.float32)[5]
    logits[3] = 10.0
    plain, ours, cross_entropy = gradients(logits, target)
    assert np.max(np.abs(plain)) < 1e-6
    np.testing.assert_allclose(ours, cross_entropy, atol=1e-6)
    np.testing.assert_array_equal(ONE_HOT.outputs(logits), jax.nn.softmax(logits))


SMALL = ExplorationConfig(
    data_capacity=16,
    steps_per_round=1,
    planner="mcts",
    dynamics=DynamicsConfig(hidden=(8,), activation="tanh", target="one_hot"),
    generator=GeneratorConfig(noise_size=4, hidden=(8,)),
    svgd=SVGDConfig(num_particles=3),
    fit=FitConfig(batch_size=4, epochs=0, steps=2, restart=False),
    mcts=MCTSConfig(num_iterations=4, horizon=3),
)


def test_warm_up_and_the_random_method_choose_uniformly():
    # one-hot, each choice half of the time, within 5 standard deviations of 1,000
    explorer = make_explorer(METHODS["random"], SIZES, SMALL)
    actor = explorer.actor(explorer.init(jax.random.key(0)))
    obs = np.tile(np.eye(NUM_STATES, dtype=np.float32)[1], (1000, 1))
    act, act_uniformly = jax.jit(explorer.act), jax.jit(explorer.act_uniformly)
    for actions in (act(jax.random.key(1), actor, obs), act_uniformly(jax.random.key(2), obs)):
        actions = np.asarray(actions)
        assert np.array_equal(np.sort(actions, axis=1), np.tile([0.0, 1.0], (1000, 1)))
        assert abs(np.mean(actions[:, 0]) - 0.5) < 5 * 0.5 / np.sqrt(1000)


def test_what_does_not_fit_is_refused():
    # the field, its value, and what is allowed
    implicit, numbers = METHODS["implicit"], Sizes(3, 2)
    with pytest.raises(ValueError, match=r"planner='sac' .*one of 2 choices.*Allowed: planner='mcts'"):
        make_explorer(implicit, SIZES, dataclasses.replace(SMALL, planner="sac"))
    delta = dataclasses.replace(SMALL, dynamics=DynamicsConfig())
    for sizes in (numbers, numbers._replace(discrete=True), numbers._replace(one_hot_obs=True)):
        with pytest.raises(ValueError, match=r"planner='mcts' .*Allowed: planner='sac'"):
            make_explorer(implicit, sizes, delta)
    with pytest.raises(ValueError, match=r"DynamicsConfig\.target='one_hot' .*Allowed: 'delta'"):
        make_explorer(implicit, numbers, SMALL)
    with pytest.raises(ValueError, match=r"reward_units='raw' .*Allowed: 'normalized'"):
        dataclasses.replace(SMALL, reward_units="raw")
    with pytest.raises(ValueError, match=r"ExplorationConfig\.planner='mtcs' .*Did you mean 'mcts'"):
        dataclasses.replace(SMALL, planner="mtcs")
    with pytest.raises(ValueError, match=r"DynamicsConfig\.target='onehot' .*Did you mean 'one_hot'"):
        DynamicsConfig(target="onehot")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"model_step='sample' needs probabilities"):
        make_explorer(implicit, SIZES, dataclasses.replace(delta, mcts=MCTSConfig(model_step="sample")))
    with pytest.raises(ValueError, match="belief predicts nothing, so the signal cannot be imagined"):
        make_explorer(METHODS["rnd"]._replace(behaviour=implicit.behaviour, actions="any"), SIZES, SMALL)
