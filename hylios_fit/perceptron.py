"""A perceptron for scikit-learn's pipelines, its weights found in JAX.

What is learned here is smooth and known to many digits. Adam alone, which scikit-learn's own
perceptron has, creeps along the narrow valleys of such a task. SOAP (Vyas et al. 2024,
arXiv:2409.11321) runs Adam along the eigenvectors of the second moments of each matrix's gradient,
those of Shampoo (Gupta et al. 2018, arXiv:1802.09568), where the valleys hardly mix. Its settings
are those of the paper.
"""

from __future__ import annotations

import itertools
import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from sklearn.base import BaseEstimator, RegressorMixin

from hylios_fit.checkpoints import Step
from hylios_fit.precision import product

TURN = 10  # steps between two turns of the eigenvectors
WARM = 0.02  # share of the steps in which the rate rises; after it falls as a cosine does
FIRST, SECOND, TURNING = 0.95, 0.95, 0.95  # memory of both moments, and of what turns the vectors
TINY = 1e-8
STAGES = 20  # of a fit, for its progress bar


class Perceptron(RegressorMixin, BaseEstimator):
    """Layers of hidden units and a linear one, fitted by least squares in float32.

    The weights are the most probable ones, where they have variance 1/width and each target has
    noise of the given variance (over its sample weight).

    Args:
        hidden: units of each hidden layer.
        steps: of the optimiser, rounded up to whole turns of its eigenvectors.
        batch: examples in each, drawn with replacement.
        rate: the largest size of a step.
        variance: of the targets' noise; with 0 all weights are equally probable.
        seed: of the first weights and of the batches.
        activation: of the hidden units, a function of `jax.nn`.
        bar: a progress bar, updated `STAGES` times.
        step: of a longer computation (`checkpoints.Step`): what is fitted is saved there after
            each stage, and a fit of the same data goes on with it.
    """

    def __init__(
        self, hidden: tuple[int, ...] = (128, 128, 128), steps: int = 20_000, batch: int = 1024,
        rate: float = 3e-3, variance: float = 0.0, seed: int = 0, activation: str = "silu",
        bar: Any = None, step: Step | None = None,
    ):  # fmt: skip
        self.hidden = hidden
        self.steps = steps
        self.batch = batch
        self.rate = rate
        self.variance = variance
        self.seed = seed
        self.activation = activation
        self.bar = bar
        self.step = step

    def fit(
        self, x: Any, y: Any, sample_weight: Any = None, along: tuple[Any, Any] | None = None
    ) -> Perceptron:
        """Inputs (n, f), standardised, and targets (n, k) of about unit size; weights (n,).

        `along` are how both change, (m, f) and (m, k), along one direction at each of the last m
        examples: then the slope there is learned too (Czarnecki et al. 2017, arXiv:1706.04859).
        """
        x, y = jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32)
        weight = jnp.asarray(np.ones(len(x)) if sample_weight is None else sample_weight)
        columns = x, y, weight.astype(jnp.float32)
        if along is not None and not len(along[0]):
            along = None
        plain = len(x) if along is None else len(x) - len(along[0])
        data = []  # what has no slopes takes half the time
        if plain:
            data.append(_Data(*(column[:plain] for column in columns)))
        if along is not None:
            changes = (jnp.asarray(part, jnp.float32) for part in along)
            data.append(_Data(*(column[plain:] for column in columns), *changes))
        first, batches = jax.random.split(jax.random.key(self.seed))
        widths = (x.shape[1], *self.hidden, y.shape[1])
        layers = _start(first, widths)
        turns = max(math.ceil(self.steps / TURN), 1)
        penalty = self.variance * max(self.hidden) / len(x)
        marks = np.linspace(0, turns, STAGES + 1).astype(int)
        layers, done = self._saved(layers)
        for stage, (low, high) in enumerate(itertools.pairwise(marks)):
            if stage >= done:
                layers = _descend(
                    layers, tuple(data), batches, (low, high, turns), self.rate, penalty,
                    batch=self.batch, activation=self.activation,
                )  # fmt: skip
                jax.block_until_ready(layers)
                self._save(layers, stage + 1)
            if self.bar is not None:
                self.bar.update()
        self.coefs_ = [np.asarray(layer.matrix[:-1]) for layer in layers]
        self.intercepts_ = [np.asarray(layer.matrix[-1]) for layer in layers]
        return self

    def predict(self, x: Any) -> np.ndarray:
        """Targets (n, k) at inputs (n, f)."""
        x = jnp.asarray(x, jnp.float32)
        return np.asarray(_answer(self._matrices(), x, activation=self.activation))

    def answer(self, x: Float[Array, "... f"]) -> Float[Array, "... k"]:
        """As `predict`, in JAX."""
        flat = _forward(self._matrices(), x.reshape(-1, x.shape[-1]), self.activation)
        return flat.reshape(*x.shape[:-1], -1)

    def _saved(self, layers: tuple[_Layer, ...]) -> tuple[tuple[_Layer, ...], int]:
        """Layers, and how many stages are done."""
        saved = None if self.step is None else self.step.load()
        if saved is None:
            return layers, 0
        tree = jax.tree.structure(layers)
        parts = [jnp.asarray(saved[f"{i}"]) for i in range(tree.num_leaves)]
        return tree.unflatten(parts), int(saved["stages"])

    def _save(self, layers: tuple[_Layer, ...], stages: int) -> None:
        if self.step is not None:
            parts = {f"{i}": np.asarray(part) for i, part in enumerate(jax.tree.leaves(layers))}
            self.step.save(stages=stages, **parts)

    def _matrices(self) -> list[Array]:
        pairs = zip(self.coefs_, self.intercepts_, strict=True)
        return [jnp.concatenate([w, b[None]]) for w, b in pairs]


