"""The perceptron that training fits: what it learns, and the optimiser against its definition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sklearn.base import clone
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from hylios_fit import perceptron
from hylios_fit.checkpoints import Checkpoints
from hylios_fit.perceptron import STAGES, Perceptron


def smooth(count, seed=0):
    x = np.random.default_rng(seed).normal(size=(count, 3))
    return x, np.stack([np.sin(x[:, 0] + x[:, 1]), x[:, 2] * np.tanh(x[:, 0])], axis=1)


def rms(found, expected):
    return np.sqrt(np.mean((found - expected) ** 2))


def test_a_smooth_function_is_learned_and_known_where_it_was_not_seen():
    network = Perceptron((32, 32), steps=4000, batch=256, rate=0.01).fit(*smooth(20_000))
    x, expected = smooth(2000, seed=1)
    assert rms(network.predict(x), expected) < 0.01
    # what the weights say is what it predicts
    for i, (w, b) in enumerate(zip(network.coefs_, network.intercepts_, strict=True)):
        x = (np.asarray(jax.nn.silu(x)) if i else x) @ w + b
    np.testing.assert_allclose(network.predict(smooth(2000, seed=1)[0]), x, atol=1e-4)


def test_it_is_one_of_scikit_learns_and_repeats_itself():
    x, y = smooth(1000)
    network = Perceptron((8,), steps=100, batch=64, seed=3)
    assert clone(network).get_params() == network.get_params()
    once = make_pipeline(StandardScaler(), network).fit(x, y).predict(x)
    again = make_pipeline(StandardScaler(), clone(network)).fit(x, y).predict(x)
    np.testing.assert_array_equal(once, again)
    assert not np.array_equal(clone(network).set_params(seed=4).fit(x, y).predict(x), once)


def test_examples_without_weight_do_not_count():
    x, y = smooth(4000)
    wrong = y.copy()
    wrong[::2] += 10.0
    weight = np.where(np.arange(len(x)) % 2, 2.0, 0.0)
    network = Perceptron((32, 32), steps=4000, batch=256, rate=0.01)
    assert rms(network.fit(x, wrong, weight).predict(x), y) < 0.02
    assert rms(clone(network).fit(x, wrong).predict(x), y) > 1.0


def test_slopes_are_learned_too_and_tell_more_than_values():
    x, y = smooth(50)
    dx = np.random.default_rng(3).normal(size=x.shape)
    wave, tanh = np.cos(x[:, 0] + x[:, 1]), np.tanh(x[:, 0])
    dy = np.stack(
        [wave * (dx[:, 0] + dx[:, 1]), dx[:, 2] * tanh + x[:, 2] * dx[:, 0] * (1 - tanh**2)], axis=1
    )
    network = Perceptron((32, 32), steps=2000, batch=50, rate=0.01)
    alone = clone(network).fit(x, y)
    network.fit(x, y, along=(dx, dy))
    fresh, expected = smooth(2000, seed=1)
    off = [np.median(np.abs(one.predict(fresh) - expected)) for one in (network, alone)]
    assert off[0] < 0.5 * off[1]
    at, way = (jnp.asarray(part, jnp.float32) for part in (x, dx))
    assert rms(np.asarray(jax.jvp(network.answer, (at,), (way,))[1]), dy) < 0.05 * rms(0.0, dy)


def test_slopes_are_those_of_the_last_examples():
    """Values at some places and slopes at others, both learned, each with its share."""
    x, y = smooth(400)
    y = y[:, :1]
    dx = np.zeros((100, 3))
    dx[:, 0] = 1.0
    dy = np.cos(x[300:, 0] + x[300:, 1])[:, None]
    weight = np.r_[np.ones(300), np.full(100, 2.0)]
    network = Perceptron((32, 32), steps=2000, batch=100, rate=0.01)
    network.fit(x, y, weight, along=(dx, dy))
    at, way = jnp.asarray(x[300:], jnp.float32), jnp.asarray(dx, jnp.float32)
    assert rms(np.asarray(jax.jvp(network.answer, (at,), (way,))[1]), dy) < 0.05
    assert rms(network.predict(x), y) < 0.05
    # as if the others were looked at along no way, where nothing changes
    columns = [jnp.asarray(column, jnp.float32) for column in (x, y, weight)]
    changes = [jnp.asarray(column, jnp.float32) for column in (dx, dy)]
    padded = [jnp.pad(column, ((300, 0), (0, 0))) for column in changes]
    matrices, none = network._matrices(), jnp.float32(0.0)
    whole = perceptron._loss(matrices, (perceptron._Data(*columns, *padded),), (1.0,), none, "silu")
    plain = perceptron._Data(*(column[:300] for column in columns))
    sloped = perceptron._Data(*(column[300:] for column in columns), *changes)
    parts = perceptron._loss(matrices, (plain, sloped), (0.75, 0.25), none, "silu")
    np.testing.assert_allclose(parts, whole, rtol=1e-5)


def test_examples_with_slopes_count_by_their_share():
    """Where they say 1 and three times as many others 0, of half the weight: 0.4 is between."""
    x, y = np.zeros((400, 3)), np.repeat([0.0, 1.0], [300, 100])[:, None]
    weight = np.repeat([1.0, 2.0], [300, 100])
    still = np.zeros((100, 3)), np.zeros((100, 1))
    network = Perceptron((4,), steps=2000, batch=64).fit(x, y, weight, along=still)
    np.testing.assert_allclose(network.predict(x[:1]), 0.4, atol=0.02)
    # and of no slopes at all
    found = clone(network).fit(x, y, weight, along=(still[0][:0], still[1][:0])).predict(x[:1])
    np.testing.assert_array_equal(found, clone(network).fit(x, y, weight).predict(x[:1]))


def test_along_no_way_nothing_is_learned():
    x, y = smooth(300)
    network = Perceptron((8,), steps=100, batch=64)
    before = clone(network).fit(x, y).predict(x)
    still = network.fit(x, y, along=(0 * x, 0 * y)).predict(x)
    np.testing.assert_allclose(still, before, atol=1e-4)


def test_noise_makes_small_weights_more_probable():
    x, y = smooth(500)
    noisy = y + np.random.default_rng(1).normal(size=y.shape)
    fresh, expected = smooth(2000, seed=2)
    trusting, knowing = (
        Perceptron((32, 32), steps=2000, batch=500, variance=v).fit(x, noisy) for v in (0.0, 1.0)
    )
    assert rms(knowing.predict(fresh), expected) < 0.7 * rms(trusting.predict(fresh), expected)


def test_the_bar_counts_the_stages():
    class Bar:
        count = 0

        def update(self):
            self.count += 1

    Perceptron((4,), steps=60, batch=16, bar=(bar := Bar())).fit(*smooth(100))
    assert bar.count == STAGES


def test_interrupted_it_goes_on_to_the_same_bits(tmp_path, monkeypatch):
    class Bar:
        count = 0

        def update(self):
            self.count += 1
            if self.count == 7:
                raise KeyboardInterrupt

    x, y = smooth(100)
    network = Perceptron((4,), steps=500, batch=16, step=Checkpoints(tmp_path, {}).step("one"))
    expected = clone(network).set_params(step=None).fit(x, y).predict(x)
    with pytest.raises(KeyboardInterrupt):
        clone(network).set_params(bar=(bar := Bar())).fit(x, y)
    begun = []
    descend = perceptron._descend
    monkeypatch.setattr(
        perceptron, "_descend", lambda *args, **more: begun.append(1) or descend(*args, **more)
    )
    found = network.set_params(bar=bar).fit(x, y)  # stages that were done are counted too
    np.testing.assert_array_equal(found.predict(x), expected)
    assert len(begun) == STAGES - 7
    assert bar.count == 7 + STAGES


def test_turning_finds_the_eigenvectors():
    generator = np.random.default_rng(0)
    layer = perceptron._start(jax.random.key(0), (5, 4))[0]
    moments = []
    for size in (6, 4):
        a = generator.normal(size=(size, size))
        q = np.linalg.qr(a)[0]
        moments.append((q * 3.0 ** -np.arange(size)) @ q.T)
    layer = layer._replace(
        left=jnp.asarray(moments[0], jnp.float32), right=jnp.asarray(moments[1], jnp.float32)
    )
    for _ in range(60):
        layer = perceptron._turned(layer)
    for vectors, moment in ((layer.rows, moments[0]), (layer.columns, moments[1])):
        exact = np.linalg.eigh(moment)[1][:, ::-1]
        np.testing.assert_allclose(
            np.abs(np.asarray(vectors).T @ exact), np.eye(len(moment)), atol=1e-3
        )


def test_a_turn_leaves_the_mean_gradient_where_it_was():
    generator = np.random.default_rng(0)
    layer = perceptron._start(jax.random.key(0), (5, 4))[0]
    halves = [generator.normal(size=(n, n)) for n in (6, 4)]
    layer = layer._replace(
        left=jnp.asarray(halves[0] @ halves[0].T, jnp.float32),
        right=jnp.asarray(halves[1] @ halves[1].T, jnp.float32),
        first=jnp.asarray(generator.normal(size=(6, 4)), jnp.float32),
    )
    for _ in range(3):
        before, layer = layer, perceptron._turned(layer)
        assert np.abs(np.asarray(layer.rows - before.rows)).max() > 0.01
        np.testing.assert_allclose(
            layer.rows @ layer.first @ layer.columns.T,
            before.rows @ before.first @ before.columns.T,
            atol=1e-5,
        )


@pytest.mark.parametrize("turned", [False, True])
def test_a_step_is_adam_along_the_eigenvectors(turned):
    """Two steps against Kingma and Ba (2015, algorithm 1), in coordinates that are turned."""
    generator = np.random.default_rng(0)
    layer = perceptron._start(jax.random.key(0), (5, 4))[0]
    rows, columns = np.eye(6), np.eye(4)
    if turned:
        rows, columns = (np.linalg.qr(generator.normal(size=(n, n)))[0] for n in (6, 4))
    layer = layer._replace(
        rows=jnp.asarray(rows, jnp.float32), columns=jnp.asarray(columns, jnp.float32)
    )
    matrix = np.asarray(layer.matrix, float)
    first, second, left = np.zeros((6, 4)), np.zeros((6, 4)), np.zeros((6, 6))
    for count in (1, 2):
        gradient = generator.normal(size=(6, 4))
        layer = perceptron._move(
            layer, jnp.asarray(gradient, jnp.float32), jnp.float32(count), jnp.float32(0.01)
        )
        own = rows.T @ gradient @ columns
        first = 0.95 * first + 0.05 * own
        second = 0.95 * second + 0.05 * own**2
        left = 0.95 * left + 0.05 * gradient @ gradient.T
        step = (first / (1 - 0.95**count)) / (np.sqrt(second / (1 - 0.95**count)) + 1e-8)
        matrix -= 0.01 * rows @ step @ columns.T
    np.testing.assert_allclose(layer.matrix, matrix, atol=1e-5)
    np.testing.assert_allclose(layer.left, left, atol=1e-5)
