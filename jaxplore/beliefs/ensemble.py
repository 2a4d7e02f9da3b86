"""Static ensembles as beliefs: networks with parameters of their own, each trained on its own minibatches.

Deterministic networks with squared error are the models of Disagreement (Pathak et al. 2019) and ICM as Ratzlaff et
al. (2020) run them; Gaussian ones, which state a variance beside the mean, are those of MAX (Shyam et al. 2019,
nnaisense/max). Members differ by where they start, by the batches they draw and, if wanted, by a bootstrap.
"""

import itertools
import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, NamedTuple, TypeAlias, get_args

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxplore import dynamics, networks, validate
from jaxplore.beliefs.base import Belief, FitConfig, make_optimizer
from jaxplore.dynamics import ENCODINGS, LOG_VAR_BOUNDS, DynamicsConfig, Encoding, Normalizers, Prediction
from jaxplore.networks import MLP
from jaxplore.replay import Replay
from jaxplore.types import Array, Key, Metrics, Params, Transition
from jaxplore.validate import Checks, FieldError

Bootstrap: TypeAlias = Literal["none", "poisson", "multinomial"]

_BOOTSTRAP_SEED = 1
"""Weights must outlive a belief that is re-initialised each round, so they follow from this, not from its state."""

_POISSON_CDF = tuple(itertools.accumulate(math.exp(-1.0) / math.factorial(count) for count in range(8)))
"""Probabilities that a Poisson count of mean 1 is at most 0, 1, ..., 7; an eighth comes once in 100,000."""


@dataclass(frozen=True)
class EnsembleConfig:
    """How many members a static ensemble has, and what they differ by apart from initialisation and batches."""

    bootstrap: Bootstrap = "none"
    """Weights of transitions, fixed for each member and transition from the transition's arrival on. `none`: 1
    (nnaisense/max). `poisson`: independent Poisson counts of mean 1. `multinomial`: as many copies as there are
    members, each copy given to a random member."""
    bootstrap_std: float = 1.0
    """Standard deviation of those weights, in (0, 1]: below 1 a member is also fitted to what it was not given."""
    num_members: int = 32
    """M, static networks; all of them are drawn for a round. Paper: 32."""

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.at_least("num_members", 1)
        checks.one_of("bootstrap", get_args(Bootstrap))
        checks.in_range("bootstrap_std", 0.0, 1.0, open_low=True)


@struct.dataclass
class EnsembleState:
    """What a static ensemble carries; every leaf has a leading axis `M`."""

    params: Params
    opt_state: optax.OptState


def bootstrap_weights(kind: Bootstrap, num_members: int, index: Array, std: float = 1.0) -> Array:
    """The weight that each member gives to the transitions it looks at.

    A function of the member and of the transition's place in the replay, which it keeps as long as it is there: so
    weights are fixed though nothing is stored. Their mean is 1.

    Args:
        kind: see `EnsembleConfig.bootstrap`.
        num_members: `M`.
        index: places in the replay, int `[M, B]`; row i is of member i.
        std: see `EnsembleConfig.bootstrap_std`.

    Returns:
        `[M, B]`, at least 0; whole numbers where `std` is 1.

    Example:
        >>> import jax.numpy as jnp
        >>> everyone = jnp.tile(jnp.arange(100)[None], (8, 1))
        >>> bool((bootstrap_weights("multinomial", 8, everyone).sum(axis=0) == 8).all())
        True
    """
    return jax.vmap(partial(member_weights, kind, num_members, std=std))(jnp.arange(num_members), index)


def member_weights(kind: Bootstrap, num_members: int, member: int | Array, index: Array, std: float = 1.0) -> Array:
    """`bootstrap_weights` of one member of `num_members`, for places of any shape, in that shape."""
    if kind == "none":
        return jnp.ones(index.shape)
    base = jax.random.key(_BOOTSTRAP_SEED)

    def poisson(place: Array) -> Array:
        uniform = jax.random.uniform(jax.random.fold_in(jax.random.fold_in(base, place), member))
        return jnp.sum(uniform >= jnp.array(_POISSON_CDF))

    def multinomial(place: Array) -> Array:
        return jnp.sum(jax.random.randint(jax.random.fold_in(base, place), (num_members,), 0, num_members) == member)

    weights = jax.vmap(poisson if kind == "poisson" else multinomial)(index.reshape(-1))
    return 1.0 + std * (weights.reshape(index.shape).astype(jnp.float32) - 1.0)


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