class _Data(NamedTuple):
    x: Float[Array, "n f"]
    y: Float[Array, "n k"]
    weight: Float[Array, "n"]
    dx: Float[Array, "n f"] | None = None
    dy: Float[Array, "n k"] | None = None


class _Layer(NamedTuple):
    """A layer's weights, the biases as their last row, and what the optimiser remembers of it."""

    matrix: Float[Array, "i o"]
    first: Float[Array, "i o"]  # mean gradient along the eigenvectors
    second: Float[Array, "i o"]  # mean of its squares there
    left: Float[Array, "i i"]  # mean of gradient times its transpose
    right: Float[Array, "o o"]
    rows: Float[Array, "i i"]  # eigenvectors of both, as they were at the last turn
    columns: Float[Array, "o o"]


@partial(jax.jit, static_argnames="widths")
def _start(key: Any, widths: tuple[int, ...]) -> tuple[_Layer, ...]:
    """Layers between so many inputs, hidden units and outputs."""

    def layer(key: Any, wide: int, narrow: int) -> _Layer:
        weights = jax.random.normal(key, (wide, narrow), jnp.float32) / math.sqrt(wide)
        matrix = jnp.concatenate([weights, jnp.zeros((1, narrow), jnp.float32)])
        none = jnp.zeros_like(matrix)
        one = [jnp.eye(n, dtype=jnp.float32) for n in matrix.shape]
        return _Layer(matrix, none, none, 0.0 * one[0], 0.0 * one[1], *one)

    pairs = enumerate(itertools.pairwise(widths))
    return tuple(layer(jax.random.fold_in(key, i), *pair) for i, pair in pairs)


def _forward(matrices: list[Array], x: Float[Array, "n f"], activation: str) -> Float[Array, "n k"]:
    bend = getattr(jax.nn, activation)
    for i, matrix in enumerate(matrices):
        x = bend(x) if i else x
        x = product(x, matrix[:-1]) + matrix[-1][None]
    return x


_answer = jax.jit(_forward, static_argnames="activation")


