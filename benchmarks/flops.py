"""How many FLOPs each kernel cannot do without: its matrix products, two FLOPs per multiply-add.

Activations, optimisers, kernels and random numbers are left out: the floor is what a perfect implementation would
still have to pay for.
"""

from itertools import pairwise


def dense(widths: tuple[int, ...]) -> int:
    """Weights of a multi-layer perceptron, input and output widths included."""
    return sum(a * b for a, b in pairwise(widths))


def forward(widths: tuple[int, ...], rows: int) -> int:
    """One pass of `rows` rows."""
    return 2 * rows * dense(widths)


def train(widths: tuple[int, ...], rows: int) -> int:
    """Forward, and backward to the weights; the input's gradient is not needed."""
    return 2 * rows * (3 * dense(widths) - widths[0] * widths[1])


def layer_sizes(widths: tuple[int, ...]) -> list[int]:
    """Weights and biases of each layer."""
    return [(a + 1) * b for a, b in pairwise(widths)]


def svgd_step(target: tuple[int, ...], generator: tuple[int, ...], models: int, batch: int) -> int:
    """One amortised SVGD step: draw the networks, run them on the batch, and go back through both.

    The gradient of the particles with respect to their inputs is not needed, that of the generators with respect to
    the noise neither. `generator` is the noise's size and the hidden widths.
    """
    particles = models * train(target, batch)
    generators = sum(train((*generator, size), models) for size in layer_sizes(target))
    kernel = 2 * 2 * models * models * batch * target[-1] * 2  # Gram matrix, drive and repulsion.
    return particles + generators + kernel


def imagined_step(target: tuple[int, ...], policy: tuple[int, ...], models: int, actors: int) -> int:
    """All models predict all actors once, and the policy acts."""
    return models * forward(target, actors) + forward(policy, actors)


def sac_update(obs: int, action: int, hidden: tuple[int, ...], batch: int) -> int:
    """One update: policy, value, two action values; the action values also pass the policy's gradient back."""
    policy, value, q = (obs, *hidden, 2 * action), (obs, *hidden, 1), (obs + action, *hidden, 1)
    through_q = 2 * forward(q, batch)  # Forward, and backward to the action.
    return train(policy, batch) + train(value, batch) + forward(value, batch) + 2 * (train(q, batch) + through_q)


def sac_v2_update(obs: int, action: int, hidden: tuple[int, ...], batch: int) -> int:
    """One update of SAC's second form, as others have it: a policy and two action values with slow copies, no value.

    The policy runs on both observations, and the slow copies take the value network's place.
    """
    policy, q = (obs, *hidden, 2 * action), (obs + action, *hidden, 1)
    through_q = 2 * forward(q, batch)  # Forward, and backward to the action.
    return train(policy, batch) + forward(policy, batch) + 2 * (train(q, batch) + through_q + forward(q, batch))


def ensemble_step(target: tuple[int, ...], models: int, batch: int) -> int:
    """One gradient step of networks that each have a batch of their own."""
    return models * train(target, batch)