class EnsembleSpec(NamedTuple):
    """The fixed parts of a static ensemble, which its functions take first; `make_spec` builds them."""

    network: MLP
    """Architecture of a member, `[..., O + A] -> [..., O]`, or `[..., 2 O]` where it is Gaussian."""
    optimizer: optax.GradientTransformation
    """Of one member."""
    encoding: Encoding
    gaussian: bool
    """Whether members also state a variance."""
    input_size: int
    """`O + A`"""
    config: EnsembleConfig
    batch_size: int
    """Transitions per member and update, `B`."""


def make_spec(
    obs_size: int,
    action_size: int,
    *,
    gaussian: bool,
    dynamics_config: DynamicsConfig,
    ensemble_config: EnsembleConfig,
    fit_config: FitConfig,
) -> EnsembleSpec:
    """The network, the optimiser and the encoding that the configurations describe.

    Raises:
        ValueError: a size below 1, or Gaussian members that are to predict probabilities.
    """
    validate.sizes(obs_size=obs_size, action_size=action_size)
    if gaussian and dynamics_config.target == "one_hot":
        problem = "does not fit DynamicsConfig.target='one_hot': probabilities have no variance of their own"
        raise FieldError("gaussian", gaussian, "'delta'", problem)
    network = dynamics.make_network(dynamics_config, obs_size)
    if gaussian:
        network = MLP(dynamics_config.hidden, 2 * obs_size, dynamics_config.activation, "xavier", "xavier_normal")
    return EnsembleSpec(
        network=network,
        optimizer=make_optimizer(fit_config),
        encoding=ENCODINGS[dynamics_config.target],
        gaussian=gaussian,
        input_size=obs_size + action_size,
        config=ensemble_config,
        batch_size=fit_config.batch_size,
    )


def init(spec: EnsembleSpec, key: Key) -> EnsembleState:
    """A state with freshly initialised members; see `Belief.init`."""
    keys = jax.random.split(key, spec.config.num_members)
    params = jax.vmap(lambda one: spec.network.init(one, jnp.zeros(spec.input_size))["params"])(keys)
    return EnsembleState(params, jax.vmap(spec.optimizer.init)(params))


def loss(spec: EnsembleSpec, params: Params, inputs: Array, targets: Array, weights: Array) -> tuple[Array, Array]:
    """Loss of one member on `inputs [B, O + A]`, `targets [B, O]` with `weights [B]`.

    Returns:
        `(loss, squared error)`, scalars; the error is not weighted.
    """
    last = networks.apply(spec.network, params, inputs)
    if spec.gaussian:
        mean, log_var = gaussian_head(last)
        errors = gaussian_nll(mean, log_var, targets)
    else:
        mean = spec.encoding.outputs(last)
        errors = (mean - targets) ** 2
    return jnp.mean(weights * jnp.mean(errors, axis=-1)), jnp.mean((mean - targets) ** 2)


def train_member(
    spec: EnsembleSpec, params: Params, opt_state: optax.OptState, inputs: Array, targets: Array, weights: Array
) -> tuple[Params, optax.OptState, Array, Array]:
    """One gradient step of one member on its own batch, as in `loss`.

    Returns:
        `(params, opt_state, loss, squared error)`, the latter two from before the step.
    """
    compute = jax.value_and_grad(partial(loss, spec), has_aux=True)
    (value, squared_error), gradient = compute(params, inputs, targets, weights)
    steps, opt_state = spec.optimizer.update(gradient, opt_state, params)
    return optax.apply_updates(params, steps), opt_state, value, squared_error


