"""Static ensembles as beliefs: networks with parameters of their own, each trained on its own minibatches.

Deterministic networks with squared error are the models of Disagreement (Pathak et al. 2019) and ICM as Ratzlaff et
al. (2020) run them; Gaussian ones, which state a variance beside the mean, are those of MAX (Shyam et al. 2019,
nnaisense/max). Members differ by where they start, by the batches they draw and, if wanted, by a bootstrap.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxplore import dynamics, networks, validate
from jaxplore.beliefs import Belief, FitConfig, make_optimizer
from jaxplore.dynamics import ENCODINGS, LOG_VAR_BOUNDS, DynamicsConfig, Normalizers, Prediction
from jaxplore.networks import MLP
from jaxplore.replay import Replay
from jaxplore.types import Array, Key, Metrics, Params, Transition
from jaxplore.validate import Checks

Bootstrap: TypeAlias = Literal["none", "poisson", "multinomial"]

_BOOTSTRAP_SEED = 1
"""Weights must outlive a belief that is made anew each round, so they follow from this, not from its state."""

_POISSON_CDF = tuple(itertools.accumulate(math.exp(-1.0) / math.factorial(count) for count in range(8)))
"""Probabilities that a Poisson count of mean 1 is at most 0, 1, ..., 7; an eighth comes once in 100,000."""


@dataclass(frozen=True)
class EnsembleConfig:
    """What the members of a static ensemble differ by, apart from where they start and which batches they draw."""

    bootstrap: Bootstrap = "none"
    """Weights of transitions, fixed for each member and transition from the transition's arrival on. `none`: 1
    (nnaisense/max). `poisson`: independent Poisson counts of mean 1. `multinomial`: as many copies as there are
    members, each copy given to a random member."""

    def __post_init__(self) -> None:
        Checks(self).one_of("bootstrap", get_args(Bootstrap))


@struct.dataclass
class EnsembleState:
    """What a static ensemble carries; every leaf has a leading axis `M`."""

    params: Params
    opt_state: optax.OptState


def bootstrap_weights(kind: Bootstrap, num_members: int, index: Array) -> Array:
    """The weight that each member gives to the transitions it looks at.

    A function of the member and of the transition's place in the replay, which it keeps as long as it is there: so
    weights are fixed though nothing is stored. Their mean is 1.

    Args:
        kind: see `EnsembleConfig.bootstrap`.
        num_members: `M`.
        index: places in the replay, int `[M, B]`; row i is of member i.

    Returns:
        `[M, B]`, whole numbers of at least 0.

    Example:
        >>> import jax.numpy as jnp
        >>> everyone = jnp.tile(jnp.arange(100)[None], (8, 1))
        >>> bool((bootstrap_weights("multinomial", 8, everyone).sum(axis=0) == 8).all())
        True
    """
    if kind == "none":
        return jnp.ones(index.shape)
    members = jnp.broadcast_to(jnp.arange(num_members)[:, None], index.shape)
    base = jax.random.key(_BOOTSTRAP_SEED)

    def poisson(member: Array, place: Array) -> Array:
        uniform = jax.random.uniform(jax.random.fold_in(jax.random.fold_in(base, place), member))
        return jnp.sum(uniform >= jnp.array(_POISSON_CDF))

    def multinomial(member: Array, place: Array) -> Array:
        return jnp.sum(jax.random.randint(jax.random.fold_in(base, place), (num_members,), 0, num_members) == member)

    weight = poisson if kind == "poisson" else multinomial
    return jax.vmap(jax.vmap(weight))(members, index).astype(jnp.float32)


def gaussian_head(last: Array) -> tuple[Array, Array]:
    """`(mean, log_var)`, each `[..., O]`, of a Gaussian network's last layer `[..., 2 O]`.

    The log variance is a smooth function of its half of the layer that stays within `dynamics.LOG_VAR_BOUNDS`.
    """
    mean, raw = jnp.split(last, 2, axis=-1)
    low, high = LOG_VAR_BOUNDS
    return mean, low + (high - low) * jax.nn.sigmoid(raw)


def gaussian_nll(mean: Array, log_var: Array, target: Array) -> Array:
    """`(mean - target)^2 / var + log var` of each entry: twice its negative log-likelihood, less log(2 pi)."""
    return (mean - target) ** 2 * jnp.exp(-log_var) + log_var


def make_ensemble_belief(
    obs_size: int,
    action_size: int,
    num_members: int,
    *,
    gaussian: bool = False,
    dynamics_config: DynamicsConfig | None = None,
    ensemble_config: EnsembleConfig | None = None,
    fit_config: FitConfig | None = None,
) -> Belief:
    """A static ensemble of dynamics networks.

    Each member minimises the mean of its own loss over a batch that it draws uniformly, with its own gradient clipping,
    weight decay and Adam: it is the network that would have come of training alone. The loss is the squared error, or
    for Gaussian members `gaussian_nll`, averaged over entries.

    Args:
        obs_size: `O`.
        action_size: `A`.
        num_members: `M`.
        gaussian: whether members also state a variance. Their weights start Xavier-uniform and, in the last layer,
            Xavier-normal, as in nnaisense/max; those of deterministic members as `dynamics.make_network` says.
        dynamics_config: shape of a network.
        ensemble_config: the bootstrap.
        fit_config: batch size and optimiser.

    Returns:
        A `Belief`. `sample` gives the members, all of them or as many as asked for, drawn without replacement. The
        metrics are `loss` and `squared_error`, means over members and batch.

    Raises:
        ValueError: fewer than one member; Gaussian members that are to predict probabilities; at `sample`, more models
            than there are members.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> belief = make_ensemble_belief(3, 1, 5, gaussian=True, dynamics_config=DynamicsConfig(hidden=(16,)))
        >>> models = belief.sample(jax.random.key(1), belief.init(jax.random.key(0)), 5)
        >>> prediction = belief.predict(models, jnp.zeros((7, 4)))
        >>> prediction.mean.shape, prediction.var.shape
        ((5, 7, 3), (5, 7, 3))
    """
    validate.at_least("num_members", num_members, 1)
    dynamics_config = dynamics_config or DynamicsConfig()
    ensemble_config = ensemble_config or EnsembleConfig()
    fit_config = fit_config or FitConfig()
    if gaussian and dynamics_config.target == "one_hot":
        raise ValueError(
            "gaussian=True does not fit DynamicsConfig.target='one_hot': probabilities have no variance of their own. "
            "Allowed: 'delta'."
        )
    encoding = ENCODINGS[dynamics_config.target]
    network = dynamics.make_network(dynamics_config, obs_size)
    if gaussian:
        network = MLP(dynamics_config.hidden, 2 * obs_size, dynamics_config.activation, "xavier", "xavier_normal")
    optimizer = make_optimizer(fit_config)

    @jax.jit
    def init(key: Key) -> EnsembleState:
        def one(key: Key) -> Params:
            return network.init(key, jnp.zeros(obs_size + action_size))["params"]

        params = jax.vmap(one)(jax.random.split(key, num_members))
        return EnsembleState(params, jax.vmap(optimizer.init)(params))

    def loss(params: Params, inputs: Array, targets: Array, weights: Array) -> tuple[Array, Array]:
        last = networks.apply(network, params, inputs)
        if gaussian:
            mean, log_var = gaussian_head(last)
            errors = gaussian_nll(mean, log_var, targets)
        else:
            mean = encoding.outputs(last)
            errors = (mean - targets) ** 2
        return jnp.mean(weights * jnp.mean(errors, axis=-1)), jnp.mean((mean - targets) ** 2)

    def train(
        params: Params, opt_state: optax.OptState, inputs: Array, targets: Array, weights: Array
    ) -> tuple[Params, optax.OptState, Array, Array]:
        """One gradient step of one member."""
        (value, squared_error), gradient = jax.value_and_grad(loss, has_aux=True)(params, inputs, targets, weights)
        steps, opt_state = optimizer.update(gradient, opt_state, params)
        return optax.apply_updates(params, steps), opt_state, value, squared_error

    def update(
        key: Key, state: EnsembleState, data: Replay[Transition], normalizers: Normalizers
    ) -> tuple[EnsembleState, Metrics]:
        index = jax.random.randint(key, (num_members, fit_config.batch_size), 0, jnp.maximum(data.size, 1))
        rows = jax.tree.map(lambda leaf: leaf[index], data.rows)
        inputs = encoding.inputs(normalizers, rows.obs, rows.action)
        targets = encoding.targets(normalizers, rows.obs, rows.next_obs)
        weights = bootstrap_weights(ensemble_config.bootstrap, num_members, index)
        params, opt_state, losses, errors = jax.vmap(train)(state.params, state.opt_state, inputs, targets, weights)
        metrics = {"loss": jnp.mean(losses), "squared_error": jnp.mean(errors)}
        return EnsembleState(params, opt_state), metrics

    def sample(key: Key, state: EnsembleState, num: int) -> Params:
        if not 1 <= num <= num_members:
            raise ValueError(
                f"num={num} models cannot be drawn from {num_members} members. Allowed: 1 to {num_members}."
            )
        if num == num_members:
            return state.params
        chosen = jax.random.choice(key, num_members, (num,), replace=False)
        return jax.tree.map(lambda leaf: leaf[chosen], state.params)

    def predict(models: Params, inputs: Array) -> Prediction:
        last = jax.vmap(lambda params: networks.apply(network, params, inputs))(models)
        if not gaussian:
            return Prediction(encoding.outputs(last))
        mean, log_var = gaussian_head(last)
        return Prediction(mean, jnp.exp(log_var))

    return Belief(init, update, sample, predict, encoding)