def _loss(
    matrices: list[Array], data: tuple[_Data, ...], shares: tuple[float, ...], penalty: Array,
    activation: str,
) -> Array:  # fmt: skip
    """Half of: the mean squared error over parts that are such shares of the examples, and the
    penalty."""

    answer = partial(_forward, matrices, activation=activation)

    def error(part: _Data) -> Array:
        if part.dx is None:
            squares = (answer(part.x) - part.y) ** 2
        else:
            y, dy = jax.jvp(answer, (part.x,), (part.dx,))
            squares = (y - part.y) ** 2 + (dy - part.dy) ** 2
        return jnp.mean(part.weight * jnp.sum(squares, axis=1))

    errors = sum(share * error(part) for share, part in zip(shares, data, strict=True))
    weights = sum(jnp.sum(matrix[:-1] ** 2) for matrix in matrices)
    return 0.5 * (errors + penalty * weights)


def _drawn(key: Any, part: _Data, count: int) -> _Data:
    """So many examples, with replacement."""
    chosen = jax.random.randint(key, (count,), 0, len(part.x))
    return jax.tree.map(lambda column: column[chosen], part)


@partial(jax.jit, static_argnames=("batch", "activation"))
def _descend(
    layers: tuple[_Layer, ...], data: tuple[_Data, ...], key: Any, turns: Any, rate: Any,
    penalty: Any, batch: int, activation: str,
) -> tuple[_Layer, ...]:  # fmt: skip
    """From one turn of the eigenvectors to another; the third of `turns` is how many in all."""
    low, high, whole = turns
    shares = tuple(len(part.x) / sum(len(other.x) for other in data) for part in data)
    counts = [max(round(batch * share), 1) for share in shares]

    def step(number: Array, layers: tuple[_Layer, ...]) -> tuple[_Layer, ...]:
        own = jax.random.fold_in(key, number)
        keys = (jax.random.fold_in(own, i) if i else own for i in range(len(data)))
        drawn = tuple(map(_drawn, keys, data, counts))
        matrices = [layer.matrix for layer in layers]
        gradients = jax.grad(_loss)(matrices, drawn, shares, penalty, activation)
        count = number.astype(jnp.float32) + 1.0
        done = count / (whole.astype(jnp.float32) * TURN)
        size = rate * jnp.minimum(done / WARM, 0.5 + 0.5 * jnp.cos(math.pi * done))
        pairs = zip(layers, gradients, strict=True)
        return tuple(_move(layer, gradient, count, size) for layer, gradient in pairs)

    def turn(number: Array, layers: tuple[_Layer, ...]) -> tuple[_Layer, ...]:
        layers = jax.lax.fori_loop(number * TURN, (number + 1) * TURN, step, layers)
        return tuple(_turned(layer) for layer in layers)

    return jax.lax.fori_loop(low, high, turn, layers)


def _move(layer: _Layer, gradient: Array, count: Array, size: Array) -> _Layer:
    along = product(product(layer.rows.T, gradient), layer.columns)
    first = FIRST * layer.first + (1.0 - FIRST) * along
    second = SECOND * layer.second + (1.0 - SECOND) * along**2
    mean, square = first / (1.0 - FIRST**count), second / (1.0 - SECOND**count)
    step = product(product(layer.rows, mean / (jnp.sqrt(square) + TINY)), layer.columns.T)
    return layer._replace(
        matrix=layer.matrix - size * step,
        first=first,
        second=second,
        left=TURNING * layer.left + (1.0 - TURNING) * product(gradient, gradient.T),
        right=TURNING * layer.right + (1.0 - TURNING) * product(gradient.T, gradient),
    )


def _turned(layer: _Layer) -> _Layer:
    """With eigenvectors one orthogonal iteration closer, the largest first."""

    def closer(moments: Array, vectors: Array) -> tuple[Array, Array]:
        size = jnp.sum(vectors * product(moments, vectors), axis=0)
        order = jnp.argsort(-size)
        return jnp.linalg.qr(product(moments, vectors[:, order]))[0], order

    rows, top = closer(layer.left, layer.rows)
    columns, side = closer(layer.right, layer.columns)
    first = product(
        product(product(rows.T, layer.rows), layer.first), product(layer.columns.T, columns)
    )
    second = layer.second[top][:, side]
    return layer._replace(rows=rows, columns=columns, first=first, second=second)