def update(
    spec: EnsembleSpec, key: Key, state: EnsembleState, data: Replay[Transition], normalizers: Normalizers
) -> tuple[EnsembleState, Metrics]:
    """One gradient step of every member, each on a batch of its own; see `Belief.update`."""
    num_members, encoding = spec.config.num_members, spec.encoding
    index = jax.random.randint(key, (num_members, spec.batch_size), 0, jnp.maximum(data.size, 1))
    rows = jax.tree.map(lambda leaf: leaf[index], data.rows)
    inputs = encoding.inputs(normalizers, rows.obs, rows.action)
    targets = encoding.targets(normalizers, rows.obs, rows.next_obs)
    weights = bootstrap_weights(spec.config.bootstrap, num_members, index, spec.config.bootstrap_std)
    train = jax.vmap(partial(train_member, spec))
    params, opt_state, losses, errors = train(state.params, state.opt_state, inputs, targets, weights)
    metrics = {"loss": jnp.mean(losses), "squared_error": jnp.mean(errors)}
    return EnsembleState(params, opt_state), metrics


def sample(spec: EnsembleSpec, key: Key, state: EnsembleState, num: int) -> Params:
    """`num` of the members, all of them or drawn without replacement; see `Belief.sample`.

    Raises:
        ValueError: fewer than one, or more than there are.
    """
    num_members = spec.config.num_members
    if not 1 <= num <= num_members:
        problem = f"models cannot be drawn from {num_members} members"
        raise FieldError("num", num, f"1 to {num_members}", problem)
    if num == num_members:
        return state.params
    chosen = jax.random.choice(key, num_members, (num,), replace=False)
    return jax.tree.map(lambda leaf: leaf[chosen], state.params)


def predict(spec: EnsembleSpec, models: Params, inputs: Array) -> Prediction:
    """Predictions `[M, N, O]` of the members `models` for `inputs [N, O + A]`; see `Belief.predict`."""
    validate.shape("inputs", inputs, "N", spec.input_size)
    last = jax.vmap(lambda params: networks.apply(spec.network, params, inputs))(models)
    if not spec.gaussian:
        return Prediction(spec.encoding.outputs(last))
    mean, log_var = gaussian_head(last)
    return Prediction(mean, jnp.exp(log_var))


def make_ensemble_belief(
    obs_size: int,
    action_size: int,
    num_members: int | None = None,
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
        num_members: `M`; the ensemble configuration's by default.
        gaussian: whether members also state a variance. Their weights start Xavier-uniform and, in the last layer,
            Xavier-normal, as in nnaisense/max; those of deterministic members as in `dynamics.make_network`.
        dynamics_config: shape of a network.
        ensemble_config: number of members and bootstrap.
        fit_config: batch size and optimiser.

    Returns:
        A `Belief`. `sample` gives the members, all of them or as many as asked for, drawn without replacement. The
        metrics are `loss` and `squared_error`, means over members and batch.

    Raises:
        ValueError: a size below 1, or fewer than one member; Gaussian members that are to predict probabilities; at
            `sample`, more models than there are members.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> belief = make_ensemble_belief(3, 1, 5, gaussian=True, dynamics_config=DynamicsConfig(hidden=(16,)))
        >>> models = belief.sample(jax.random.key(1), belief.init(jax.random.key(0)), 5)
        >>> prediction = belief.predict(models, jnp.zeros((7, 4)))
        >>> prediction.mean.shape, prediction.var.shape
        ((5, 7, 3), (5, 7, 3))
    """
    ensemble_config = ensemble_config or EnsembleConfig()
    if num_members is not None:
        validate.at_least("num_members", num_members, 1)
        ensemble_config = replace(ensemble_config, num_members=num_members)
    fit_config = fit_config or FitConfig()
    spec = make_spec(
        obs_size,
        action_size,
        gaussian=gaussian,
        dynamics_config=dynamics_config or DynamicsConfig(),
        ensemble_config=ensemble_config,
        fit_config=fit_config,
    )
    return Belief(
        init=jax.jit(partial(init, spec)),
        update=partial(update, spec),
        sample=partial(sample, spec),
        predict=partial(predict, spec),
        encoding=spec.encoding,
        num_models=ensemble_config.num_members,
        fit_config=fit_config,
    )
